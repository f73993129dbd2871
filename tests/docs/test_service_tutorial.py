"""The tutorial of the service, against a server whose workers fit nothing."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="needs the extra 'service'")

import httpx

from tests.docs.pages import DOCS, ROOT, commands
from tests.tuner.service.conftest import FAKE_WORKER, LIMITS, listening
from tuner.cli import main
from tuner.service import attempt
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings

PAGE = DOCS / "tutorials" / "service.md"
TUNE = (sys.executable, "-c", "import sys; from tuner.cli import main; sys.exit(main())")
RUN_FOREVER = ("tune serve", "tune serve --host 0.0.0.0", "tune watch-folder lab/")
PATIENCE = 60.0
"""s for a process to begin."""


@contextmanager
def running(line: str, *more: str) -> Iterator[subprocess.Popen[str]]:
    """Start a command that does not end by itself, and end it."""
    words = shlex.split(line)[1:]
    process = subprocess.Popen([*TUNE, *words, *more], stdout=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        process.terminate()
        process.communicate(timeout=PATIENCE)


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of somebody who has used no service yet, who is there."""
    (tmp_path / "reference_flights").symlink_to(ROOT / "reference_flights")
    (tmp_path / "runs").mkdir()
    (tmp_path / "lab").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "share"))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    return tmp_path


def address_said_by(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    for line in process.stdout:
        if found := re.search(r"Open http://[^:]+:(\d+)/", line):
            return f"http://127.0.0.1:{found[1]}"
    raise AssertionError("it ended before it served")


def called(line: str, capsys: pytest.CaptureFixture[str]) -> str:
    """Call a command as typed, and return what it prints."""
    assert main(shlex.split(line)[1:]) == 0, capsys.readouterr().err
    return capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.usefixtures("place")
def test_a_server_starts_for_this_machine_and_with_a_token_for_others(
    capsys: pytest.CaptureFixture[str],
) -> None:
    alone, for_others, _ = RUN_FOREVER
    with running(alone, "--port", "0") as process:
        assert httpx.get(f"{address_said_by(process)}/api/v1/jobs").json()["jobs"] == []
    assert main(shlex.split(for_others)[1:]) == 2
    (line,) = [line for line in commands(PAGE) if line.startswith("tune serve token add")]
    (token,) = re.findall(r"tune_[\w-]{20,}", called(line, capsys))
    with running(for_others, "--port", "0") as process:
        jobs = f"{address_said_by(process)}/api/v1/jobs"
        assert httpx.get(jobs).status_code == 401
        assert httpx.get(jobs, headers={"authorization": f"Bearer {token}"}).status_code == 200


@pytest.mark.slow
def test_a_folder_that_fills_itself_is_watched(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(attempt, "WORKER", FAKE_WORKER)
    service = Service.open(ServiceSettings(place / "data", workers=2, limits=LIMITS))
    (place / "lab" / "spin.bag").symlink_to(ROOT / "reference_flights" / "yaw_spin_3rps.bag")
    with listening(service) as client:
        monkeypatch.setenv("TUNE_SERVER", str(client.base_url))
        with running(RUN_FOREVER[2], "--settle", "0.1"):
            until = time.monotonic() + PATIENCE
            while not (jobs := client.get("/api/v1/jobs").json()["jobs"]):
                assert time.monotonic() < until
                time.sleep(0.1)
    service.close()
    assert len(jobs) == 1


def test_what_runs_for_ever_is_in_the_tutorial() -> None:
    assert set(RUN_FOREVER) <= set(commands(PAGE))


@pytest.mark.slow
def test_its_commands_talk_to_a_server(
    place: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(attempt, "WORKER", FAKE_WORKER)
    service = Service.open(ServiceSettings(place / "data", workers=2, limits=LIMITS))
    job = ""
    with listening(service) as client:
        monkeypatch.setenv("TUNE_SERVER", str(client.base_url))
        for line in commands(PAGE):
            if line not in RUN_FOREVER:
                said = called(line.replace("JOB", job), capsys)
                job = next(iter(re.findall(r"job ([0-9a-f]{16})", said)), job)
    assert (place / "runs" / "from_server" / "result.json").exists()
