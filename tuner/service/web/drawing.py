"""Figures of the pages: positions on a canvas, which a template writes as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from tuner.service.shapes import CoefficientHistory, Point

WIDTH, HEIGHT = 640.0, 270.0
LEFT, RIGHT, TOP, BOTTOM = 92.0, 12.0, 28.0, 46.0
MOST_POINTS = 600
"""Points of a curve: more would not be seen."""


@dataclass(frozen=True)
class Tick:
    """A mark on an axis, and what it says."""

    at: float
    label: str


@dataclass(frozen=True)
class Curve:
    """A line over iterations: SVG points, the last one, and ticks of both axes."""

    points: str
    last: tuple[float, float]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]


@dataclass(frozen=True)
class Bar:
    """A coefficient with its interval, all in canvas units, and the point it stands for."""

    x: float
    y: float
    low: float
    high: float
    point: Point


@dataclass(frozen=True)
class Bars:
    """Points with intervals over time, and ticks of both axes."""

    bars: tuple[Bar, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]


def rmse_curve(rmse: Sequence[float]) -> Curve | None:
    """Return the RMSE (m) of each iteration in turn, on a logarithmic axis in mm.

    None where there is nothing to draw yet.
    """
    known = [
        (number, 1000 * value)
        for number, value in enumerate(rmse, start=1)
        if value > 0 and math.isfinite(value)
    ]
    if not known:
        return None
    step = -(-len(known) // MOST_POINTS)
    shown = [*known[:-1:step], known[-1]]
    logs = [math.log10(value) for _, value in shown]
    low, high = min(logs), max(logs)
    if high - low < 0.3:
        low, high = low - 0.15, high + 0.15
    first, last = shown[0][0], max(shown[-1][0], shown[0][0] + 1)
    whole = range(first, last + 1, max(1, round((last - first) / 5)))
    places = [
        (_across(n, first, last), _up(y, low, high)) for (n, _), y in zip(shown, logs, strict=True)
    ]
    return Curve(
        points=" ".join(f"{x:.1f},{y:.1f}" for x, y in places),
        last=places[-1],
        x_ticks=tuple(Tick(_across(n, first, last), str(n)) for n in whole),
        y_ticks=tuple(Tick(_up(math.log10(v), low, high), f"{v:g}") for v in _decades(low, high)),
    )


def history_bars(history: CoefficientHistory) -> Bars:
    """Return a coefficient over the jobs of a vehicle, one place each, in their order."""
    points = history.points
    ends = [value for point in points for value in (point.best, *(point.ci95 or ()))]
    low, high = min(ends), max(ends)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - margin, high + margin
    bars = []
    for number, point in enumerate(points):
        x = _across(number + 0.5, 0, len(points))
        bottom, top = point.ci95 or (point.best, point.best)
        y, under, over = (_up(value, low, high) for value in (point.best, bottom, top))
        bars.append(Bar(x, y, under, over, point))
    every = -(-len(points) // 6)
    days = tuple(
        Tick(bar.x, (bar.point.flown or bar.point.ended or "")[:10]) for bar in bars[::every]
    )
    values = tuple(Tick(_up(v, low, high), label) for v, label in _round_numbers(low, high))
    return Bars(tuple(bars), days, values)


def _across(value: float, first: float, last: float) -> float:
    return LEFT + (WIDTH - LEFT - RIGHT) * (value - first) / (last - first)


def _up(value: float, low: float, high: float) -> float:
    return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (value - low) / (high - low)


def _round_numbers(low: float, high: float) -> list[tuple[float, str]]:
    """Return two to six round numbers between two others, with as many digits as they differ by."""
    widest = (high - low) / 2
    power = 10.0 ** math.floor(math.log10(widest))
    step = max(factor * power for factor in (1, 2, 5) if factor * power <= widest)
    leading = math.log10(max(abs(low), abs(high)))
    digits = math.floor(leading) - math.floor(math.log10(step)) + 1
    numbers = range(math.ceil(low / step), math.floor(high / step) + 1)
    return [(number * step, f"{number * step:.{max(digits, 1)}g}") for number in numbers]


def _decades(low: float, high: float) -> list[float]:
    """Return round numbers between two powers of ten."""
    factors = (1.0,) if high - low > 2 else (1.0, 2.0, 5.0)
    found = [
        factor * 10.0**power
        for power in range(math.floor(low), math.ceil(high) + 1)
        for factor in factors
        if low <= math.log10(factor * 10.0**power) <= high
    ]
    return found or [float(f"{10 ** ((low + high) / 2):.3g}")]
