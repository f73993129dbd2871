"""The tuning service: pages of a long table, a large upload, many submissions at once.

What fits takes no part in it: the table is filled by hand, and nothing is worked on.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import httpx
import uvicorn
from rosbags.rosbag1 import Reader, Writer
from rosbags.typesys import Stores, get_typestore

from benchmarks.reading import CIRCLE
from benchmarks.table import Bar, ResultSection
from tuner.service import jobs
from tuner.service.app import create_app
from tuner.service.database import JobRow, RecordingRow, State
from tuner.service.jobs import add_event
from tuner.service.request import JobRequest
from tuner.service.service import Service
from tuner.service.settings import GIB, MIB, ServiceLimits, ServiceSettings

JOBS = 10_000
CLIENTS = 100
UPLOAD = 2 * GIB
LIMITS = ServiceLimits(free_bytes=0, requests_in_a_burst=10**9, inspection_seconds=300.0)
PAGES = ("/api/v1/jobs", "/api/v1/jobs?state=done", "/api/v1/jobs?vehicle=quad%203", "/jobs")


@contextmanager
def served(service: Service) -> Iterator[httpx.Client]:
    """Serve from a thread, and yield a client."""
    config = uvicorn.Config(create_app(service), host="127.0.0.1", port=0, log_level="warning")
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run)
    thread.start()
    while not server.started:
        time.sleep(0.01)
    port = server.servers[0].sockets[0].getsockname()[1]
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=600.0) as client:
        yield client
    server.should_exit = True
    thread.join()


def fill(service: Service, count: int) -> None:
    """Enter jobs, each with its events and files as a short one has."""
    with service.database.writing() as session:
        session.add(
            RecordingRow(sha256="0" * 64, name="a.bag", size=1, uploaded=0.0, inspection={})
        )
    request = JobRequest(recordings=("0" * 64,))
    first = jobs.submit(service.database, request, LIMITS)[0]
    with service.database.writing() as session:
        for number in range(1, count):
            row = JobRow(
                id=f"{number:016x}",
                name=f"job {number}",
                vehicle=f"quad {number % 40}",
                state=State.DONE if number % 10 else State.FAILED,
                request={},
                submitted=first.submitted + number,
                rmse=0.001,
                iteration=50,
                deaths=0,
                events=0,
            )
            session.add(row)
            if number % 500 == 0:
                session.flush()
                add_event(session, row.number, "message", {"text": "done"})


def median_ms(client: httpx.Client, path: str) -> float:
    """Return the median time of an answer, ms."""
    times = []
    for _ in range(21):
        began = time.perf_counter()
        assert client.get(path).status_code == 200
        times.append(1000 * (time.perf_counter() - began))
    return sorted(times)[len(times) // 2]


def submissions(client: httpx.Client) -> tuple[int, float]:
    """Return the number of simultaneous submissions that are found again, and their time in s."""
    began = time.perf_counter()

    def submit(number: int) -> str:
        body = {"recordings": ["0" * 64], "name": f"at once {number}"}
        answer = client.post("/api/v1/jobs", json=body)
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    with ThreadPoolExecutor(CLIENTS) as pool:
        ids = set(pool.map(submit, range(CLIENTS)))
    took = time.perf_counter() - began
    return sum(client.get(f"/api/v1/jobs/{job}").status_code == 200 for job in ids), took


def upload(folder: Path) -> tuple[float, float, int]:
    """Return the largest memory of a server that receives a large recording (MiB), s, and status.

    The recording is the circle that ships with the project, with a camera's images added.
    """
    file = folder / "large.bag"
    with Reader(CIRCLE) as reader, Writer(file) as writer:
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
            for c in reader.connections
        }
        for connection, when, raw in reader.messages():
            writer.write(connections[connection.id], when, bytes(raw))
        types = get_typestore(Stores.ROS1_NOETIC)
        camera = writer.add_connection("/camera", "sensor_msgs/msg/Image", typestore=types)
        for _ in range(UPLOAD // MIB):
            writer.write(camera, when, bytes(MIB))
    code = (
        "import sys\nfrom pathlib import Path\nfrom tuner.service.app import serve\n"
        "from tuner.service.settings import *\n"
        "serve(ServiceSettings(Path(sys.argv[1]), limits=ServiceLimits(free_bytes=0)), "
        "host='127.0.0.1', port=0, say=lambda t: print(t, flush=True))"
    )
    command = [sys.executable, "-c", code, str(folder / "data")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        server.stdout.readline()
        url = server.stdout.readline().split()[1]
        began = time.perf_counter()
        with file.open("rb") as stream:
            files = {"file": ("large.bag", stream)}
            answer = httpx.post(f"{url}api/v1/recordings", files=files, timeout=900.0)
        took = time.perf_counter() - began
        status = Path(f"/proc/{server.pid}/status").read_text()
        peak = next(line for line in status.splitlines() if line.startswith("VmHWM"))
        server.terminate()
    return int(peak.split()[1]) / 1024, took, answer.status_code


def measure() -> ResultSection:
    """Return the tables of this part."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        service = Service.open(ServiceSettings(folder / "pages", workers=0, limits=LIMITS))
        fill(service, JOBS)
        with served(service) as client:
            rows = [[path, f"{median_ms(client, path):.1f}"] for path in PAGES]
            slowest = max(float(row[1]) for row in rows)
            found, seconds = submissions(client)
        service.close()
        memory, took, status = upload(folder)
    rows.append([f"{CLIENTS} submissions at once: found again {found}, s", f"{seconds:.2f}"])
    rows.append([f"upload of {UPLOAD // GIB} GiB, answered {status}, s", f"{took:.1f}"])
    rows.append(["largest memory of the server meanwhile, MiB", f"{memory:.0f}"])
    bars = [
        Bar(f"page of 50 of {JOBS} jobs, slowest, ms", slowest, 50.0, "at most"),
        Bar(
            f"{CLIENTS} submissions at once, found again",
            float(found),
            float(CLIENTS),
            "at least",
        ),
        Bar("memory of an upload of 2 GiB, MiB", memory, 300.0, "at most"),
    ]
    return ResultSection("The tuning service", "One server, SQLite.", ["", "measured"], rows, bars)
