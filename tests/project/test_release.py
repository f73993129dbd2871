"""What is released: one version, and a checkout and an sdist that work once they are installed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import venv
from pathlib import Path

import pytest
import yaml

from tests.docs.pages import Family, commands

ROOT = Path(__file__).resolve().parents[2]
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
    """Return a folder with the sdist, built from the files that git has."""
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
    script = "from setuptools import build_meta as b; b.build_sdist('../dist')"
    (folder / "dist").mkdir()
    subprocess.run(
        [sys.executable, "-c", script], cwd=source, check=True, capture_output=True, text=True
    )
    return folder / "dist"


SHIPPED = """
import lanes, sim_jax, tuner
from tuner.cli import main
from tuner.config import read_job
from tuner.core.shipped import configs_folder, find_config
from tuner.vehicle import read_vehicle
from tuner.recordings.topics import load_topic_map

print(read_vehicle(find_config("vehicles", "hovergames", configs_folder())).name)
print(read_job(configs_folder() / "tune.yaml").mass)
print(load_topic_map("thesis_lab").name)
print(lanes.__file__, sim_jax.__file__, tuner.__file__)
main(["new-vehicle", "--like", "hovergames", "--out", "quad.yaml"])
"""


INSTALL = (
    "git clone REPOSITORY tune && cd tune",
    "make demo",  # `tests.docs.test_setting_up` runs it
    "python3 -m venv .venv && . .venv/bin/activate",
    "pip install .",
    "pip install '.[service,matlab]'",  # the same, and more of a package index
)
"""What the page asks for that tells how to install."""
OFFLINE = {
    "PIP_NO_INDEX": "1",
    "PIP_NO_DEPS": "1",
    "PIP_NO_BUILD_ISOLATION": "0",  # as pip reads it: without one
    "PIP_IGNORE_INSTALLED": "1",
    "PIP_NO_COMPILE": "0",  # as pip reads it: none
    "PIP_QUIET": "1",
    "PIP_DISABLE_PIP_VERSION_CHECK": "1",
}


@pytest.mark.slow
@pytest.mark.parametrize("source", ["checkout", "sdist"])
def test_it_is_installed_and_works_in_a_clean_environment(
    built: Path, tmp_path: Path, source: str
) -> None:
    page = ROOT / "docs" / "tutorials" / "install.md"
    assert tuple(commands(page, Family.SET_UP)) == INSTALL
    clone, _, make_environment, install, _ = INSTALL
    (package,) = built.glob("*.tar.gz")
    assert VERSION in package.name
    environment = tmp_path / "tune" / ".venv"
    python, tune = (str(environment / "bin" / name) for name in ("python", "tune"))
    version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
    site = environment / "lib" / version / "site-packages"
    # what it depends on is this environment's, behind its own; of ours it has the package alone
    borrowed = sysconfig.get_path("purelib")
    borrow = f"echo {borrowed} > {site}/dependencies.pth && export PYTHONPATH={borrowed}"
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | OFFLINE
    clean["PATH"] = f"{Path(sys.executable).parent}:{clean['PATH']}"

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

    if source == "checkout":
        run("sh", "-c", f"{clone.replace('REPOSITORY', str(ROOT))} && test -f Makefile")
        shutil.rmtree(tmp_path / "tune")  # it is what was committed; what is here is tried
        shutil.copytree(built.parent / "source", tmp_path / "tune")
    else:
        venv.create(environment, with_pip=False)
        make_environment, install = ". .venv/bin/activate", f"python -m pip install {package}"
    run("sh", "-c", " && ".join(("cd tune", make_environment, borrow, install)))
    name, mass, topics, *where = run(python, "-c", SHIPPED).split()
    assert (name, mass, topics) == ("hovergames", "2.243", "thesis_lab")
    assert [place.startswith(str(site)) for place in where[:3]] == [True] * 3
    assert (tmp_path / "quad.yaml").exists()
    for folder in ("lanes", "sim_jax", "tuner"):
        for file in (ROOT / folder).rglob("*"):
            if file.is_file() and file.suffix != ".pyc":
                assert (site / file.relative_to(ROOT)).exists(), file
    assert run(tune, "--version").strip() == VERSION
    if source == "sdist":  # the same files, which have run
        return
    flown = ("--trajectory", "circle", "--duration", "2", "--out", "c.csv", "--forces", "f.csv")
    assert "written to" in run(tune, "simulate", *flown)
    assert (tmp_path / "f.csv").read_text().startswith("time,thrust_fx")


@pytest.mark.slow
def test_the_sdist_holds_what_building_needs_and_nothing_private(built: Path) -> None:
    (package,) = built.glob("*.tar.gz")
    with tarfile.open(package) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    needed = {"pyproject.toml", "setup.py", "README.md", "LICENSE", "configs/tune.yaml"}
    assert needed | {"tuner/cli/app.py", "sim_jax/rollout.py"} <= names
    assert not [name for name in names if name.startswith((".ci", "runs/", ".git", "tests/"))]
