"""What pages say of the service: servers start and answer, commands ask one that fits nothing."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="needs the extra 'service'")

import httpx

from tests.docs.pages import ROOT, WITH_COMMANDS, Family, commands, expanded, name_of
from tests.project.test_deploy import instruction, started_by_the_unit
from tests.tuner.service.conftest import FAKE_WORKER, LIMITS, listening, submit, upload
from tuner.cli import main
from tuner.service import dispatcher
from tuner.service.service import Service
from tuner.service.settings import ServiceSettings

pytestmark = pytest.mark.slow

PATIENCE = 60.0
"""s for a process to begin."""
ASKING = [page for page in WITH_COMMANDS if commands(page, Family.SERVICE)]
SHOWN = list(dict.fromkeys(line for page in ASKING for line in commands(page, Family.SERVICE)))
TOKENS = "tune serve token"
SERVING = [line for line in SHOWN if line.startswith("tune serve") and TOKENS not in line]
WATCHING = [line for line in SHOWN if line.startswith("tune watch-folder")]
DEPLOYED = [
    shlex.join(["tune", *json.loads(instruction("CMD")[0])]),
    shlex.join(["tune", *started_by_the_unit()[1:]]),
]
IN_CONTAINER = "docker run --rm -v tune:/data tune "
JOB = re.compile(r"\bJOB\b|\b3f2a91c05d7e4b68\b")
STARTER = """
import json, os, socket, sys
import tuner.service.app
from tuner.cli import main

port, commands = json.load(sys.stdin)
connect = socket.create_connection
socket.create_connection = lambda address, *more, **options: connect(
    ("127.0.0.1", port) if address[0] == "lab" else address, *more, **options
)
for folder, words in commands:
    if not os.fork():
        os.chdir(folder)
        os.environ["XDG_DATA_HOME"] = folder
        for descriptor in (1, 2):
            os.dup2(os.open("said", os.O_WRONLY | os.O_CREAT | os.O_APPEND), descriptor)
        os._exit(main(words))
for _ in commands:
    os.wait()
"""
"""Starts commands side by side, each in a folder of its own; the host ``lab`` is a port here."""


def in_its_folder(line: str, folder: Path) -> list[str]:
    """Return a command's words, with the folders of a machine inside a folder, without a port."""
    here = re.sub(r" (/srv|/data|/var/lib)\b", rf" {folder}\1", line)
    return shlex.split(here.replace("--port 8000", ""))[1:]


@contextmanager
def running(lines: list[list[str]], folders: list[Path], port: int = 0) -> Iterator[None]:
    """Start commands that do not end by themselves, and end them."""
    process = subprocess.Popen(
        [sys.executable, "-c", STARTER],
        stdin=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert process.stdin is not None
    process.stdin.write(json.dumps((port, list(zip(map(str, folders), lines, strict=True)))))
    process.stdin.close()
    try:
        yield
    finally:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(timeout=PATIENCE)


def awaited(found: Callable[[], object]) -> object:
    until = time.monotonic() + PATIENCE
    while not (outcome := found()):
        assert time.monotonic() < until
        time.sleep(0.05)
    return outcome


def address_said_in(folder: Path, host: str) -> str:
    """Return where a server listens that says a host's name, once it has."""

    def said() -> re.Match[str] | None:
        file = folder / "said"
        return re.search(r"Open http://(.+):(\d+)/", file.read_text() if file.exists() else "")

    address = awaited(said)
    assert isinstance(address, re.Match)
    assert address[1] == host
    return f"http://127.0.0.1:{address[2]}"


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder of somebody who has used no service yet, who is there."""
    for name in ("configs", "reference_flights"):
        (tmp_path / name).symlink_to(ROOT / name)
    for name in ("runs", "lab"):
        (tmp_path / name).mkdir()
    (tmp_path / "lab" / "spin.bag").symlink_to(ROOT / "reference_flights" / "yaw_spin_3rps.bag")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    return tmp_path


@pytest.fixture
def client(place: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[httpx.Client]:
    """Ask a server whose workers fit nothing, as the commands do."""
    monkeypatch.setattr(dispatcher, "WORKER", FAKE_WORKER)
    service = Service.open(ServiceSettings(place / "data", workers=2, limits=LIMITS))
    with listening(service) as opened:
        monkeypatch.setenv("TUNE_SERVER", str(opened.base_url))
        yield opened
    service.close()


def called(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """Call a command, and return what it prints."""
    assert main(words) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_servers_start_and_demand_tokens_where_others_can_ask(
    place: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [*SERVING, *DEPLOYED]
    assert len(lines) > len(DEPLOYED) + 5
    folders = [place / f"server_{i}" for i in range(len(lines))]
    words = [in_its_folder(*pair) for pair in zip(lines, folders, strict=True)]
    tokens = {}
    for line, folder, arguments in zip(lines, folders, words, strict=True):
        folder.mkdir()
        (folder / "configs").symlink_to(ROOT / "configs")
        if "--host 0.0.0.0" in line or "--tokens always" in line:
            monkeypatch.setenv("XDG_DATA_HOME", str(folder))
            assert main(arguments) == 2  # nobody could ask it
            data = ["--data", arguments[arguments.index("--data") + 1]] if "--data" in line else []
            tokens[line] = called(["serve", "token", "add", "anna", *data], capsys).strip()
    (health,) = instruction("HEALTHCHECK")
    with running([[*arguments, "--port", "0"] for arguments in words], folders):
        for line, folder in zip(lines, folders, strict=True):
            everywhere = "--host 0.0.0.0" in line
            address = address_said_in(folder, socket.gethostname() if everywhere else "127.0.0.1")
            jobs = f"{address}/api/v1/jobs"
            get = partial(httpx.get, verify=False)  # which reads no certificates
            assert get(jobs).status_code == (401 if line in tokens else 200), line
            token = {"authorization": f"Bearer {tokens.get(line, 'none')}"}
            assert get(jobs, headers=token).json()["jobs"] == [], line
            for host in re.findall(r"--allow-host (\S+)", line):
                assert get(jobs, headers={**token, "host": host}).is_success, line
                other = get(jobs, headers={**token, "host": f"not.{host}"})
                assert not other.is_success, line
            check = json.loads(health.removeprefix("CMD "))[2]
            exec(check.replace("http://127.0.0.1:8000", address), {})


def test_tokens_are_added_and_removed(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    deployed = [
        line.removeprefix(IN_CONTAINER).rpartition("/opt/tune/bin/tune ")[2]
        for page in WITH_COMMANDS
        for line in commands(page, Family.SET_UP)
        if "serve token" in line
    ]
    assert len(deployed) == 2
    for line in [*(line for line in SHOWN if TOKENS in line), *(f"tune {d}" for d in deployed)]:
        said = called(in_its_folder(line, place), capsys)
        assert re.search(r"tune_[\w-]{20,}" if " add " in line else "no token any more", said)


def test_a_folder_that_fills_itself_is_watched(place: Path, client: httpx.Client) -> None:
    folders = [place / f"watched_{i}" for i in range(len(WATCHING))]
    for i, folder in enumerate(folders):
        shutil.copytree(place / "lab", folder / "lab", symlinks=True)
        (folder / "lab" / "spin.bag").rename(folder / "lab" / f"spin_{i}.bag")
    words = [[*shlex.split(line)[1:], "--settle", "0.1"] for line in WATCHING]

    def submitted() -> bool:
        return len(client.get("/api/v1/jobs").json()["jobs"]) == len(WATCHING) > 1

    with running(words, folders, client.base_url.port or 0):
        awaited(submitted)


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize("page", ASKING, ids=name_of)
def test_its_commands_talk_to_a_server(
    page: Path,
    client: httpx.Client,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    lines = [line for line in commands(page, Family.SERVICE) if not line.startswith("tune serve")]
    lines = [line for line in lines if line not in WATCHING]
    if not lines:
        pytest.skip("it shows servers and tokens alone")
    connect, there = socket.create_connection, ("127.0.0.1", client.base_url.port)
    monkeypatch.setattr(
        socket,
        "create_connection",
        lambda address, *more, **options: connect(
            there if address[0] == "lab" else address, *more, **options
        ),
    )
    job = ""
    for line in lines:
        if line.startswith("tune cancel"):
            spin = Path("lab/spin.bag").read_bytes()
            job = submit(client, upload(client, spin, "spin.bag"), namespace="slow")
        assert called(expanded(JOB.sub(job, line)), capsys) or " --state " in line
        if line.startswith("tune submit"):
            job = client.get("/api/v1/jobs").json()["jobs"][0]["id"]
    assert client.get(f"/api/v1/jobs/{job}").json()["state"] == "cancelled"
    (fetched,) = (line for line in lines if line.startswith("tune fetch"))
    assert Path(shlex.split(fetched)[-1], "result.json").exists()
