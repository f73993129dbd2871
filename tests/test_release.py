"""What is released: one version, a wheel and an sdist that work where nothing else of ours is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_changelog_begins_with_the_version() -> None:
    number, state = re.findall(r"^## (\S+) \(([^)]+)\)$", CHANGELOG, re.MULTILINE)[0]
    assert (f"{number}.dev0" if state == "unreleased" else number) == VERSION


def test_the_citation_is_of_the_last_release() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    releases = re.findall(r"^## (\S+) \((\d{4}-\d\d-\d\d)\)$", CHANGELOG, re.MULTILINE)
    assert (citation["version"], citation["date-released"]) == releases[0]


def test_no_module_states_the_version_again() -> None:
    packages = [*(ROOT / "tuner").rglob("*.py"), *(ROOT / "sim_jax").rglob("*.py")]
    assert not [path for path in packages if f'"{VERSION}"' in path.read_text(encoding="utf-8")]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel and the sdist, built from the files that git has."""
    pytest.importorskip("setuptools", minversion="77")
    folder = tmp_path_factory.mktemp("release")
    source = folder / "source"
    source.mkdir()
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=False, capture_output=True, text=True
    )
    if listed.returncode:
        pytest.skip("needs the project's repository")
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    for made in ("build_wheel", "build_sdist"):
        script = f"from setuptools import build_meta as b; b.{made}('../dist')"
        (folder / "dist").mkdir(exist_ok=True)
        subprocess.run(
            [sys.executable, "-c", script], cwd=source, check=True, capture_output=True, text=True
        )
    return folder / "dist"


SHIPPED = """
from tuner.config import read_job
from tuner.core.shipped import configs_folder, find_config
from tuner.vehicle import read_vehicle
from tuner.recordings.topics import load_topic_map

print(read_vehicle(find_config("vehicles", "hovergames", configs_folder())).name)
print(read_job(configs_folder() / "tune.yaml").mass)
print(load_topic_map("thesis_lab").name)
"""


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["whl", "tar.gz"])
def test_it_is_installed_and_works_in_a_clean_environment(
    built: Path, tmp_path: Path, suffix: str
) -> None:
    (package,) = built.glob(f"*.{suffix}")
    assert VERSION in package.name
    venv.create(tmp_path / "venv")
    python, tune = (str(tmp_path / "venv" / "bin" / name) for name in ("python", "tune"))
    # what it depends on is this environment's, behind its own; of ours it has the package alone
    (site,) = (tmp_path / "venv" / "lib").glob("python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}

    def run(*words: str) -> str:
        outcome = subprocess.run(
            [*words],
            cwd=tmp_path,
            env=clean,
            check=False,
            capture_output=True,
            text=True,
        )
        assert outcome.returncode == 0, outcome.stderr
        return outcome.stdout

    offline = ("--no-deps", "--no-index", "--no-build-isolation", "--quiet")
    pip = (sys.executable, "-m", "pip", "--python", str(python), "install", "--ignore-installed")
    run(*pip, *offline, str(package))
    where = run(str(python), "-c", "import tuner, sim_jax; print(tuner.__file__, sim_jax.__file__)")
    assert where.count(str(site)) == 2
    for folder in ("tuner", "sim_jax"):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and file.suffix != ".pyc":
                assert (site / file.relative_to(ROOT)).exists(), file
    assert run(str(python), "-c", SHIPPED).split() == ["hovergames", "2.243", "thesis_lab"]
    assert run(tune, "--version").strip() == VERSION
    flown = ("--trajectory", "circle", "--duration", "2", "--out", "c.csv", "--forces", "f.csv")
    assert "written to" in run(tune, "simulate", *flown)
    assert (tmp_path / "f.csv").read_text().startswith("time,thrust_fx")
    run(tune, "new-vehicle", "--like", "hovergames", "--out", "quad.yaml")


@pytest.mark.slow
def test_the_sdist_holds_what_building_needs_and_nothing_private(built: Path) -> None:
    (package,) = built.glob("*.tar.gz")
    with tarfile.open(package) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    needed = {"pyproject.toml", "setup.py", "README.md", "LICENSE", "configs/tune.yaml"}
    assert needed | {"tuner/cli/app.py", "sim_jax/rollout.py"} <= names
    assert not [name for name in names if name.startswith((".ci", "runs/", ".git", "tests/"))]
