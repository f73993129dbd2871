"""A service whose workers fit nothing, and recordings that take no simulation."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="needs the extra 'service'")

import httpx
import uvicorn

from tests.tuner.service import serving
from tests.tuner.service.serving import FAKE_WORKER
from tuner.service import dispatcher, http, recordings
from tuner.service.app import HttpConnection, create_app
from tuner.service.service import Service
from tuner.service.settings import ServiceLimits, ServiceSettings

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
LIMITS = ServiceLimits(free_bytes=0)


@pytest.fixture(autouse=True)
def _quick_worker(monkeypatch, request):
    if "real_worker" not in request.fixturenames:
        monkeypatch.setattr(dispatcher, "WORKER", FAKE_WORKER)


@pytest.fixture(autouse=True)
def _quick_looks(monkeypatch):
    """Have the table of jobs looked at more often than a person would notice."""
    for module in (dispatcher, http):
        monkeypatch.setattr(module, "POLL_INTERVAL_S", 0.05)


@pytest.fixture(autouse=True)
def _quick_inspection(monkeypatch, request):
    if "real_inspection" not in request.fixturenames:
        monkeypatch.setattr(recordings, "inspect", serving.found_in_a_table)


@pytest.fixture
def real_inspection():
    """Have recordings inspected in earnest."""


@pytest.fixture
def real_worker():
    """Have jobs fitted in earnest."""


@pytest.fixture
def settings(tmp_path) -> ServiceSettings:
    return ServiceSettings(tmp_path / "data", workers=2, limits=LIMITS)


@pytest.fixture
def service(settings) -> Iterator[Service]:
    opened = Service.open(settings)
    yield opened
    opened.close()


@pytest.fixture
def idle(settings) -> Iterator[Service]:
    """A service that works on nothing."""
    opened = Service.open(replace(settings, workers=0))
    yield opened
    opened.close()


class _Server(uvicorn.Server):
    """One that ends at once: uvicorn's own looks every tenth of a second, and waits for another."""

    async def main_loop(self) -> None:
        await self.on_tick(0)
        while not self.should_exit:
            await asyncio.sleep(0.005)

    async def shutdown(self, sockets=None) -> None:  # noqa: ARG002
        for server in self.servers:
            server.close()
        for connection in list(self.server_state.connections):
            connection.shutdown()
        while self.server_state.connections or self.server_state.tasks:
            await asyncio.sleep(0.005)
        await self.lifespan.shutdown()


@contextmanager
def listening(service: Service) -> Iterator[httpx.Client]:
    """Serve from a thread, and yield a client of it."""
    config = uvicorn.Config(
        create_app(service), host="127.0.0.1", port=0, http=HttpConnection, log_level="warning",
        server_header=False,
    )  # fmt: skip
    server = _Server(config)
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    limits = httpx.Limits(max_connections=200)
    address = f"http://127.0.0.1:{port}"
    with httpx.Client(base_url=address, timeout=60.0, limits=limits, verify=False) as opened:
        yield opened
    service.stopping.set()
    server.should_exit = True
    thread.join()


@pytest.fixture
def client(service) -> Iterator[httpx.Client]:
    with listening(service) as opened:
        yield opened


@pytest.fixture(scope="session")
def table(tmp_path_factory) -> Path:
    """The smallest recording: a table of poses."""
    path = tmp_path_factory.mktemp("lab") / "hop.csv"
    rows = ["time,x,y,z,qw,qx,qy,qz"]
    rows += [f"{0.01 * i},{0.001 * i},0,1,1,0,0,0" for i in range(300)]
    path.write_text("\n".join(rows) + "\n")
    return path


def upload(client: httpx.Client, content: bytes, name: str = "hop.csv") -> str:
    """Upload a recording and return its id."""
    answer = client.post("/api/v1/recordings", files={"file": (name, content)})
    assert answer.status_code in (200, 201), answer.text
    return answer.json()["id"]


def submit(client: httpx.Client, recording: str, **more: object) -> str:
    """Submit a job and return its id."""
    answer = client.post("/api/v1/jobs", json={"recordings": [recording], **more})
    assert answer.status_code == 202, answer.text
    return answer.json()["id"]


def ended(client: httpx.Client, job: str, within: float = 20.0) -> dict:
    """Return a job once it has ended."""
    until = time.monotonic() + within
    while time.monotonic() < until:
        found = client.get(f"/api/v1/jobs/{job}").json()
        if found["ended"] is not None:
            return found
        time.sleep(0.05)
    raise AssertionError(found)
