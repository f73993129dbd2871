"""Jobs through the HTTP interface: shapes, states, deaths, cancelling, trying again."""

import html
import io
import json
import random
import re
import subprocess
import sys
import time
import zipfile
from concurrent.futures import ThreadPoolExecutor

import pytest

from tests.tuner.service.conftest import ended, submit, upload
from tuner.cli import remote
from tuner.report.outcome import outcome
from tuner.result import RunResult
from tuner.service import dispatcher, http, jobs
from tuner.service.database import FileRow, JobRow, State
from tuner.service.dispatcher import AttemptReporter, put

KEYS = {
    "id",
    "name",
    "state",
    "stage",
    "iteration",
    "rmse",
    "seconds_left",
    "submitted",
    "started",
    "ended",
    "error",
    "files",
}


@pytest.fixture
def recording(client, table):
    return upload(client, table.read_bytes())


def test_a_job_goes_from_the_recording_to_its_files(client, recording):
    answer = client.post("/api/v1/jobs", json={"recordings": [recording], "name": "first"})
    assert answer.status_code == 202
    assert set(answer.json()) == {"id", "state", "links"}
    job = ended(client, answer.json()["id"])
    assert set(job) >= KEYS
    assert (job["state"], job["name"], job["error"], job["exit_status"]) == (
        "done",
        "first",
        None,
        0,
    )
    assert (job["iteration"], job["rmse"], job["seconds_left"]) == (5, 0.1 / 5, 0.0)
    assert job["submitted"] <= job["started"] <= job["ended"]
    assert job["files"] == ["best_fit.yaml", "plots/one.svg", "report.html", "result.json"]
    assert job["log"] == ["begins at 0"]
    for name, link in job["links"]["files"].items():
        file = client.get(link)
        assert file.status_code == 200
        assert ("attachment" in file.headers.get("content-disposition", "")) != (
            name == "report.html"
        )
    content = client.get(job["links"]["files"]["result.json"]).json()
    assert RunResult.model_validate(content).coefficients["motor_constant"].best == 1e-7


@pytest.mark.parametrize(
    ("wish", "usability", "look"),
    [("none", "usable with care", "weak"), ("crash", "not usable", "not")],
)
def test_lists_say_whether_a_result_can_be_used(
    *, client, recording, capsys, wish, usability, look
):
    job = ended(client, submit(client, recording, namespace=wish))
    assert job["usability"] == usability
    badge = f'<span class="badge {look}">done, {usability}</span>'
    for place in ("/", "/jobs", f"/jobs/{job['id']}"):
        assert badge in client.get(place).text
    remote.watch(job["id"], server=str(client.base_url))
    assert f"is done, {usability}; its result comes with" in capsys.readouterr().out


def test_every_file_is_served_where_it_reaches_nothing(client, recording):
    job = ended(client, submit(client, recording))
    for link in job["links"]["files"].values():
        policy = client.get(link).headers["content-security-policy"]
        assert policy.startswith("sandbox allow-scripts")
        assert "default-src 'none'" in policy
        assert "connect-src" not in policy
        assert "allow-same-origin" not in policy


def test_events_tell_the_whole_story_and_go_on_from_any_of_them(client, recording):
    job = submit(client, recording)
    text = client.get(f"/api/v1/jobs/{job}/events").text
    events = [
        dict(line.split(": ", 1) for line in block.split("\n"))
        for block in text.split("\n\n")
        if block
    ]
    kinds = [event["event"] for event in events if "id" in event]
    assert kinds == ["state", "state", "message", *["iteration"] * 5, "estimates", "state"]
    assert [int(event["id"]) for event in events if "id" in event] == list(range(1, 11))
    last = json.loads([event for event in events if event["event"] == "job"][-1]["data"])
    assert last["state"] == "done"
    rest = client.get(f"/api/v1/jobs/{job}/events", headers={"Last-Event-ID": "9"}).text
    assert rest.count("event: iteration") == 0
    assert '"state": "done"' in rest


def test_a_worker_that_dies_once_goes_on_from_its_checkpoint(client, recording):
    job = ended(client, submit(client, recording, namespace="die once"))
    assert job["state"] == "done"
    assert job["log"][0] == "begins at 0"
    assert "SIGKILL" in job["log"][1]
    assert "goes on from its checkpoint" in job["log"][1]
    assert job["log"][2] == "begins at 1"


def test_a_worker_that_dies_before_it_reads_is_a_death(client, recording, monkeypatch):
    class Gone(subprocess.Popen):
        def __init__(self, *args, **more):
            super().__init__(*args, **more)
            self.wait()

    monkeypatch.setattr(dispatcher, "WORKER", [sys.executable, "-c", ""])
    monkeypatch.setattr(dispatcher.subprocess, "Popen", Gone)
    job = ended(client, submit(client, recording))
    assert job["error"].startswith("its worker died 3 times; the last time it ended with status 0")


def test_three_deaths_are_the_end_with_the_reason(client, recording):
    job = ended(client, submit(client, recording, namespace="die"))
    assert job["state"] == "failed"
    assert job["error"].startswith("its worker died 3 times; the last time it was ended by SIGKILL")
    assert job["exit_status"] == 1
    assert "tune_worker_deaths_total 3.0" in client.get("/metrics").text


@pytest.mark.parametrize(
    ("wish", "status", "error"),
    [
        ("refuse", 2, "flights: nothing moves; fly a circle"),
        ("fault", 1, "internal error (ZeroDivisionError: division by zero); please report it"),
    ],
)
def test_what_a_worker_refuses_is_the_error_of_the_job(client, recording, wish, status, error):
    job = ended(client, submit(client, recording, namespace=wish))
    assert (job["state"], job["exit_status"], job["error"]) == ("failed", status, error)
    assert job["files"] == []


def test_cancelling_stops_the_worker_and_a_retry_goes_on(client, recording):
    job = submit(client, recording, namespace="slow")
    while not client.get(f"/api/v1/jobs/{job}").json()["iteration"]:
        time.sleep(0.02)
    assert client.post(f"/api/v1/jobs/{job}/retry").status_code == 409
    cancelled = client.post(f"/api/v1/jobs/{job}/cancel").json()
    assert (cancelled["state"], cancelled["exit_status"]) == ("cancelled", 130)
    again = client.post(f"/api/v1/jobs/{job}/cancel")
    assert again.status_code == 409
    assert again.json()["detail"] == f"job {job}: is cancelled; there is nothing left to cancel"
    retried = client.post(f"/api/v1/jobs/{job}/retry").json()["state"]
    assert retried in {"queued", "running"}  # a free worker may have taken it already
    done = ended(client, job)
    assert done["state"] == "done"
    begins = [line for line in done["log"] if line.startswith("begins")]
    assert begins[0] == "begins at 0"
    assert begins[1] != "begins at 0"
    result = client.get(done["links"]["files"]["result.json"]).json()
    assert result["coefficients"]["motor_constant"]["best"] == sum(range(40)) * 1e-8


def test_sixty_jobs_at_once_are_all_done(client, recording):
    with ThreadPoolExecutor(16) as pool:
        jobs = list(pool.map(lambda n: submit(client, recording, name=f"job {n}"), range(60)))
    assert len(set(jobs)) == 60
    for job in jobs:
        assert ended(client, job, within=120)["state"] == "done"
    seen, after = [], None
    while True:
        page = client.get("/api/v1/jobs", params={"after": after} if after else {}).json()
        seen += [job["id"] for job in page["jobs"]]
        assert len(page["jobs"]) <= 50
        after = page["next"]
        if after is None:
            break
    assert sorted(seen) == sorted(jobs)


def test_the_same_submission_twice_is_one_job(client, recording):
    body = {"recordings": [recording]}
    with ThreadPoolExecutor(8) as pool:
        answers = list(
            pool.map(
                lambda _: client.post(
                    "/api/v1/jobs", json=body, headers={"Idempotency-Key": "abc"}
                ),
                range(8),
            )
        )
    assert {answer.status_code for answer in answers} == {202}
    assert len({answer.json()["id"] for answer in answers}) == 1
    assert sum("idempotent-replayed" in answer.headers for answer in answers) == 7
    other = client.post("/api/v1/jobs", json=body)
    changed = body | {"mass": 2.5}  # as on a page that the browser went back to
    heavier = client.post("/api/v1/jobs", json=changed, headers={"Idempotency-Key": "abc"})
    assert len({answer.json()["id"] for answer in (answers[0], other, heavier)}) == 3


def test_a_list_is_narrowed_by_vehicle_and_state(client, recording):
    small = ended(client, submit(client, recording, vehicle="crazyflie"))["id"]
    failed = ended(client, submit(client, recording, namespace="refuse"))["id"]
    listed = lambda **by: [j["id"] for j in client.get("/api/v1/jobs", params=by).json()["jobs"]]  # noqa: E731
    assert listed() == [failed, small]
    assert listed(vehicle="crazyflie") == [small]
    assert listed(state="failed") == [failed]
    assert listed(vehicle="crazyflie", state="failed") == []
    assert listed(vehicle="\x00") == []
    assert client.get("/api/v1/jobs", params={"after": "nobody"}).status_code == 404


def test_the_history_of_a_vehicle_has_every_job_with_its_interval(client, recording):
    jobs = [ended(client, submit(client, recording, name=f"day {n}"))["id"] for n in range(3)]
    ended(client, submit(client, recording, vehicle="crazyflie"))
    history = client.get("/api/v1/vehicles/hovergames/history").json()
    found = history["coefficients"]["motor_constant"]
    assert found["unit"] == "N s²/rad²"
    assert [point["job"] for point in found["points"]] == jobs
    assert found["points"][0]["ci95"] == [8e-8, 1.2e-7]
    assert found["points"][0]["flights"] == ["hop"]
    assert client.get("/api/v1/vehicles/nobody/history").status_code == 404


def test_what_goes_with_the_mass_is_compared_at_one_mass(client, recording):
    jobs = [ended(client, submit(client, recording, mass=mass))["id"] for mass in (2.0, 2.5)]
    history = client.get("/api/v1/vehicles/hovergames/history").json()
    assert history["mass"] == 2.5
    assert list(history["coefficients"]) == ["motor_constant"]
    points = history["coefficients"]["motor_constant"]["points"]
    assert [point["mass"] for point in points] == [2.0, 2.5]
    assert points[0]["best"] == pytest.approx(points[1]["best"]) == 1.25e-7
    assert points[0]["std_error"] == pytest.approx(1.25e-8)
    assert points[0]["ci95"] == pytest.approx([1e-7, 1.5e-7])
    assert "at 2.5 kg" in client.get("/vehicles/hovergames").text
    page = client.get("/compare", params={"a": jobs[0], "b": jobs[1]}).text
    assert all(words in page for words in ("2 kg", "2.5 kg", "motor_constant*", "+0.00 %", ">0.0<"))
    assert "motor_constant*" not in client.get("/compare", params={"a": jobs[0], "b": jobs[0]}).text


def test_what_is_found_after_a_long_search_reaches_the_log(idle, monkeypatch):
    monkeypatch.setattr(jobs, "MAX_EVENTS", 10)
    with idle.database.writing() as session:
        row = JobRow(id="0" * 16, name="x", vehicle="x", request={}, submitted=0.0)
        session.add(row)
        session.flush()
        for kind in ["iteration"] * 15 + ["message"]:
            jobs.add_event(session, row.number, kind, {"text": "a flight got worse"})
    found = jobs.events(idle.database, row)
    assert [event.kind for event in found] == ["iteration"] * 10 + ["message"]
    (late,) = jobs.events(idle.database, row, most=1, kind="message")
    assert late.content["text"] == "a flight got worse"


def test_an_attempt_repeats_nothing_that_one_before_it_said(client, recording):
    job = submit(client, recording, namespace="refuse")
    ended(client, job)
    client.post(f"/api/v1/jobs/{job}/retry")
    log = ended(client, job)["log"]
    assert log == ["begins at 0"]


def test_what_happens_again_after_the_preamble_is_said_again(idle):
    step = {"stage": "whole length", "number": 1, "position_rmse": 0.1, "seconds_left": 2.0}
    said, iteration = ("message", {"text": "the flights"}), ("iteration", step)
    worse = ("message", {"text": "a flight got worse"})
    with idle.database.writing() as session:
        row = JobRow(id="0" * 16, name="x", vehicle="x", request={}, submitted=0.0)
        row.state, row.deaths, row.events = State.QUEUED, 0, 0
        session.add(row)
    jobs_queue = jobs.JobQueue(idle.database, "here", 60.0)
    for _ in range(3):
        claim = jobs_queue.claim()
        AttemptReporter(jobs_queue, claim, 60.0)([said, said, iteration, worse, said])
        jobs_queue.give_back(claim, message="gone")
    texts = [e.content["text"] for e in jobs.events(idle.database, row, kind="message")]
    again = ["a flight got worse", "the flights", "gone"]
    assert texts == ["the flights", "the flights", *again, *again, *again]


def test_an_earlier_job_s_vehicle_is_known_by_its_name(client, recording, updated):
    own = updated.model_dump(mode="json", exclude_none=True) | {"name": "quad 7/8"}
    submit(client, recording, vehicle=own)
    ended(client, submit(client, recording, vehicle="quad 7/8"))
    assert len(client.get("/api/v1/jobs", params={"vehicle": "quad 7/8"}).json()["jobs"]) == 2
    assert client.get("/api/v1/vehicles/quad%207%2F8/history").status_code == 200
    assert client.get("/vehicles/quad%207/8").status_code == 200


def test_health_and_counters(client, recording):
    ended(client, submit(client, recording))
    assert client.get("/healthz").json()["status"] == "ok"
    assert client.request("INVENTED", "/healthz").status_code == 405
    text = client.get("/metrics").text
    assert "INVENTED" not in text  # each would be counted on its own
    assert 'tune_jobs{state="done"} 1.0' in text
    assert 'route="/api/v1/jobs/{job}"' in text
    assert "tune_uploaded_bytes_total" in text


def test_all_files_come_as_one_archive_under_plain_names(client, recording):
    job = ended(client, submit(client, recording))
    answer = client.get(f"/api/v1/jobs/{job['id']}/files.zip")
    assert answer.headers["content-type"] == "application/zip"
    assert "content-length" not in answer.headers  # it is made while it is sent
    with zipfile.ZipFile(io.BytesIO(answer.content)) as opened:
        assert opened.testzip() is None
        names = {name.removeprefix(f"{job['id']}/"): name for name in opened.namelist()}
        assert set(names) == set(job["links"]["files"])
        for name, link in job["links"]["files"].items():
            assert opened.read(names[name]) == client.get(link).content
    waiting = submit(client, recording, namespace="slow")
    early = client.get(f"/api/v1/jobs/{waiting}/files.zip")
    assert (early.status_code, early.json()["what"]) == (404, "has no files")


def test_an_archive_unpacks_nowhere_else_and_is_made_block_by_block(idle, tmp_path, monkeypatch):
    monkeypatch.setattr(http, "BLOCK_BYTES", 1000)
    content = random.Random(1).randbytes(50_000)
    (tmp_path / "x").write_bytes(content)
    digest = put(tmp_path / "x", idle.store)
    names = ("../../x", "/etc/x", "a/../x", "C:\\x", "plots/\0.svg")
    rows = [FileRow(name=name, sha256=digest, size=50_000) for name in names]
    blocks = list(http.zip_stream(idle.store, rows, "job"))
    assert max(map(len, blocks)) < 40_000  # compression's window; a file at once has more
    with zipfile.ZipFile(io.BytesIO(b"".join(blocks))) as opened:
        made = opened.namelist()
        assert [opened.read(name) for name in made] == [content] * len(names)
    assert all(re.fullmatch(r"job(/\w[\w.-]*)+", name, re.ASCII) for name in made)


def test_a_job_s_page_begins_with_the_report_s_outcome_and_its_files(client, recording):
    job = ended(client, submit(client, recording))
    page = client.get(f"/jobs/{job['id']}").text
    result = RunResult.model_validate(client.get(job["links"]["files"]["result.json"]).json())
    box = html.unescape(page.partition('id="outcome"')[2].partition("</section>")[0])
    found = outcome(result)
    assert f'<p class="standing">{found.usability.capitalize()}</p>' in box
    assert all(sentence in box for sentence in (found.what, *found.uses, *found.reasons))
    assert page.index('id="outcome"') < page.index("<iframe")
    assert page.index("/files.zip") < page.index("<iframe")
