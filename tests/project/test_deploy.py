"""What a lab deploys the service with, as far as it can be held without a daemon to run it."""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DEPLOY = ROOT / "deploy"
UNIT = DEPLOY / "tune.service"
INSTRUCTIONS = (DEPLOY / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ").splitlines()


def instruction(name: str) -> list[str]:
    return [line.partition(" ")[2] for line in INSTRUCTIONS if line.startswith(f"{name} ")]


def started_by_the_unit() -> list[str]:
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    (starts,) = [line.partition("=")[2] for line in lines if line.startswith("ExecStart=")]
    return shlex.split(starts)


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


def test_the_image_starts_the_program() -> None:
    """How what it and the unit start fares: `tests.docs.test_service_commands`."""
    (entry,) = instruction("ENTRYPOINT")
    assert json.loads(entry) == ["tune"]
    assert Path(started_by_the_unit()[0]).name == "tune"


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
    with zipfile.ZipFile(tmp_path / built.stdout.splitlines()[-1]) as wheel:
        packages = {name.partition("/")[0] for name in wheel.namelist()}
    assert {"lanes", "sim_jax", "tuner"} <= packages
