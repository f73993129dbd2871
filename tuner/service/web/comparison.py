"""Two jobs side by side, coefficients over jobs, and an error over a search, as pages show them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import ValidationError

from tuner.core.content_store import ContentStore
from tuner.core.files import MAX_BYTES
from tuner.core.phrases import listed
from tuner.evaluate.records import RMSE_UNITS
from tuner.report.section import FITTED, INITIAL, Chart, Line, LineStyle, Panel, figures, short
from tuner.result import CoefficientResult, ExportRecord, ExportRecords, RunResult
from tuner.service.database import JobRow
from tuner.service.errors import NotKnownError, NotNowError
from tuner.service.shapes import CoefficientHistory
from tuner.vehicle.registry import mass_factor


@dataclass(frozen=True)
class CoefficientPair:
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


def pairs(a: RunResult, b: RunResult) -> list[CoefficientPair]:
    """Return the coefficients of both, at the first's mass, those first that lie furthest apart."""
    masses = mass_of(b), mass_of(a)
    both = [
        _pair(name, one, b.coefficients[name], mass_factor(name, *masses))
        for name, one in a.coefficients.items()
        if name in b.coefficients and (one.fitted or b.coefficients[name].fitted)
    ]
    return sorted(both, key=lambda pair: -(pair.sigmas or 0.0))


def _pair(name: str, a: CoefficientResult, b: CoefficientResult, factor: float) -> CoefficientPair:
    scaled_error = None if b.std_error is None else factor * b.std_error
    b = b.model_copy(update={"best": factor * b.best, "std_error": scaled_error})
    error = math.hypot(a.std_error or 0.0, b.std_error or 0.0)
    return CoefficientPair(
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


INTERVAL = LineStyle(FITTED.colour, width=3.0)
MAX_POINTS = 600
"""Points of a curve: more would not be seen."""


def rmse_chart(rmse: Sequence[float]) -> Chart | None:
    """Return the RMSE (m) of each iteration in turn; None where there is nothing to draw yet."""
    known = [(n, 1000.0 * value) for n, value in enumerate(rmse, start=1) if 0 < value < math.inf]
    if not known:
        return None
    steps, values = zip(*known[: -1 : -(-len(known) // MAX_POINTS)], known[-1], strict=True)
    return Chart(
        key="rmse",
        title="Position RMSE against iteration",
        caption="Each stage compares more of the flights than the one before, so that it may rise.",
        panels=[Panel([Line("RMSE", steps, values, FITTED)], y_title="mm", y_scale="log")],
        x_title="iteration",
        height=300,
    )


def history_chart(name: str, history: CoefficientHistory) -> Chart:
    """Return a coefficient with its intervals over the jobs of a vehicle, in order."""
    points = history.points
    ends = [(n, end) for n, point in enumerate(points) for end in (*(point.ci95 or ()), None)]
    texts = [
        f"{point.name}: {figures(point.best)} {history.unit}, standard error "
        f"{short(point.std_error)}, from {listed(point.flights)}"
        for point in points
    ]
    places, values = zip(*ends, strict=True)
    marks = [Line("95 % interval", places, values, INTERVAL)]
    for label, is_known, look in (("identified", True, FITTED), ("not identified", False, INITIAL)):
        best = [p.best if bool(p.identifiable) == is_known else None for p in points]
        if any(value is not None for value in best):
            marks.append(
                Line(label, list(range(len(points))), best, look, joined=False, text=texts)
            )
    days = [(point.flown or point.ended or "")[:10] for point in points]
    return Chart(
        key=name,
        title=name,
        panels=[Panel(marks, y_title=history.unit, x_labels=days)],
        height=300,
    )
