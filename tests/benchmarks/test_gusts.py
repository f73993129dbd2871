"""The table of draws counts right, and a draw that is not followed counts as least squares."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from benchmarks.gusts import BARS, Draw, section, truth
from tuner.uncertainty.records import ErrorParts


def drawn(off: float, *, followed: bool) -> Draw:
    """Return a draw that least squares misses by ten times what the filter does."""
    known = {name: truth()[name] for name in BARS}
    estimates = {
        name: SimpleNamespace(
            value=value * (1.0 + off),
            ci95=((0.99 + off) * value, (1.01 + off) * value),
            parts=ErrorParts(noise=0.005 * value, residuals=0.005 * value, left_out=None),
        )
        for name, value in known.items()
    }
    simulated = {name: value * (1.0 + 10.0 * off) for name, value in known.items()}
    return Draw(simulated, cast(Any, estimates) if followed else None, (5.0, 60.0))


def row(draws: list[Draw], name: str) -> list[str]:
    return next(list(row) for row in section(draws).rows if row[0] == name)


def test_spreads_are_those_of_what_the_runs_would_give():
    draws = [drawn(off, followed=True) for off in (-0.02, 0.0, 0.005)]
    name, _, plain, _, spread, noise, half, held = row(draws, "inertia_xx")
    expected = 100.0 * np.std([-0.02, 0.0, 0.005], ddof=1)
    assert float(spread.split()[0]) == pytest.approx(expected, rel=0.02)
    assert float(plain.split()[0]) == pytest.approx(10.0 * expected, rel=0.02)
    assert (noise, half, held) == ("0.5 %", "1 %", "2 of 3")
    bars = {bar.what: bar for bar in section(draws).bars}
    assert len(bars) == len(BARS)
    assert bars[f"spread of {name} over draws of gusts"].measured == pytest.approx(expected)


def test_a_draw_that_is_not_followed_is_that_of_least_squares():
    draws = [drawn(0.0, followed=True), drawn(0.01, followed=False)]
    assert float(row(draws, "inertia_xx")[4].split()[0]) == pytest.approx(
        100.0 * np.std([0.0, 0.1], ddof=1), rel=0.02
    )
    assert "which 1 fits keep" in section(draws).text
