"""What a lab deploys the service with, as far as it can be held without a daemon to run it."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="needs the extra 'service'")

from tuner.cli.app import app

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "tune.service"
INSTRUCTIONS = (DEPLOY / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ").splitlines()


def instruction(name: str) -> list[str]:
    return [line.partition(" ")[2] for line in INSTRUCTIONS if line.startswith(f"{name} ")]


def is_understood(words: list[str]) -> bool:
    command, bound, _ = app.parse_args(words, exit_on_error=False, print_error=False)
    return callable(command) and "port" in bound.arguments


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    program, unit = tmp_path / "tune", tmp_path / "tune.service"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    unit.write_text(
        UNIT.read_text(encoding="utf-8").replace("/opt/tune/bin/tune serve", f"{program} serve")
    )
    checked = subprocess.run(
        ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(unit)],
        check=False,
        capture_output=True,
        text=True,
    )
    assert (checked.returncode, checked.stderr) == (0, "")


def test_the_unit_and_the_image_start_what_there_is() -> None:
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    (starts,) = [line.partition("=")[2] for line in lines if line.startswith("ExecStart=")]
    assert is_understood(shlex.split(starts)[1:])
    (entry,), (command,) = instruction("ENTRYPOINT"), instruction("CMD")
    assert json.loads(entry) == ["tune"]
    assert is_understood(json.loads(command))
    (health,) = instruction("HEALTHCHECK")
    compile(json.loads(health.removeprefix("CMD "))[2], "HEALTHCHECK", "exec")


@pytest.mark.slow
def test_the_image_copies_what_building_needs(tmp_path: Path) -> None:
    source = tmp_path / "src"
    for words in map(str.split, instruction("COPY")):
        *copied, target = words
        place = tmp_path / target.strip("/")
        for name in copied:
            if (ROOT / name).is_dir():
                shutil.copytree(ROOT / name, place, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                place.mkdir(exist_ok=True)
                shutil.copy(ROOT / name, place)
    script = "from setuptools import build_meta as b; print(b.build_wheel('..'))"
    built = subprocess.run(
        [sys.executable, "-c", script], cwd=source, check=True, capture_output=True, text=True
    )
    assert built.stdout.splitlines()[-1].endswith(".whl")
