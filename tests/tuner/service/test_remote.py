"""Jobs that an engine has worked on elsewhere: files by way of the store, checkpoints too."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

from tests.tuner.service.conftest import ended, listening, submit, upload
from tuner.engine.engine import Engine
from tuner.service.service import Service

pytest.importorskip("tuner.engine.dask_engine", reason="needs the extra 'cluster'")


class StoppedError(Exception):
    """A task was cancelled."""


class Threads(Engine):
    """An engine whose machines are threads, which share nothing with the server but the store."""

    at_once = 2

    def __init__(self) -> None:
        self._pool = ThreadPoolExecutor(2)
        self.stopped = 0

    def submit(self, function: Any, task: Any, on_report: Any = None) -> Future[Any]:
        outcome: Future[Any] = Future()

        def report(message: Any) -> None:
            if outcome.cancelled():
                self.stopped += 1
                raise StoppedError
            on_report(message)

        def run() -> None:
            try:
                result = function(task, report)
            except StoppedError:
                return
            except BaseException as error:
                outcome.set_exception(error)
            else:
                outcome.set_result(result)

        self._pool.submit(run)
        return outcome

    def share(self, value: Any) -> Any:
        return lambda: value


@pytest.fixture
def engine():
    return Threads()


@pytest.fixture
def service(settings, engine):
    opened = Service.open(settings, engine)
    yield opened
    opened.close()


@pytest.fixture
def client(service):
    with listening(service) as opened:
        yield opened


def test_a_result_comes_back_through_the_store(client, table, service):
    job = ended(client, submit(client, upload(client, table.read_bytes())))
    assert (job["state"], job["iteration"], job["log"]) == ("done", 5, ["begins at 0"])
    assert client.get(job["links"]["files"]["report.html"]).status_code == 200
    assert list(service.settings.work.iterdir()) == []


def test_a_machine_that_dies_is_followed_by_one_that_goes_on(client, table):
    job = submit(client, upload(client, table.read_bytes()), namespace="die once")
    done = ended(client, job)
    assert done["state"] == "done"
    assert [line for line in done["log"] if line.startswith("begins")] in (
        ["begins at 0", "begins at 1"],
        ["begins at 1"],
    )


def test_a_job_that_is_cancelled_stops_there(client, table, engine):
    job = submit(client, upload(client, table.read_bytes()), namespace="slow")
    while not client.get(f"/api/v1/jobs/{job}").json()["iteration"]:
        time.sleep(0.05)
    client.post(f"/api/v1/jobs/{job}/cancel")
    until = time.monotonic() + 60
    while not engine.stopped:
        assert time.monotonic() < until
        time.sleep(0.05)
    client.post(f"/api/v1/jobs/{job}/retry")
    again = ended(client, job)
    assert again["state"] == "done"
    assert again["log"][-1] != "begins at 0"
