"""Charts of the service's pages."""

from __future__ import annotations

import json

import pytest

from tuner.report.section import charts_json
from tuner.service.shapes import CoefficientHistory, HistoryPoint
from tuner.service.web.comparison import MAX_POINTS, history_chart, rmse_chart


def point(best: float, half: float | None, name: str = "day") -> HistoryPoint:
    return HistoryPoint(
        mass=None,
        job="0" * 16,
        name=name,
        flown=None,
        ended="2026-01-01T00:00:00Z",
        best=best,
        std_error=None if half is None else half / 2,
        ci95=None if half is None else (best - half, best + half),
        identifiable=half is not None,
        flights=["hop"],
    )


def test_jobs_stand_in_order_with_their_intervals_and_days() -> None:
    name = "</script><b>x"
    chart = history_chart(
        "mass", CoefficientHistory(unit="kg", points=[point(2.0, 0.5), point(3.0, None, name)])
    )
    (panel,) = chart.panels
    interval, known, unknown = panel.marks
    assert panel.x_labels == ["2026-01-01"] * 2
    assert (interval.x, interval.y) == ((0, 0, 0, 1), (1.5, 2.5, None, None))
    assert (known.y, unknown.y) == ([2.0, None], [None, 3.0])
    assert known.text[0] == "day: 2 kg, standard error 0.25, from hop"
    assert "<" not in charts_json([chart])  # no name ends the element that the charts stand in
    assert json.loads(charts_json([chart]))[0]["panels"][0]["marks"][2]["text"][1].startswith(name)


@pytest.mark.parametrize("count", [1, 599, 600, 601, 5000])
def test_a_long_search_is_drawn_to_its_end_with_points_that_can_be_seen(count: int) -> None:
    chart = rmse_chart([0.001 * n for n in range(1, count + 1)])
    assert chart is not None
    (line,) = chart.panels[0].marks
    assert line.x[0] == 1
    assert (line.x[-1], line.y[-1]) == (count, pytest.approx(count))
    assert len(line.x) <= MAX_POINTS + 1


def test_nothing_is_drawn_of_a_search_without_an_error() -> None:
    assert rmse_chart([]) is None
    assert rmse_chart([0.0, float("nan"), float("inf")]) is None
