"""Global sensitivity on a problem whose order of importance is known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.objective.normal_equations import Objective
from tuner.uncertainty.records import (
    GlobalSensitivity,
    Method,
)
from tuner.uncertainty.sensitivity import _log_rmse, global_sensitivity

FREE = ("motor_constant", "moment_constant", "rolling_moment_coefficient")


@pytest.fixture(scope="module")
def objective() -> Objective:
    return making.problem(FREE, seed=0)


def indices(objective: Objective, method: Method, samples: int) -> GlobalSensitivity:
    bounds = {p.name: (p.initial / 1.3, p.initial * 1.3) for p in objective.space.parameters}
    return global_sensitivity(
        objective,
        making.truth(objective),
        making.criterion_of(objective),
        method=method,
        flights=making.FLIGHTS,
        bounds=bounds,
        samples=samples,
    )


@pytest.mark.parametrize(
    ("method", "samples", "simulations"), [("morris", 4, 16), ("sobol", 7, 40)]
)
def test_indices_rank_the_most_influential_coefficient_first(
    objective: Objective, method: Method, samples: int, simulations: int, tmp_path: Path
) -> None:
    result = indices(objective, method, samples)
    assert result.simulations == simulations
    total = {index.coefficient: index.total for index in result.indices if not index.flight}
    assert total["motor_constant"] > 10 * total["rolling_moment_coefficient"]
    spin = {
        index.coefficient: index.total
        for index in result.indices
        if (index.flight, index.channel) == ("spin", "body_rate")
    }
    assert spin["moment_constant"] > spin["rolling_moment_coefficient"]
    assert indices(objective, method, samples) == result
    result.write(tmp_path)
    assert GlobalSensitivity.read(tmp_path) == result
    lines = (tmp_path / "global_sensitivity.csv").read_text().splitlines()
    assert len(lines) == 1 + len(FREE) * (1 + 8)


def test_a_crash_counts_as_no_better_than_the_worst_that_flew(objective: Objective) -> None:
    channels = objective.segments.measured
    squares = {name: np.ones((3, m.weight.shape[1], 2)) for name, m in channels.items()}
    for sums in squares.values():
        sums[1] = 100.0
        sums[2] = np.nan
    crashed = np.array([[True, False], [False, False], [False, False]])
    names, values = _log_rmse(objective, squares, crashed, making.FLIGHTS)
    swing = names.index(("swing", "position"))
    spin = names.index(("spin", "position"))
    assert values[0, swing] == values[1, swing]  # it fell on the swing
    assert values[0, spin] < values[1, spin]  # and flew the spin
    assert values[2, swing] == values[1, swing]  # not a number is a failure too
    assert np.isfinite(values).all()
