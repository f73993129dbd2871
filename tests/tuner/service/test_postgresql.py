"""The same on a real PostgreSQL, where its programs are installed."""

from __future__ import annotations

import os
import pwd
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.tuner.service import test_jobs as on_sqlite
from tests.tuner.service.conftest import ended, listening, submit, upload
from tests.tuner.service.test_reliability import (
    check_all_done_once,
    free_port,
    killed_again_and_again,
)
from tests.tuner.service.test_reliability import (
    test_many_servers_share_one_table_and_no_job_is_claimed_twice as check_claims,
)
from tests.tuner.service.test_reliability import (
    test_only_the_attempt_that_the_table_names_can_commit as check_commits,
)
from tests.tuner.service.test_reliability import (
    test_the_migrations_make_the_tables_of_this_program as check_migrations,
)
from tuner.service.service import Service

pytest.importorskip("psycopg", reason="needs the extra 'postgresql'")


def programs() -> Path | None:
    """Return the folder of the newest PostgreSQL."""
    debian = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda p: int(p.parent.name))
    found = shutil.which("initdb")
    return debian[-1] if debian else Path(found).parent if found else None


PROGRAMS = programs()
pytestmark = pytest.mark.skipif(
    PROGRAMS is None, reason="needs PostgreSQL's programs (Debian: apt-get install postgresql)"
)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """A server of PostgreSQL that ends with the tests; it refuses to be root's."""
    assert PROGRAMS is not None
    as_user = {}
    if os.getuid() == 0:
        try:
            as_user = {"user": pwd.getpwnam("postgres").pw_name}
        except KeyError:
            pytest.skip("PostgreSQL does not run as root, and there is no user 'postgres'")
    folder = Path(tempfile.mkdtemp(prefix="tune-pg-"))
    if as_user:
        shutil.chown(folder, **as_user)
    port = free_port()

    def call(program: str, *arguments: str) -> None:
        command = [str(PROGRAMS / program), "-D", str(folder / "data"), *arguments]
        subprocess.run(
            command, check=True, cwd=folder, stdout=subprocess.DEVNULL, timeout=60, **as_user
        )

    call("initdb", "-U", "tune", "-A", "trust", "--no-sync")
    options = f"-p {port} -k {folder} -h 127.0.0.1 -c fsync=off"
    call("pg_ctl", "-w", "-l", str(folder / "log"), "-o", options, "start")
    yield f"postgresql://tune@127.0.0.1:{port}/"
    call("pg_ctl", "-m", "immediate", "stop")
    shutil.rmtree(folder)


@pytest.fixture
def url(cluster: str, request: pytest.FixtureRequest) -> str:
    """A database of its own for each test."""
    import psycopg  # noqa: PLC0415

    name = f"t{abs(hash(request.node.name))}"
    with psycopg.connect(cluster + "postgres", autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    return cluster + name


@pytest.fixture
def service(settings, url) -> Iterator[Service]:
    opened = Service.open(replace(settings, database=url))
    yield opened
    opened.close()


@pytest.fixture
def idle(settings, url) -> Iterator[Service]:
    opened = Service.open(replace(settings, database=url, workers=0))
    yield opened
    opened.close()


@pytest.fixture
def recording(client, table):
    return upload(client, table.read_bytes())


def test_jobs_go_their_way(client, recording):
    on_sqlite.test_a_job_goes_from_the_recording_to_its_files(client, recording)
    on_sqlite.test_events_tell_the_whole_story_and_go_on_from_any_of_them(client, recording)
    on_sqlite.test_a_worker_that_dies_once_goes_on_from_its_checkpoint(client, recording)
    on_sqlite.test_the_same_submission_twice_is_one_job(client, recording)
    on_sqlite.test_cancelling_stops_the_worker_and_a_retry_goes_on(client, recording)
    assert client.get("/api/v1/vehicles/hovergames/history").status_code == 200
    assert client.get("/api/v1/jobs", params={"vehicle": "\x00"}).json()["jobs"] == []
    assert client.get("/api/v1/vehicles/%00/history").status_code == 404
    assert client.get("/api/v1/recordings/%00").status_code == 404


def test_claims_commits_and_migrations(idle):
    check_migrations(idle)
    check_claims(idle)
    check_commits(idle)


def test_two_servers_work_off_one_table(service, settings, url, tmp_path, table):
    beside = replace(settings, data=tmp_path / "other", store=str(service.settings.data / "store"))
    other = Service.open(replace(beside, database=url))
    with listening(service) as first, listening(other) as second:
        recording = upload(first, table.read_bytes())
        ids = [submit(client, recording) for client in (first, second) * 6]
        assert {ended(second, job)["state"] for job in ids} == {"done"}
    other.close()


@pytest.mark.slow
def test_a_server_that_is_killed_loses_nothing(tmp_path, url, table):
    check_all_done_once(killed_again_and_again(tmp_path / "data", table, kills=1, database=url))
