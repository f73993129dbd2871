"""Commands of pages that are not `tune`'s own: they are run in a sandbox, or it is said why not."""

from __future__ import annotations

import re
import shutil
import tomllib
from pathlib import Path

import pytest

from tests.docs.checkout import make_checkout, typed
from tests.docs.pages import DOCS, ROOT, WITH_COMMANDS, Family, commands
from tests.docs.recorded import write_lab

pytestmark = pytest.mark.slow

FOR_HOURS = re.compile(r"make bench$|(TUNE_LAB_\S+=(\$\(.*\)|\S+) )*python -m benchmarks( |$)")
"""What measures for minutes or hours, on whichever flights; `tests/benchmarks` holds its parts."""
NO_NETWORK = "a package index; that the extra exists is tested here"
NOT_RUN = {
    "make lint": "a minute of mypy; `.ci/run` runs it before the tests",
    "make docs": "`test_site.py` runs it",
    "python -m docs.generate": "`make docs` runs it",
    "python -m tests.golden_check FOLDER": "`tests/sim_jax/test_golden.py` runs it",
    "python -m build": "the package index; `test_release.py` calls the backend that it calls",
    "python examples/published_experiments.py": "`tests/examples` runs it",
    "pytest tests/tuner/ground/test_coverage.py": "one of these tests",
    "pytest tests/tuner/uncertainty/test_monte_carlo.py": "one of these tests",
    "pip install 'multirotor-tune[cluster]'": NO_NETWORK,
    "pip install 'multirotor-tune[postgresql]'": NO_NETWORK,
    "pip install 'multirotor-tune[service]'": NO_NETWORK,
    "pip install '.[service,matlab]'": NO_NETWORK,
    "pip install s3fs": "a package index; `test_object_store.py` uses it where it is installed",
    "python3 -m venv /opt/tune && /opt/tune/bin/pip install 'multirotor-tune[service]'": NO_NETWORK,
    "cp tune.service /etc/systemd/system/ && systemctl enable --now tune": (
        "systemd; `test_deploy.py` has it verify the unit, `test_service_commands.py` starts it"
    ),
    "sudo -u tune /opt/tune/bin/tune serve token add alice --data /var/lib/tune": (
        "`test_service_commands.py` runs it without sudo"
    ),
    "docker build -f deploy/Dockerfile -t tune .": (
        "a daemon of Docker; `test_deploy.py` builds the package from what the image copies"
    ),
    "docker run --rm -v tune:/data tune serve token add alice --data /data": (
        "a daemon of Docker; `test_service_commands.py` runs it without"
    ),
    "docker run -d -p 8000:8000 -v tune:/data tune": (
        "a daemon of Docker; `test_service_commands.py` runs it without"
    ),
}
"""Command -> what it needs that a test has not, and what is tested instead."""
SHOWN = list(
    dict.fromkeys(line for page in WITH_COMMANDS for line in commands(page, Family.SET_UP))
)
INSTALL = commands(DOCS / "tutorials" / "install.md", Family.SET_UP)
"""`tests.project.test_release` follows this page, in an environment of its own."""
AT_LENGTH = "python -m benchmarks.targets RUN"
"""What fits effective coefficients for each simulator, as `tests/tuner/exporters` does for some."""
RUN = [
    "make demo",
    *(
        line
        for line in SHOWN
        if line not in (*NOT_RUN, *INSTALL, AT_LENGTH) and not FOR_HOURS.match(line)
    ),
]


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a checkout with short flights and one short test."""
    place = make_checkout(tmp_path_factory.mktemp("checkout"))
    (place / "tests").mkdir()
    (place / "tests" / "__init__.py").symlink_to(ROOT / "tests" / "__init__.py")
    (place / "tests" / "test_one.py").write_text("def test_one():\n    assert True\n")
    write_lab(place / "reference_flights")
    for name in ("tune.yaml", "truth.yaml"):
        shutil.copy(ROOT / "reference_flights" / name, place / "reference_flights")
    (place / "RUN").symlink_to("runs/demo")  # of `make demo`, which is run first
    return place


@pytest.mark.parametrize("line", [*RUN, pytest.param(AT_LENGTH, marks=pytest.mark.long)])
def test_a_command_runs(line: str, checkout: Path) -> None:
    if line == AT_LENGTH and not (checkout / "RUN").exists():  # of the long tests alone
        typed("make demo", checkout)
    typed(line, checkout)


def test_what_is_not_run_is_shown_and_what_is_installed_exists() -> None:
    assert set(NOT_RUN) <= set(SHOWN)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = {
        name
        for line in SHOWN
        for asked in re.findall(r"\[([\w,]+)\]'", line)
        for name in asked.split(",")
    }
    assert named
    assert named <= set(extras["optional-dependencies"])
