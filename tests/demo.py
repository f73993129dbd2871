"""The fit of ``make demo``, made once a test run for all tests and processes that look at it."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path

import pytest

from tests.memory import BEFORE_A_FIT, give_back
from tuner.result import RunResult, read_run

FLIGHTS = Path(__file__).parents[1] / "reference_flights"


@pytest.fixture(scope="session")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, RunResult]:
    """Return the result folder, and its result; the flights' paths count from the root."""
    from tuner.cli.progress import profiling  # noqa: PLC0415
    from tuner.config import Options  # noqa: PLC0415 (jax)
    from tuner.job.run import run  # noqa: PLC0415

    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    folder = shared / "demo"
    with (shared / "demo.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / RunResult.FILE).exists():
            give_back(BEFORE_A_FIT)
            bags = [str(path) for path in sorted(FLIGHTS.glob("*.bag"))]
            with profiling(True, quiet=True) as profile_into:
                run(Options(bags), out=folder)
                profile_into(folder)
    return folder, read_run(folder).result
