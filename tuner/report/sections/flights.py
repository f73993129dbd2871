"""Each flight: how closely it is met, before and after, its traces, and what acted along it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tuner.recordings.flight import Array
from tuner.report.chart import (
    FITTED,
    INITIAL,
    PALETTE,
    RECORDED,
    Chart,
    Dash,
    Line,
    Look,
    Panel,
    rounded,
)
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.result import RMSE_UNITS, AxesRmse, FlightResult
from tuner.wording.result import PREDICTED

#: What is flown -> suffix of its arrays and its look; drawn in this order.
CURVES = {
    "recorded": ("", RECORDED),
    "initial": ("_initial", INITIAL),
    "fitted": ("_best", FITTED),
    "simulated": ("_simulated", FITTED),
}
QUANTITIES = {
    "position": (("x", "y", "z"), "m"),
    "attitude": (("roll", "pitch", "yaw"), "°"),
}
SMALLEST = 1e-6
"""Errors below this are drawn as this on a logarithmic axis."""
TIME = "time since the mission's start [s]"
PREFIX = "acting_"
CLOCK = "time"
AXES = ("forward", "left", "up")
FAINTEST = 1e-9
"""N or N m below which a curve is no more than rounding."""
DASHES: tuple[Dash, ...] = ("solid", "dash", "dot")


def flights(contents: Contents) -> Section | None:
    """Return four charts a flight."""
    if not contents.traces:
        return None
    held = {
        flight.name
        for flight in (contents.run.result.flights if contents.run else ())
        if flight.split == "holdout"
    }
    charts = []
    for name, arrays in contents.traces.items():
        title = f"{name} (held out)" if name in held else name
        charts += [
            _over_time(name, title, "position", arrays),
            _over_time(name, title, "attitude", arrays),
            _errors(name, title, arrays),
            _from_above(name, title, arrays),
        ]
    return Section(
        "flights", "Simulated against recorded", {"fit": contents.run is not None}, charts
    )


def _over_time(name: str, title: str, quantity: str, arrays: Mapping[str, Array]) -> Chart:
    axes, unit = QUANTITIES[quantity]
    time = rounded(arrays[f"{quantity}_time"], 3)
    digits = 4 if quantity == "position" else 3
    panels = []
    for column, axis in enumerate(axes):
        curves = [
            Line(which, time, rounded(arrays[quantity + suffix][:, column], digits), look)
            for which, (suffix, look) in CURVES.items()
            if quantity + suffix in arrays
        ]
        panels.append(Panel(curves, y_title=f"{axis} [{unit}]"))
    return Chart(f"{name}_{quantity}", f"{title}: {quantity}", panels, x_title=TIME, height=520)


def _errors(name: str, title: str, arrays: Mapping[str, Array]) -> Chart:
    panels = []
    for quantity, (_, unit) in QUANTITIES.items():
        time = rounded(arrays[f"{quantity}_time"], 3)
        curves = []
        for which, (suffix, look) in CURVES.items():
            if not suffix or quantity + suffix not in arrays:
                continue
            error = arrays[quantity + suffix] - arrays[quantity]
            if quantity == "attitude":
                error = (error + 180.0) % 360.0 - 180.0
            size = np.maximum(np.linalg.norm(error, axis=1), SMALLEST)
            curves.append(Line(which, time, rounded(size, 6), look))
        panels.append(Panel(curves, y_title=f"{quantity} [{unit}]", y_scale="log"))
    return Chart(f"{name}_error", f"{title}: error over time", panels, x_title=TIME, height=420)


def _from_above(name: str, title: str, arrays: Mapping[str, Array]) -> Chart:
    curves = [
        Line(
            which,
            rounded(arrays["position" + suffix][:, 0], 4),
            rounded(arrays["position" + suffix][:, 1], 4),
            look,
        )
        for which, (suffix, look) in CURVES.items()
        if "position" + suffix in arrays
    ]
    panel = Panel(curves, y_title="y [m]", equal=True)
    return Chart(f"{name}_top", f"{title}: from above", (panel,), x_title="x [m]", height=460)


@dataclass(frozen=True)
class Row:
    """A flight or lap; per axis the RMSE before and after, None for a crash."""

    name: str
    pairs: list[tuple[float | None, float | None]]


def errors(contents: Contents) -> Section | None:
    """Return the RMSE before and after, of flights and of laps."""
    if contents.run is None or not contents.run.result.flights:
        return None
    rows = [
        Row(
            flight.name + (" (held out)" if flight.split == "holdout" else ""),
            _pairs(flight.rmse_initial, flight.rmse_best),
        )
        for flight in contents.run.result.flights
    ]
    values = {
        "axes": RMSE_UNITS,
        "rows": rows,
        "laps": _laps(contents),
        "predicted": PREDICTED,
        "predictions": [p for f in contents.run.result.flights for p in _predictions(f)],
    }
    return Section("errors", "RMSE of each flight", values)


@dataclass(frozen=True)
class PredictedRow:
    """Open-loop predictions of a flight so many s ahead.

    ``errors`` are, quantity by quantity, those with the initial and the fitted coefficients, and of
    a state that stays; None of what is not predicted.
    """

    name: str
    seconds: float
    errors: list[tuple[float | None, float | None, float | None]]


def _predictions(flight: FlightResult) -> list[PredictedRow]:
    held = flight.predicted_holding or (None,) * len(flight.predicted_best)
    rows = zip(flight.predicted_initial, flight.predicted_best, held, strict=True)
    return [
        PredictedRow(
            flight.name + (" (held out)" if flight.split == "holdout" else ""),
            best.seconds,
            [
                (
                    getattr(initial, n),
                    getattr(best, n),
                    None if naive is None else getattr(naive, n),
                )
                for n in PREDICTED
            ],
        )
        for initial, best, naive in rows
    ]


def _pairs(before: AxesRmse, after: AxesRmse) -> list[tuple[float | None, float | None]]:
    return [(getattr(before, axis), getattr(after, axis)) for axis in RMSE_UNITS]


def _laps(contents: Contents) -> list[Row]:
    if contents.laps is None:
        return []
    by_lap = {(row.flight, row.lap, row.vehicle): row.rmse for row in contents.laps.rows}
    return [
        Row(
            f"{flight}, lap {lap}",
            _pairs(by_lap[flight, lap, "initial"], by_lap[flight, lap, "best"]),
        )
        for flight, lap in dict.fromkeys(
            (row.flight, row.lap) for row in contents.laps.rows if row.lap is not None
        )
    ]


def forces(contents: Contents) -> Section | None:
    """Return two charts: forces and moments of each term, along each body axis.

    Of the flight that accelerates most: the others' curves are much the same.
    """
    flights = {name: _of_terms(arrays) for name, arrays in contents.traces.items()}
    flights = {name: of_term for name, of_term in flights.items() if CLOCK in of_term}
    if not flights:
        return None
    name = max(flights, key=lambda name: _pull(flights[name]))
    of_term = dict(flights[name])
    time = of_term.pop(CLOCK)
    charts = (
        _chart(name, "forces", "N", time, {n: v[:, :3] for n, v in of_term.items()}),
        _chart(name, "moments", "N m", time, {n: v[:, 3:] for n, v in of_term.items()}),
    )
    return Section("forces", "Forces and moments by term", {"flight": name}, charts)


def _of_terms(arrays: Mapping[str, Array]) -> dict[str, Array]:
    return {
        name.removeprefix(PREFIX): values
        for name, values in arrays.items()
        if name.startswith(PREFIX)
    }


def _pull(of_term: Mapping[str, Array]) -> float:
    """Return the root mean square of mass times acceleration, N."""
    total = sum(values[:, :3] for name, values in of_term.items() if name != CLOCK)
    return float(np.sqrt(np.mean(np.square(total)))) if np.size(total) else 0.0


def _chart(
    flight: str, quantity: str, unit: str, time: Array, of_term: Mapping[str, Array]
) -> Chart:
    clock = rounded(time, 3)
    looks = {name: _look(number) for number, name in enumerate(of_term)}
    panels = [
        Panel(
            [
                Line(name.replace("_", " "), clock, rounded(values[:, axis], 5), looks[name])
                for name, values in of_term.items()
                if np.abs(values[:, axis]).max(initial=0.0) > FAINTEST
            ],
            y_title=f"{title} [{unit}]",
        )
        for axis, title in enumerate(AXES)
    ]
    return Chart(f"{flight}_{quantity}", f"{flight}: {quantity}", panels, x_title=TIME, height=520)


def _look(number: int) -> Look:
    return Look(PALETTE[number % len(PALETTE)], dash=DASHES[number // len(PALETTE) % len(DASHES)])
