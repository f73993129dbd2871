"""Two jobs side by side, coefficients over jobs, and an error over a search, as pages show them.

Figures are positions on a canvas, which a template writes as SVG.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from tuner.core.content_store import ContentStore
from tuner.core.files import MAX_BYTES
from tuner.evaluate.records import RMSE_UNITS
from tuner.result import CoefficientResult, ExportRecord, ExportRecords, RunResult
from tuner.service.errors import NotKnownError, NotNowError
from tuner.service.shapes import CoefficientHistory
from tuner.service.tables import JobRow
from tuner.vehicle.registry import mass_factor


@dataclass(frozen=True)
class Pair:
    """A coefficient of two jobs.

    Attributes
    ----------
    name, a, b
        See there; what goes with the mass is the second's at the mass of the first.
    scaled
        Whether it was brought to that mass.
    change
        Of the second from the first, relative; None where that has no sense.
    sigmas
        The change in standard errors of both together; None where neither has one.
    """

    name: str
    a: CoefficientResult
    b: CoefficientResult
    scaled: bool
    change: float | None
    sigmas: float | None


@dataclass(frozen=True)
class FlightPair:
    """A flight that both jobs have: axis -> RMSE of the first and of the second."""

    name: str
    splits: tuple[str, str]
    rmse: tuple[tuple[float | None, float | None], ...]


def result_of(store: ContentStore, row: JobRow) -> RunResult:
    """Return the result of a job that is done.

    Raises
    ------
    NotKnownError, NotNowError
        It has no result that can be read.
    """
    content = _content(row, store, RunResult.FILE)
    if content is None:
        raise NotNowError(f"job {row.id}", f"is {row.state}", "compare jobs that are done")
    try:
        return RunResult.model_validate_json(content)
    except ValidationError:
        raise NotNowError(
            f"job {row.id}", "was made by another version of tune", "submit it again"
        ) from None


def exports_of(store: ContentStore, row: JobRow) -> tuple[ExportRecord, ...]:
    """Return the exports of a job, with their gates."""
    content = _content(row, store, ExportRecords.FILE)
    try:
        records = ExportRecords.model_validate_json(content or b"{}")
    except ValidationError:
        return ()
    return tuple(records.exports.values())


def _content(row: JobRow, store: ContentStore, name: str) -> bytes | None:
    """Return a file of a job; None if it has none of that name."""
    file = next((file for file in row.files if file.name == name), None)
    if file is None:
        return None
    if not store.has(file.sha256):
        raise NotKnownError(f"job {row.id}", "has lost its result", "submit it again")
    with store.reading(file.sha256) as stream:
        return stream.read(MAX_BYTES)


def mass_of(result: RunResult) -> float | None:
    """Return the mass in kg that a fit found or was given."""
    return result.coefficients["mass"].best if "mass" in result.coefficients else None


def pairs(a: RunResult, b: RunResult) -> list[Pair]:
    """Return the coefficients of both, at the first's mass, those first that lie furthest apart."""
    masses = mass_of(b), mass_of(a)
    both = [
        _pair(name, one, b.coefficients[name], mass_factor(name, *masses))
        for name, one in a.coefficients.items()
        if name in b.coefficients and (one.fitted or b.coefficients[name].fitted)
    ]
    return sorted(both, key=lambda pair: -(pair.sigmas or 0.0))


def _pair(name: str, a: CoefficientResult, b: CoefficientResult, factor: float) -> Pair:
    scaled_error = None if b.std_error is None else factor * b.std_error
    b = b.model_copy(update={"best": factor * b.best, "std_error": scaled_error})
    error = math.hypot(a.std_error or 0.0, b.std_error or 0.0)
    return Pair(
        name,
        a,
        b,
        scaled=factor != 1.0,
        change=(b.best - a.best) / abs(a.best) if a.best else None,
        sigmas=abs(b.best - a.best) / error if error else None,
    )


def flight_pairs(a: RunResult, b: RunResult) -> list[FlightPair]:
    """Return the flights of both, by content."""
    others = {flight.sha256: flight for flight in b.flights}
    return [
        FlightPair(
            flight.name,
            (flight.split, other.split),
            tuple((getattr(flight.rmse_best, x), getattr(other.rmse_best, x)) for x in RMSE_UNITS),
        )
        for flight in a.flights
        if (other := others.get(flight.sha256)) is not None
    ]


WIDTH, HEIGHT = 640.0, 270.0
LEFT, RIGHT, TOP, BOTTOM = 116.0, 12.0, 28.0, 46.0
MAX_POINTS = 600
"""Points of a curve: more would not be seen."""


@dataclass(frozen=True)
class Canvas:
    """The axes of a chart.

    Attributes
    ----------
    across, up
        Values at both ends of the axes.
    x_ticks, y_ticks
        Value -> label of each tick.
    points
        Of a curve.
    """

    across: tuple[float, float]
    up: tuple[float, float]
    x_ticks: Sequence[tuple[float, str]]
    y_ticks: Sequence[tuple[float, str]]
    points: Sequence[tuple[float, float]] = ()

    def x(self, value: float) -> float:
        """Return the horizontal position of a value."""
        (first, last), width = self.across, WIDTH - LEFT - RIGHT
        return round(LEFT + width * (value - first) / (last - first), 1)

    def y(self, value: float) -> float:
        """Return the vertical position of a value, from the top."""
        (low, high), height = self.up, HEIGHT - TOP - BOTTOM
        return round(HEIGHT - BOTTOM - height * (value - low) / (high - low), 1)


def rmse_curve(rmse: Sequence[float]) -> Canvas | None:
    """Return the RMSE (m) of each iteration in turn, on a logarithmic axis in mm.

    None where there is nothing to draw yet.
    """
    known = [
        (number, math.log10(1000 * value))
        for number, value in enumerate(rmse, start=1)
        if value > 0 and math.isfinite(value)
    ]
    if not known:
        return None
    step = -(-len(known) // MAX_POINTS)
    shown = [*known[:-1:step], known[-1]]
    low, high = min(y for _, y in shown), max(y for _, y in shown)
    if high - low < 0.3:
        low, high = low - 0.15, high + 0.15
    first, last = shown[0][0], max(shown[-1][0], shown[0][0] + 1)
    whole = range(first, last + 1, max(1, round((last - first) / 5)))
    return Canvas(
        across=(first, last),
        up=(low, high),
        x_ticks=[(n, str(n)) for n in whole],
        y_ticks=[(math.log10(v), f"{v:g}") for v in _decade_ticks(low, high)],
        points=shown,
    )


def history_canvas(history: CoefficientHistory) -> Canvas:
    """Return a canvas for a coefficient over the jobs of a vehicle, one place each, in order.

    The first point stands at 0.5, the next at 1.5.
    """
    points = history.points
    ends = [value for point in points for value in (point.best, *(point.ci95 or ()))]
    low, high = min(ends), max(ends)
    margin = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
    low, high = low - margin, high + margin
    days = [(n + 0.5, (of.flown or of.ended or "")[:10]) for n, of in enumerate(points)]
    return Canvas(
        across=(0, len(points)),
        up=(low, high),
        x_ticks=days[:: -(-len(points) // 6)],
        y_ticks=_round_numbers(low, high),
    )


def _round_numbers(low: float, high: float) -> list[tuple[float, str]]:
    """Return two to six round numbers between two others, with as many digits as they differ by."""
    widest = (high - low) / 2
    power = 10.0 ** math.floor(math.log10(widest))
    step = max(factor * power for factor in (1, 2, 5) if factor * power <= widest)
    leading = math.log10(max(abs(low), abs(high)))
    digits = math.floor(leading) - math.floor(math.log10(step)) + 1
    numbers = range(math.ceil(low / step), math.floor(high / step) + 1)
    return [(number * step, f"{number * step:.{max(digits, 1)}g}") for number in numbers]


def _decade_ticks(low: float, high: float) -> list[float]:
    """Return round numbers between two powers of ten."""
    factors = (1.0,) if high - low > 2 else (1.0, 2.0, 5.0)
    found = [
        factor * 10.0**power
        for power in range(math.floor(low), math.ceil(high) + 1)
        for factor in factors
        if low <= math.log10(factor * 10.0**power) <= high
    ]
    return found or [float(f"{10 ** ((low + high) / 2):.3g}")]
