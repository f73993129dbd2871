"""A report that is rendered once for the tests that read it."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.tuner.report import making
from tuner.report import render
from tuner.uncertainty.verdict import Direction

FREE = (
    "inertia_xx",
    "input_scaling",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
    "estimate_latency",
)


ROLLING = Direction(
    moves={"rolling_moment_coefficient": 1.0}, error=2.0, null=True, common_scale=False
)


@pytest.fixture(scope="session")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    making.write_run(folder, FREE, ROLLING)
    return render(folder)
