"""Recordings on their way in: whole or not at all, inspected apart, bounded in every way."""

import hashlib
import json
import re
import select
import shutil
import socket
import sys
import threading
from contextlib import suppress
from dataclasses import replace
from http.client import HTTPResponse
from types import SimpleNamespace
from urllib.parse import urlsplit

import httpx
import pytest
from sqlalchemy import inspect

from tests.tuner.service.conftest import FLIGHTS, LIMITS, listening, submit, upload
from tuner.core.errors import RecordingError
from tuner.options import Options
from tuner.service import errors, inspection, recordings
from tuner.service.errors import FIELD_PHRASES, on_the_web, over_http
from tuner.service.service import Service
from tuner.service.settings import MIB

BAG = FLIGHTS / "yaw_spin_3rps.bag"


def send(client: httpx.Client, content: bytes, name: str = "a.csv") -> httpx.Response:
    return client.post("/api/v1/recordings", files={"file": (name, content)})


def left(service: Service) -> list[str]:
    return [path.name for path in service.settings.incoming.iterdir()]


@pytest.mark.usefixtures("real_inspection")
def test_an_upload_is_answered_with_what_inspect_says(client, service):
    content = BAG.read_bytes()
    answer = send(client, content, BAG.name)
    assert answer.status_code == 201
    found = answer.json()
    assert set(found) == {"id", "name", "inspection"}
    assert found["id"] == hashlib.sha256(content).hexdigest()
    assert found["name"] == found["inspection"]["path"] == "yaw_spin_3rps.bag"
    assert found["inspection"]["missions"][0]["yaw_rate_setpoint"] == pytest.approx(3.0)
    again = send(client, content, "same.bag")
    assert (again.status_code, again.json()["id"]) == (200, found["id"])
    stored = [path for path in (service.settings.data / "store").rglob("*") if path.is_file()]
    assert len(stored) == 1
    assert stored[0].read_bytes() == content
    assert again.json()["name"] == again.json()["inspection"]["path"] == "same.bag"
    kept = client.get(f"/api/v1/recordings/{found['id']}").json()
    assert kept["name"] == kept["inspection"]["path"] == "yaw_spin_3rps.bag"  # as others know it
    assert left(service) == []


def test_a_job_calls_a_recording_as_whoever_submits_it_does(client, table):
    recording = upload(client, table.read_bytes(), "first.csv")
    assert upload(client, table.read_bytes(), "../second one.csv") == recording
    assert "first.csv" in client.get("/").text
    names = {recording: "../second one.csv"}
    other = submit(client, upload(client, b"x\n0\n", "b.csv"))
    job = submit(client, recording, names=names)
    flights = client.get(f"/api/v1/jobs/{job}").json()["flights"]
    assert flights[0]["name"].startswith("second_one-")
    assert client.get(f"/api/v1/jobs/{other}").json()["flights"][0]["name"] == "b.csv"


@pytest.mark.usefixtures("real_inspection")
def test_the_page_shows_what_a_truncated_bag_has_lost_and_no_text_is_a_bag(client):
    content, script = BAG.read_bytes(), {"x-requested-with": "script"}
    sent = {"file": ("cut.bag", content[: 2 * len(content) // 3])}
    card = client.post("/recordings", files=sent, headers=script)
    assert 'class="problem">Broken: the end of the file is missing; ' in card.text
    assert 'value="fit" checked' in card.text
    text = {"file": ("notes.bag", b"a, b\n1, 2\n")}
    answer = client.post("/recordings", files=text, headers=script)
    assert answer.status_code == 422
    assert "notes.bag: is a text, and no .bag; known formats are" in answer.text
    odd = client.post("/recordings", files={"file": ("a.csv", text["file"][1])}, headers=script)
    assert 'value="leave out" checked' in odd.text  # no flight can be read from it


def test_what_a_tune_yaml_holds_out_is_shown_before_the_job_starts(client, table):
    ids = [upload(client, table.read_bytes(), "a.csv"), upload(client, b"x\n0\n", "b.csv")]
    form = {f"use-{one}": "fit" for one in ids} | {"settings": "holdout: [b]", "key": "k"}
    shown = client.post("/jobs", data=form)
    assert shown.status_code == 422
    assert "settings: hold out b; see what checks the fit below, and start again" in shown.text
    assert re.findall(r'name="use-(\w+)" value="holdout" checked', shown.text) == [ids[1]]
    assert 'name="holdout" value="b"' in shown.text
    seen = form | {"holdout": "b", f"use-{ids[0]}": "holdout"}
    started = client.post("/jobs", data=seen)
    assert started.status_code == 303
    job = started.headers["location"].rpartition("/")[2]
    flights = client.get(f"/api/v1/jobs/{job}").json()["flights"]
    assert [flight["holdout"] for flight in flights] == [True, False]


@pytest.mark.usefixtures("real_inspection")
def test_what_is_no_recording_is_refused_by_its_name_and_not_kept(client, service):
    answer = send(client, b"\x00\x01 nothing" * 50, "holiday.jpg")
    assert answer.status_code == 422
    assert answer.json()["detail"].startswith("holiday.jpg: is of no known format; known formats")
    assert [path for path in (service.settings.data / "store").rglob("*") if path.is_file()] == []
    assert left(service) == []


def test_a_recording_of_more_topics_than_pages_list_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(inspection, "MAX_JSON_LETTERS", 500)
    monkeypatch.setattr(inspection, "limit_process", lambda **_: None)
    monkeypatch.setattr(sys, "argv", ["inspection", str(BAG), "1", "1", "1"])
    inspection.main()
    assert json.loads(capsys.readouterr().out)["refused"]["what"] == "holds too many topics to list"


def test_lists_of_recordings_leave_their_inspections_where_they_are(client, service, table):
    upload(client, table.read_bytes())
    (row,) = recordings.latest(service.database, 5)
    assert "inspection" in inspect(row).unloaded


def test_a_recording_that_takes_too_long_is_stopped(tmp_path, monkeypatch):
    script = tmp_path / "python"
    script.write_text("#!/bin/sh\nexec sleep 60\n")
    script.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(script))
    limits = replace(LIMITS, inspection_seconds=0.5)
    with pytest.raises(RecordingError, match=r"endless\.bag: takes more than 0.5 s to read; split"):
        inspection.inspect(tmp_path / "endless.bag", limits)


def test_a_recording_that_needs_too_much_memory_is_stopped(tmp_path, monkeypatch):
    hungry = "import sys; from tuner.service.settings import limit_process as l; "
    hungry += f"l(memory_bytes={300 * MIB}, file_bytes=1)\ntry: b'x' * {2**31}\n"
    hungry += "except MemoryError: sys.exit(3)"
    script = tmp_path / "python"
    script.write_text(f'#!/bin/sh\nexec {sys.executable} -c "$HUNGRY"\n')
    script.chmod(0o755)
    monkeypatch.setenv("HUNGRY", hungry)
    monkeypatch.setattr(sys, "executable", str(script))
    with pytest.raises(RecordingError, match="needs more than 2 GiB of memory to read"):
        inspection.inspect(tmp_path / "x.bag", LIMITS)


def test_a_file_beyond_the_limit_is_refused_before_it_is_all_there(settings, table):
    service = Service.open(replace(settings, limits=replace(LIMITS, upload_bytes=MIB)))
    with listening(service) as client:
        for field in ("file", "other"):
            answer = client.post("/api/v1/recordings", files={field: ("x", bytes(3 * MIB))})
            assert answer.status_code == 413
            assert "is larger than the 1 MiB that this server takes" in answer.text
        assert left(service) == []
        upload(client, table.read_bytes())
    service.close()


def test_another_request_beyond_the_limit_is_refused(client):
    body = b'{"recordings": ["' + b"0" * (2 * MIB) + b'"]}'
    answer = client.post("/api/v1/jobs", content=body, headers={"content-type": "application/json"})
    assert answer.status_code == 413
    assert answer.json()["detail"].startswith("the request: is larger than the 1 MiB")


@pytest.mark.parametrize(
    ("body", "kind", "said"),
    [
        (b"", "text/plain", "is no form"),
        (b"", "multipart/form-data", "is no form"),
        (b"", "multipart/form-data; boundary=x", "holds no file"),
        (b"junk", "multipart/form-data; boundary=x", "is no form that can be read"),
        (
            b'--x\r\ncontent-disposition: form-data; name="other"; filename="a"\r\n\r\nab\r\n--x--',
            "multipart/form-data; boundary=x",
            "holds no file",
        ),
        (
            b'--x\r\ncontent-disposition: form-data; name="file"; filename="a"\r\n\r\nab',
            "multipart/form-data; boundary=x",
            "was cut off before its end; upload the recording again",
        ),
        (
            b'--x\r\ncontent-disposition: form-data; name="file"; filename="a"\r\n\r\n\r\n--x--',
            "multipart/form-data; boundary=x",
            "a: is empty; check the recording",
        ),
    ],
)
def test_a_body_that_is_no_upload_is_refused_in_words(client, service, body, kind, said):
    answer = client.post("/api/v1/recordings", content=body, headers={"content-type": kind})
    assert answer.status_code == 422
    assert said in answer.json()["detail"]
    assert left(service) == []


BEGINNING = (
    b"POST /api/v1/recordings HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-length: 9000000\r\n"
    b"content-type: multipart/form-data; boundary=x\r\n\r\n"
    b'--x\r\ncontent-disposition: form-data; name="file"; filename="a.bag"\r\n\r\n'
)


@pytest.mark.parametrize(
    ("drops", "path"), [(0, "recordings"), (2000, "recordings"), (2000, "jobs")]
)
def test_a_request_that_stalls_or_drips_is_cut_off_and_makes_room(settings, table, drops, path):
    limits = replace(LIMITS, uploads_at_once=1, stall_seconds=0.3, bytes_per_second=1e9)
    service = Service.open(replace(settings, limits=limits, workers=0))
    with listening(service) as client:
        url = urlsplit(str(client.base_url))
        with socket.create_connection((url.hostname, url.port), timeout=20.0) as connection:
            connection.sendall(BEGINNING.replace(b"recordings", path.encode(), 1) + bytes(900_000))
            answered = False
            with suppress(BrokenPipeError, ConnectionResetError):
                for _ in range(drops):
                    answered = bool(select.select([connection], [], [], 0.01)[0])
                    if answered:
                        break
                    connection.sendall(b"x")
            assert answered == (drops > 0)  # while it drips
            answer = HTTPResponse(connection)
            answer.begin()
            assert (answer.status, b"came too slowly; send it again" in answer.read()) == (
                422,
                True,
            )
        assert left(service) == []
        upload(client, table.read_bytes())


def test_an_upload_whose_sender_goes_away_leaves_nothing(client, service, table):
    url = urlsplit(str(client.base_url))
    for _ in range(3):
        with socket.create_connection((url.hostname, url.port)) as connection:
            connection.sendall(BEGINNING + bytes(4_000_000))
    waited = threading.Event()
    for _ in range(100):
        if not left(service):
            break
        waited.wait(0.05)
    assert left(service) == []
    upload(client, table.read_bytes())


def test_a_full_disk_refuses_the_upload_and_keeps_the_rest(client, service, table, monkeypatch):
    upload(client, table.read_bytes())

    def refuse(*_: object) -> None:
        with errors.full_disk():
            raise OSError(28, "No space left on device")

    monkeypatch.setattr(recordings._Receiver, "flush", refuse)
    answer = send(client, b"time,x\n0,0\n" * 1000)
    assert answer.status_code == 507
    assert answer.json()["detail"] == "the server: has no space left; free some space and try again"
    monkeypatch.undo()
    assert left(service) == []
    assert len(recordings.latest(service.database, 10)) == 1


def test_a_disk_that_is_nearly_full_takes_nothing_more(settings, table):
    service = Service.open(replace(settings, limits=replace(LIMITS, free_bytes=2**60)))
    with listening(service) as client:
        assert send(client, table.read_bytes()).status_code == 507
        health = client.get("/healthz")
        assert health.status_code == 503
        assert health.json()["status"] == "failing"
        assert health.json()["uploads"] == "has no space left"
    service.close()


def test_an_upload_leaves_free_what_jobs_need(settings, table, monkeypatch):
    service = Service.open(replace(settings, limits=replace(LIMITS, free_bytes=5 * MIB), workers=0))

    def of_ten_mib(_: object) -> SimpleNamespace:
        taken = sum(file.stat().st_size for file in settings.incoming.iterdir())
        return SimpleNamespace(free=10 * MIB - taken)

    monkeypatch.setattr(shutil, "disk_usage", of_ten_mib)
    with listening(service) as client:
        assert send(client, bytes(9 * MIB)).status_code == 507
        assert left(service) == []
        upload(client, table.read_bytes())
    service.close()


def test_the_number_of_recordings_and_of_uploads_at_once_is_limited(settings, table):
    limits = replace(LIMITS, recordings=1, recordings_of_job=1)
    service = Service.open(replace(settings, limits=limits, workers=0))
    with listening(service) as client:
        first = upload(client, table.read_bytes())
        assert send(client, b"time,x\n1,2\n").status_code == 429
        assert client.get("/healthz").json()["uploads"] == "keeps 1 recordings"
        body = {"recordings": [first, "0" * 64]}
        assert client.post("/api/v1/jobs", json=body).status_code == 429
    service.close()


def test_what_a_killed_server_was_receiving_is_gone_when_it_starts_again(settings):
    settings.incoming.mkdir(parents=True)
    (settings.incoming / "half").write_bytes(bytes(1000))
    service = Service.open(settings)
    assert left(service) == []
    service.close()


@pytest.mark.usefixtures("real_inspection")
def test_a_card_has_the_page_s_fields_in_place_of_options(client):
    recording = upload(
        client, b"time,a,b\n" + b"".join(b"%d,1,2\n" % i for i in range(99)), "x.csv"
    )
    page = client.get("/", params={"r": recording}).text
    assert "a topic map (the setting &#39;topics&#39;)" in page
    assert not re.search("--[a-z]", page)


def test_a_refusal_on_a_page_names_no_command(client):
    page = client.get("/jobs/nobody", headers={"accept": "text/html"})
    assert (page.status_code, "list the jobs</" in page.text) == (404, True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name it in a topic map (--topics FILE)", "name it in a topic map (the setting 'topics')"),
        ("--holdout: holds out all", "what checks the fit: holds out all"),
        (
            "--fit: cannot stand beside --fix",
            "the setting 'free': cannot stand beside the setting 'fixed'",
        ),
        ("job x: is not here; list the jobs with tune jobs", "job x: is not here; list the jobs"),
        ("--fitness and --mass-error are none", "--fitness and --mass-error are none"),
    ],
)
def test_options_become_fields_of_the_page(text, words):
    assert on_the_web(text) == words


def test_over_http_a_message_names_the_keys_of_a_request():
    assert over_http("--holdout: holds out all; use --config FILE") == (
        "holdout: holds out all; use settings FILE"
    )
    assert "--" not in over_http("fix it with --fix mass, or use --force and --cross-validate")


def test_every_option_that_becomes_a_field_is_one():
    assert set(FIELD_PHRASES) <= set(Options.__dataclass_fields__)
