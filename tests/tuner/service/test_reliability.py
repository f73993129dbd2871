"""Servers that are killed, claims that run out, databases that are locked or gone."""

from __future__ import annotations

import atexit
import multiprocessing
import os
import random
import socket
import sqlite3
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import SimpleNamespace

import httpx
import pytest

from tests.tuner.service import serving
from tests.tuner.service.conftest import LIMITS, ended, listening, submit, upload
from tuner.core.errors import InputError
from tuner.service import database as database_module
from tuner.service import dispatcher, jobs
from tuner.service.database import Base, Database, RecordingRow, State
from tuner.service.jobs import AttemptOutcome, Claim, JobQueue
from tuner.service.request import JobRequest
from tuner.service.service import Service

KILLS = 20
STARTING = multiprocessing.get_context("forkserver")
"""Starts processes that have imported a server already: most of what it takes to start one."""
STARTING.set_forkserver_preload([serving.__name__])


def free_port() -> int:
    """Return a port that stays bound, so that no other process gets it; a server may listen."""
    held = socket.socket()
    held.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    held.bind(("127.0.0.1", 0))
    atexit.register(held.close)
    return int(held.getsockname()[1])


def asking(port: int) -> httpx.Client:
    """Return a client of a server here, which reads no certificates."""
    return httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30, verify=False)


@contextmanager
def server(
    data: Path, port: int, database: str = "", *, real: bool = False
) -> Iterator[BaseProcess]:
    """Start a server, and wait until it answers; its workers fit nothing unless they are real."""
    told = {"data": data, "database": database, "real": real}
    process = STARTING.Process(target=serving.serve_at, args=(port,), kwargs=told)
    process.start()
    try:
        until = time.monotonic() + 60
        while True:
            try:
                if httpx.get(f"http://127.0.0.1:{port}/healthz", verify=False).status_code == 200:
                    break
            except httpx.TransportError:
                assert process.is_alive()
                assert time.monotonic() < until
                time.sleep(0.05)
        yield process
    finally:
        process.kill()
        process.join()


def killed_again_and_again(data: Path, table: Path, kills: int, database: str = "") -> list[dict]:
    """Submit a job a life, kill the server at a random moment of each, and return all jobs."""
    port, chance, ids = free_port(), random.Random(7), []
    for _ in range(kills):
        with server(data, port, database) as process:
            with asking(port) as client:
                recording = upload(client, table.read_bytes())
                ids.append(submit(client, recording, namespace="slow"))
                while (
                    len(ids) == 1 and not client.get(f"/api/v1/jobs/{ids[0]}").json()["iteration"]
                ):
                    time.sleep(0.02)
                time.sleep(chance.uniform(0.0, 1.5))
            process.kill()
            process.join()
    with (
        server(data, port, database),
        asking(port) as client,
    ):
        return [ended(client, job, within=120) for job in ids]


def check_all_done_once(found: list[dict]) -> None:
    """Nothing is lost, nothing failed, and nothing came to another result by being interrupted."""
    assert [job["state"] for job in found] == ["done"] * len(found)
    assert any("has gone; it goes on" in line for job in found for line in job["log"])


def results_in(data: Path) -> dict[str, int]:
    """Return how often each result stands in a table, and that its sum is the whole one."""
    with sqlite3.connect(data / "tune.sqlite") as table:
        fitted = "SELECT job, best FROM points WHERE coefficient = 'motor_constant'"
        rows = table.execute(fitted).fetchall()
        ends = table.execute(
            "SELECT job, COUNT(*) FROM events WHERE kind = 'state' AND content LIKE '%done%' "
            "GROUP BY job"
        ).fetchall()
    table.close()
    assert {best for _, best in rows} == {sum(range(40)) * 1e-8}
    assert {count for _, count in ends} == {1}
    return dict(ends)


def test_a_server_that_is_killed_loses_nothing_and_does_nothing_twice(tmp_path, table):
    found = killed_again_and_again(tmp_path / "data", table, kills=1)
    check_all_done_once(found)
    assert len(results_in(tmp_path / "data")) == 1


@pytest.mark.long
@pytest.mark.slow
def test_a_server_that_is_killed_at_twenty_random_moments(tmp_path, table):
    found = killed_again_and_again(tmp_path / "data", table, kills=KILLS)
    check_all_done_once(found)
    assert len(results_in(tmp_path / "data")) == KILLS


def test_workers_end_with_their_server_and_a_stopped_server_leaves_its_jobs(tmp_path, table):
    data, port = tmp_path / "data", free_port()
    with server(data, port) as process, asking(port) as client:
        job = submit(client, upload(client, table.read_bytes()), namespace="slow")
        while not client.get(f"/api/v1/jobs/{job}").json()["iteration"]:
            time.sleep(0.05)
        began = time.monotonic()
        process.terminate()
        process.join(timeout=15)
        assert time.monotonic() - began < 10
    with sqlite3.connect(data / "tune.sqlite") as rows:
        assert rows.execute("SELECT state, deaths, claim FROM jobs").fetchall() == [
            ("queued", 0, None)
        ]
    rows.close()
    with server(data, port), asking(port) as client:
        assert ended(client, job)["state"] == "done"


def enter(service: Service, count: int = 1, **more: object) -> list[str]:
    """Enter jobs without a server."""
    with service.database.writing() as session:
        row = RecordingRow(sha256="0" * 64, name="a.csv", size=1, uploaded=0.0, inspection={})
        session.merge(row)
    request = JobRequest(recordings=("0" * 64,), **more)
    return [jobs.submit(service.database, request, LIMITS)[0].id for _ in range(count)]


def test_many_servers_share_one_table_and_no_job_is_claimed_twice(idle):
    entered = enter(idle, 24)
    queues = [JobQueue(idle.database, f"server {n}", 30.0) for n in range(8)]
    with ThreadPoolExecutor(8) as pool:
        claims = list(pool.map(lambda n: queues[n % 8].claim(), range(32)))
    taken = [claim.id for claim in claims if claim is not None]
    assert sorted(taken) == sorted(entered)


def test_only_the_attempt_that_the_table_names_can_commit(idle):
    (job,) = enter(idle)
    first = JobQueue(idle.database, "first", lease=0.01)
    second = JobQueue(idle.database, "second", lease=30.0)
    old = first.claim()
    time.sleep(0.05)
    assert second.recover(own=False) == 1
    new = second.claim()
    points = [{"coefficient": "mass", "unit": "kg", "best": 1.0}]
    assert not first.report(old, [("message", {"text": "late"})])
    assert not first.finish(old, AttemptOutcome(State.DONE, exit_status=0, points=points))
    assert not first.give_back(old, message="late")
    assert second.finish(new, AttemptOutcome(State.DONE, exit_status=0, points=points))
    assert not second.finish(new, AttemptOutcome(State.FAILED, "again"))
    row = jobs.job(idle.database, job)
    assert (row.state, row.iteration, row.error) == ("done", None, None)
    assert [e.content for e in jobs.events(idle.database, row) if e.kind == "message"] == [
        {"text": "The server that worked on this job has gone; it goes on from its checkpoint."}
    ]


def test_a_lease_that_is_renewed_is_not_taken_away(idle, monkeypatch):
    enter(idle)
    clock = SimpleNamespace(now=time.time())
    monkeypatch.setattr("tuner.service.jobs.time", SimpleNamespace(time=lambda: clock.now))
    first, second = JobQueue(idle.database, "a", 0.2), JobQueue(idle.database, "b", 0.2)
    claim = first.claim()
    for _ in range(4):
        clock.now += 0.1
        assert first.report(claim, [])
        clock.now += 0.1
        assert second.recover(own=False) == 0
    clock.now += 0.3
    assert second.recover(own=False) == 1


def test_a_result_that_takes_longer_to_store_than_a_lease_holds_is_not_fitted_again(
    settings, table, monkeypatch
):
    store = dispatcher._store_files

    def slowly(*arguments):
        time.sleep(2.5)
        return store(*arguments)

    monkeypatch.setattr(dispatcher, "_store_files", slowly)
    service = Service.open(replace(settings, lease_seconds=1.5))
    with listening(service) as client:
        done = ended(client, submit(client, upload(client, table.read_bytes())))
        assert (done["state"], done["log"]) == ("done", ["begins at 0"])


@pytest.mark.usefixtures("service")
def test_a_folder_has_one_server(settings):
    with pytest.raises(InputError, match="is used by another server; stop that one"):
        Service.open(settings)


def test_the_migrations_make_the_tables_of_this_program(idle):
    from alembic.autogenerate import compare_metadata  # noqa: PLC0415
    from alembic.migration import MigrationContext  # noqa: PLC0415

    idle.database.migrate()  # as a server that is started again
    with idle.database.reading() as session:
        context = MigrationContext.configure(session.connection())
        assert compare_metadata(context, Base.metadata) == []
        assert context.get_current_revision() == "0003"


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (
            lambda file: sqlite3.connect(file, isolation_level=None).execute(
                "UPDATE alembic_version SET version_num = '9999'"
            ),
            "the database: was made by another version of tune; use that version",
        ),
        (lambda file: file.write_bytes(b"no table" * 999), "the database: is damaged, or no data"),
    ],
)
def test_a_database_that_cannot_be_migrated_is_told(settings, spoil, said):
    Service.open(settings).close()
    file = settings.data / "tune.sqlite"
    spoil(file)
    with pytest.raises(InputError, match=said):
        Database(f"sqlite:///{file}").migrate()


def test_a_job_of_another_version_ends_in_words(idle, tmp_path):
    claim = Claim(1, "a", "b", 0, {"gone": 1}, {}, {})
    with pytest.raises(InputError, match="was submitted to another version of tune; submit it"):
        dispatcher.prepare(tmp_path, claim, idle.store)


def test_a_locked_database_is_told_and_nothing_is_lost(client, service, table, monkeypatch):
    recording = upload(client, table.read_bytes())
    monkeypatch.setattr(database_module, "MAX_LOCK_WAIT_S", 0.1)
    job = submit(client, recording, namespace="slow")
    while not client.get(f"/api/v1/jobs/{job}").json()["iteration"]:
        time.sleep(0.02)
    service.database.close()  # connections made from now on wait for a tenth of a second only
    other = sqlite3.connect(service.settings.data / "tune.sqlite", isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    refused = client.post("/api/v1/jobs", json={"recordings": [recording]})
    assert refused.status_code == 503
    assert refused.json()["detail"] == (
        "the database: is locked by another program; close that, or try again in a minute"
    )
    assert client.get("/api/v1/jobs").status_code == 200  # readers go on
    time.sleep(0.5)
    other.execute("ROLLBACK")
    other.close()
    assert ended(client, job)["state"] == "done"
    assert ended(client, submit(client, recording))["state"] == "done"


def test_a_database_that_is_gone_is_told_and_comes_back(settings, table, tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    url = f"sqlite:///{folder / 'tune.sqlite'}"
    service = Service.open(replace(settings, database=url))
    with listening(service) as client:
        job = submit(client, upload(client, table.read_bytes()), namespace="slow")
        service.database.close()
        folder.rename(tmp_path / "away")
        service.database.close()
        health = client.get("/healthz")
        assert health.status_code == 503
        assert health.json()["database"] == "cannot be reached"
        assert client.get("/api/v1/jobs").json()["detail"].startswith("the database: cannot be")
        page = client.get("/jobs", headers={"accept": "text/html"})
        assert (page.status_code, "cannot be reached" in page.text) == (503, True)
        time.sleep(1.0)
        (tmp_path / "away").rename(folder)
        assert ended(client, job)["state"] == "done"
    service.close()


def test_a_disk_that_fills_while_a_result_is_stored_fails_the_job_and_a_retry_ends_it(
    client, table, monkeypatch
):
    recording = upload(client, table.read_bytes())

    def refuse(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    with monkeypatch.context() as full:
        full.setattr("tuner.service.dispatcher.shutil.copyfile", refuse)
        job = ended(client, submit(client, recording))
    assert (job["state"], job["exit_status"], job["files"]) == ("failed", 2, [])
    assert "has no space left; free some space and try again" in job["error"]
    client.post(f"/api/v1/jobs/{job['id']}/retry")
    again = ended(client, job["id"])
    assert again["state"] == "done"
    assert again["log"][-1] == "begins at 5"


def test_what_is_so_every_second_is_logged_once_in_a_while(caplog, monkeypatch):
    clock = iter((0.0, 1.0, 1.0, 599.0, 601.0))
    monkeypatch.setattr(dispatcher, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    for line in ("full", "full", "away", "full", "full"):
        dispatcher.logger.warning(line)
    assert caplog.messages == ["full", "away", "full"]


@pytest.mark.parametrize("url", ["mysql://x/y", "nonsense", "sqlite+nothing://"])
def test_another_kind_of_database_is_refused_in_words(url):
    with pytest.raises(InputError, match="--database: is no URL of SQLite or PostgreSQL"):
        Database(url)
