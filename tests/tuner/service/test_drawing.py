"""Charts of the service's pages."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.service.shapes import CoefficientHistory, Point
from tuner.service.web.comparison import history_bars


def point(best: float, half: float) -> Point:
    return Point(
        mass=None,
        job="0" * 16,
        name="day",
        flown=None,
        ended="2026-01-01T00:00:00Z",
        best=best,
        std_error=half / 2,
        ci95=(best - half, best + half),
        identifiable=True,
        flights=["hop"],
    )


@given(
    best=st.floats(1e-6, 1e4),
    sign=st.sampled_from([1, -1]),
    width=st.floats(1e-6, 2.0),
    moved=st.floats(0.0, 3.0),
)
def test_numbers_at_an_axis_differ_and_stand_where_they_belong(
    best: float, sign: int, width: float, moved: float
) -> None:
    half = best * width
    points = [point(sign * best, half), point(sign * best + moved * half, half)]
    bars = history_bars(CoefficientHistory(unit="s", points=points))
    labels = [float(tick.label) for tick in bars.y_ticks]
    assert 2 <= len(set(labels)) == len(labels) <= 6
    first = bars.bars[0]
    of_unit = (first.low - first.y) / half
    for label, tick in zip(labels, bars.y_ticks, strict=True):
        assert tick.at == pytest.approx(first.y + (sign * best - label) * of_unit, abs=0.6)
