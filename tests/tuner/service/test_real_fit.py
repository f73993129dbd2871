"""A real fit whose worker, and whose server, is killed half-way: the same as one left in peace."""

from __future__ import annotations

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from tests.tuner.service.conftest import ended, submit, upload
from tests.tuner.service.test_reliability import free_port, server

WITHIN = 1200.0
"""s for a fit on a busy machine."""
HALF_WAY = 3
"""Iterations of the search."""
JOB = {
    "vehicle": "hovergames",
    "settings": {"free": ["motor_constant", "estimate_latency"], "terms": "none"},
}


def half_way(client: httpx.Client, job: str) -> None:
    """Wait until a search is under way."""
    until = time.monotonic() + WITHIN
    while (client.get(f"/api/v1/jobs/{job}").json()["iteration"] or 0) < HALF_WAY:
        assert time.monotonic() < until
        time.sleep(0.02)


def worker_of(server: int) -> int:
    """Return the process that fits the only job of a server."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # a process of somebody else's has ended meanwhile
            parent = (folder / "stat").read_text().rpartition(")")[2].split()[1]
            is_worker = b"tuner.service.worker" in (folder / "cmdline").read_bytes()
            if parent == str(server) and is_worker:
                found.append(int(folder.name))
    (worker,) = found
    return worker


def coefficients(client: httpx.Client, job: dict) -> dict:
    assert job["state"] == "done", job["error"]
    return client.get(job["links"]["files"]["result.json"]).json()["coefficients"]


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="needs /proc")
def test_a_fit_that_was_killed_half_way_ends_as_one_that_was_not(tmp_path, bag):
    data, port = tmp_path / "data", free_port()
    visiting = {"base_url": f"http://127.0.0.1:{port}", "timeout": 60}
    with server(data, port, real=True) as process, httpx.Client(**visiting) as client:
        recording = upload(client, bag.read_bytes(), name=bag.name)
        in_peace = coefficients(client, ended(client, submit(client, recording, **JOB), WITHIN))
        job = submit(client, recording, **JOB)
        half_way(client, job)
        os.kill(worker_of(process.pid), signal.SIGKILL)
        bereaved = ended(client, job, WITHIN)
        assert any("The worker died (it was ended by SIGKILL" in line for line in bereaved["log"])
        assert coefficients(client, bereaved) == in_peace
        job = submit(client, recording, **JOB)
        half_way(client, job)
        process.kill()
        process.join()
    with server(data, port, real=True), httpx.Client(**visiting) as client:
        orphaned = ended(client, job, WITHIN)
        assert any("has gone; it goes on" in line for line in orphaned["log"])
        assert coefficients(client, orphaned) == in_peace
    assert in_peace["motor_constant"]["best"] != in_peace["motor_constant"]["initial"]
