"""The commands that ask a server, and the client of Python."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

import tuner
from tests.tuner.service.conftest import submit, upload
from tuner.cli import main
from tuner.core.errors import InputError, ServerFaultError
from tuner.options import Options
from tuner.result import Run
from tuner.service import client as client_module
from tuner.service.client import Client, PassingError, job_request_of, watch


@pytest.fixture
def server(client, monkeypatch):
    address = str(client.base_url)
    monkeypatch.setenv("TUNE_SERVER", address)
    return address


@pytest.mark.usefixtures("server")
def test_submitting_and_waiting_shows_and_ends_as_the_local_command(table, tmp_path, capsys):
    out = tmp_path / "run"
    assert main(["submit", "--flights", str(table), "--wait", "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "whole length: iteration 5, horizon 1 s, position RMSE 20.00 mm" in shown
    assert shown.index("whole length: ") < shown.index("± 95 %")
    assert f"Written to {out}" in shown
    assert (out / "plots" / "one.svg").exists()
    assert json.loads((out / "result.json").read_text())["status"] == "converged"


@pytest.mark.usefixtures("server")
def test_a_job_is_submitted_listed_watched_fetched_and_cancelled(client, table, tmp_path, capsys):
    assert main(["submit", "--flights", str(table), "--name", "[bold]first"]) == 0
    job = capsys.readouterr().out.split()[1].rstrip(":")
    assert main(["watch", job]) == 0
    assert f"tune fetch {job}" in capsys.readouterr().out
    assert main(["jobs", "--state", "done"]) == 0
    assert "[bold]first" in capsys.readouterr().out
    assert main(["jobs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["jobs"][0]["id"] == job
    (tmp_path / "run").mkdir()
    (tmp_path / "run/checkpoint.npz").touch()
    (tmp_path / "run/profiles.json").write_text("{}")
    assert main(["fetch", job, "--out", str(tmp_path / "run")]) == 0
    assert "motor_constant" in capsys.readouterr().out
    assert not (tmp_path / "run/profiles.json").exists()
    slow = submit(client, upload(client, table.read_bytes()), namespace="slow")
    assert main(["fetch", slow, "--out", str(tmp_path / "none")]) == 2
    assert main(["cancel", slow]) == 0
    capsys.readouterr()
    assert main(["cancel", slow]) == 2
    assert capsys.readouterr().err == (
        f"tune: job {slow}: is cancelled; there is nothing left to cancel\n"
    )
    assert main(["watch", slow]) == 2
    assert "was cancelled" in capsys.readouterr().err


def test_the_address_of_a_job_is_no_id(capsys):
    assert main(["fetch", "http://lab:8000/jobs/3f2a91c05d7e4b68"]) == 2
    assert "give 3f2a91c05d7e4b68 and --server http://lab:8000\n" in capsys.readouterr().err


@pytest.mark.usefixtures("server")
@pytest.mark.parametrize(
    ("wish", "status", "error"),
    [
        ("refuse", 2, "tune: flights: nothing moves; fly a circle\n"),
        ("fault", 1, "internal error (ZeroDivisionError: division by zero); please report it\n"),
    ],
)
def test_a_job_that_fails_ends_the_command_as_it_would_here(table, capsys, wish, status, error):
    arguments = ["submit", "--flights", str(table), "--namespace", wish, "--wait", "--quiet"]
    assert main(arguments) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith(error)
    assert err.count("\n") == 1


@pytest.mark.usefixtures("server")
@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["jobs", "--server", "nowhere"], "--server: 'nowhere' is no address; write http://"),
        (
            ["jobs", "--server", "http://127.0.0.1:1"],
            "--server: http://127.0.0.1:1 cannot be reached (Connection refused); check",
        ),
        (["jobs", "--server", "http://lab:x"], "--server: 'http://lab:x' is no address; write"),
        (["jobs", "--server", "http://[::1"], "--server: 'http://[::1' is no address; write"),
        (["jobs", "--server", f"http://{'a' * 64}"], "is no address; write http://"),
        (["jobs", "--token", "tüne"], "--token: is not known to http://"),
        (["watch-folder", ".", "--settle", "nan"], "--settle: is nan; give 0 to 86400 s"),
        (["watch", "nobody"], "job nobody: is not known here; list the jobs with tune jobs"),
        (["jobs", "--after", "nobody"], "job nobody: is not known here"),
        (["submit", "--flights", "no.bag"], "no.bag: does not exist; check the path"),
        (["watch-folder", "nowhere"], "nowhere: is no folder"),
        (["serve", "--port", "99999"], "--port: 99999 is no port"),
        (["serve", "--workers", "0"], "--workers: is 0; give a number above zero, up to 1000"),
        (["serve", "--workers", f"{10**23}"], "give a number above zero, up to 1000"),
        (["serve", "--max-upload", "inf"], "--max-upload: is inf; give a number above zero"),
        (["serve", "--memory", "1e300"], "--memory: is 1e+300; give a number above zero"),
        (["serve", "token", "remove", "bob"], "'bob' has none"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(arguments, expected, capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert expected in err


AWAY = "cannot be reached (Connection refused)"
CHECK = "check the address, and that tune serve runs there"
START = "start it with tune serve, or name another with --server or TUNE_SERVER"


@pytest.mark.parametrize(
    ("server", "said"),
    [
        (
            None,
            f"the server: http://127.0.0.1:1 {AWAY}; {START}",
        ),
        (
            "http://127.0.0.1:2",
            f"TUNE_SERVER: http://127.0.0.1:2 {AWAY}; {CHECK}",
        ),
        ("lab", "TUNE_SERVER: 'lab' is no address; write http://127.0.0.1:1"),
    ],
)
def test_a_server_is_called_as_the_user_named_it(server, said, capsys, monkeypatch):
    monkeypatch.setattr("tuner.service.client.DEFAULT_SERVER", "http://127.0.0.1:1")
    monkeypatch.delenv("TUNE_SERVER", raising=False)
    if server is not None:
        monkeypatch.setenv("TUNE_SERVER", server)
    assert main(["jobs"]) == 2
    assert capsys.readouterr().err == f"tune: {said}\n"


def test_a_server_that_is_away_is_told_once_and_waited_for(tmp_path, table, monkeypatch):
    (tmp_path / "a.csv").write_bytes(table.read_bytes())
    asked: list[int] = []
    said: list[str] = []

    def submitted(*_: object) -> str:
        asked.append(1)
        if len(asked) < 4:
            raise PassingError("the server", "has no space left", "free some space and try again")
        return "a.csv: job 1"

    def stop_then(_: float) -> None:
        if len(asked) == 4:
            raise KeyboardInterrupt

    monkeypatch.setattr("tuner.service.client._submit", submitted)
    monkeypatch.setattr("tuner.service.client.time.sleep", stop_then)
    with pytest.raises(KeyboardInterrupt):
        watch(tuner.connect(), tmp_path, settle=0, once=False, say=said.append)
    refused = "tune: the server: has no space left; free some space and try again"
    assert said == [refused, "a.csv: job 1"]


@pytest.mark.parametrize(
    ("status", "kind", "said"),
    [
        (507, PassingError, "http://lab: the server has no space left; free some"),
        (409, InputError, "the server: has no space left; free some"),
    ],
)
def test_refusals_that_pass_are_told_from_others(status, kind, said):
    content = {"where": "the server", "what": "has no space left", "remedy": "free some"}
    answer = httpx.Response(status, json=content)
    with pytest.raises(InputError) as refused:
        tuner.connect("http://lab")._check(answer)
    assert (type(refused.value), str(refused.value)) == (kind, said)


def test_the_client_gives_what_fit_gives(server, table, tmp_path, updated):
    client = tuner.connect(server)
    run = client.fit([table], vehicle=updated, mass=2.3, out=tmp_path / "run", name="from Python")
    assert isinstance(run, Run)
    assert run.folder == tmp_path / "run"
    assert run.result.coefficients["motor_constant"].best == pytest.approx(1.15e-7)
    assert client.jobs()["jobs"][0]["name"] == "from Python"
    assert client.history("hovergames_updated")["coefficients"]["motor_constant"]["points"]
    with pytest.raises(InputError, match="nothing moves; fly a circle"):
        client.fit([table], namespace="refuse", out=tmp_path / "refused")
    with pytest.raises(ServerFaultError, match="ZeroDivisionError"):
        client.fit([table], namespace="fault", out=tmp_path / "fault")
    client.close()


def test_a_result_is_kept_until_the_next_one_is_all_here(server, table, tmp_path, monkeypatch):
    client, out = tuner.connect(server), tmp_path / "run"
    client.fit([table], out=out)
    kept = {file: file.read_bytes() for file in out.rglob("*") if file.is_file()}
    job = client.submit(Options([str(table)], mass=2.3))
    client.wait(job)
    download = Client._download

    def cut_off(self: Client, path: str, target: Path) -> None:
        if path.endswith("report.html"):
            raise InputError("--server", "cannot be reached", "check the address")
        download(self, path, target)

    monkeypatch.setattr(Client, "_download", cut_off)
    with pytest.raises(InputError, match="cannot be reached"):
        client.fetch(job, out)
    monkeypatch.undo()
    assert {file: file.read_bytes() for file in out.rglob("*") if file.is_file()} == kept
    assert client.fetch(job, out).result.coefficients["mass"].best == 2.3
    assert sorted(file for file in out.rglob("*") if file.is_file()) == sorted(kept)
    client.close()


def test_a_recording_that_the_server_has_is_not_sent_again(server, table):
    client, sent = tuner.connect(server), []
    for _ in range(2):
        client.submit(Options([str(table)]), on_upload=sent.append)
    assert sent == [table]
    client.close()


def test_files_that_options_name_travel_as_their_contents(table, tmp_path, updated):
    from tuner.vehicle import write_vehicle  # noqa: PLC0415

    lab = tmp_path / "lab"
    lab.mkdir()
    for name in ("a.csv", "b.csv"):
        (lab / name).write_bytes(table.read_bytes())
    write_vehicle(updated, lab / "own.yaml")
    (lab / "tune.yaml").write_text("vehicle: own.yaml\ncontroller: hovergames_sitl\nholdout: [b]\n")
    flights, request = job_request_of(Options([str(lab / "*.csv")], mass=2.2))
    assert [path.name for path in flights] == ["a.csv", "b.csv"]
    assert request["mass"] == 2.2
    assert request["settings"]["vehicle"]["mass"] == updated.mass
    assert request["settings"]["controller"] == "hovergames_sitl"
    assert request["settings"]["holdout"] == ["b"]
    assert "holdout" not in request
    _, request = job_request_of(Options([str(lab / "a.csv")], holdout=[str(lab / "b.csv")]))
    assert request["holdout"] == ["b"]


@pytest.mark.usefixtures("server")
def test_a_folder_s_new_recordings_become_one_job_once(client, table, tmp_path, capsys):
    for name in ("a.csv", "b.tsv"):
        (tmp_path / name).write_bytes(table.read_bytes() + name.encode())
    arguments = ["watch-folder", str(tmp_path), "--settle", "0.1", "--once"]
    assert main(arguments) == 0
    assert capsys.readouterr().out.startswith("a.csv, b.tsv: job ")
    assert main(arguments) == 0
    assert capsys.readouterr().out == ""
    (tmp_path / "c.csv").write_bytes(table.read_bytes() + b"c")
    assert main(arguments) == 0
    assert capsys.readouterr().out.startswith("c.csv: job ")
    (
        tmp_path / client_module.SubmissionRecord.FILE
    ).unlink()  # as after a crash before it was noted
    jobs = len(client.get("/api/v1/jobs").json()["jobs"])
    assert jobs == 2


@pytest.mark.usefixtures("server")
def test_a_file_that_is_no_recording_keeps_no_folder_from_being_fitted(table, tmp_path, capsys):
    (tmp_path / "a.csv").touch()
    (tmp_path / "b.csv").write_bytes(table.read_bytes())
    arguments = ["watch-folder", str(tmp_path), "--settle", "0.1", "--once"]
    assert main(arguments) == 0
    refused, submitted = capsys.readouterr().out.splitlines()
    assert refused == "tune: a.csv: is empty; check the recording"
    assert submitted.startswith("b.csv: job ")
    assert main(arguments) == 0
    assert capsys.readouterr().out == ""
    (tmp_path / "b.csv").unlink()
    (tmp_path / client_module.SubmissionRecord.FILE).unlink()
    assert main(arguments) == 2


def test_a_recording_that_still_grows_is_waited_for(tmp_path, table):
    (tmp_path / "a.csv").write_bytes(b"time")
    first = client_module._new_recordings(tmp_path)
    time.sleep(0.01)
    (tmp_path / "a.csv").write_bytes(table.read_bytes())
    assert client_module._new_recordings(tmp_path) != first


def test_a_recording_that_is_moved_away_is_passed_over(tmp_path, table, monkeypatch):
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_bytes(table.read_bytes())
    is_file = Path.is_file

    def then_moved(path):
        there = is_file(path)
        if path.name == "a.csv":
            path.unlink()
        return there

    monkeypatch.setattr(Path, "is_file", then_moved)
    assert [path.name for path in client_module._new_recordings(tmp_path)] == ["b.csv"]
    with pytest.raises(InputError, match=r"gone: cannot be read any more \(No such file"):
        client_module._new_recordings(tmp_path / "gone")


STREAM = {"Content-Type": "text/event-stream"}


@pytest.mark.parametrize(
    "answer",
    [
        *(
            (200, {}, text)
            for text in (b"", b"[]", b"5", b"{}", b'{"jobs": [{}]}', b"<p>", b"\xff")
        ),
        (302, {"Location": "http://elsewhere"}, b""),
        (404, {}, b'{"detail": "not found"}'),
        (200, {"Content-Encoding": "gzip"}, b"no gzip"),
        *((200, STREAM, b"event: job\ndata: %s\n\n" % data) for data in (b"{}", b"no json", b"[]")),
    ],
)
@pytest.mark.parametrize(
    "command", [["jobs"], ["watch", "0"], ["fetch", "0"], ["cancel", "0"], ["submit", "--flights"]]
)
def test_what_is_no_tuning_service_is_one_line(command, answer, table, capsys, monkeypatch):
    made = httpx.Client

    def answered(_):
        status, headers, content = answer
        return httpx.Response(status, headers=headers, stream=httpx.ByteStream(content))

    def answering(**given):
        return made(**given, transport=httpx.MockTransport(answered))

    monkeypatch.setattr(httpx, "Client", answering)
    monkeypatch.setattr("tuner.service.client.MAX_SILENCE_S", -1.0)
    if command == ["submit", "--flights"]:
        command = [*command, str(table)]
    assert main([*command, "--server", "http://other"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("tune: --server: http://other ")


def test_plain_tune_loads_nothing_of_the_service():
    script = (
        "import sys\nfrom tuner.cli import main\nmain(['--help'])\nimport tuner.job.run\n"
        "heavy = {'fastapi', 'sqlalchemy', 'uvicorn', 'httpx', 'alembic', 'prometheus_client'}\n"
        "sys.exit(', '.join(sorted(heavy & set(sys.modules))) or None)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("package", "arguments", "said"),
    [
        ("fastapi", ["serve"], "tune serve: needs fastapi, which is not installed; pip install"),
        ("sqlalchemy", ["serve", "token", "list"], "needs sqlalchemy"),
        ("httpx", ["jobs"], "a tuning service: needs httpx, which is not installed; pip install"),
    ],
)
def test_a_missing_extra_is_named_in_one_line(package, arguments, said):
    script = (
        f"import sys\nsys.modules['{package}'] = None\nfrom tuner.cli import main\n"
        f"sys.exit(main({arguments!r}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("scheme", ["http", "https"])
def test_certificates_are_checked_where_there_are_any(scheme, monkeypatch):
    given = {}
    monkeypatch.setattr(httpx, "Client", lambda **more: given.update(more))
    Client(f"{scheme}://somewhere")
    assert given["verify"] is (scheme == "https")
