"""Charts of the service's pages."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.service.shapes import CoefficientHistory, Point
from tuner.service.web.comparison import history_canvas


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
    canvas = history_canvas(CoefficientHistory(unit="s", points=points))
    labels = [float(label) for _, label in canvas.y_ticks]
    assert 2 <= len(set(labels)) == len(labels) <= 6
    first = canvas.y(sign * best)
    of_unit = (canvas.y(sign * best - half) - first) / half
    for value, label in canvas.y_ticks:
        assert canvas.y(value) == pytest.approx(
            first + (sign * best - float(label)) * of_unit, abs=0.6
        )
