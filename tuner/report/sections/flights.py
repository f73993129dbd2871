"""Each flight: how closely it is met, before and after, its traces, and what acted along it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from tuner.core.numerics import Array
from tuner.evaluate.records import AXES, RMSE_UNITS, AxesRmse, RmseTable
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.report.contents import Contents
from tuner.report.outcome import flights_table, outcome
from tuner.report.result_texts import starts_in_words
from tuner.report.section import (
    FITTED,
    INITIAL,
    MIN_DRAWN,
    PALETTE,
    RECORDED,
    Cell,
    Chart,
    Dash,
    Line,
    LineStyle,
    PageSection,
    Panel,
    Table,
    rounded,
    short,
)
from tuner.result import FlightResult, RunResult

#: What is flown -> suffix of its arrays and its look; drawn in this order.
CURVES = {
    "recorded": ("", RECORDED),
    "initial": ("_initial", INITIAL),
    "fitted": ("_best", FITTED),
    "simulated": ("_simulated", FITTED),
}
PLOT_UNITS = {"position": "m", "attitude": "°"}
PER_AXIS = {axis: (1e3, "mm") if unit == "m" else (1.0, "°") for axis, unit in RMSE_UNITS.items()}
"""Axis -> what its RMSE is multiplied by for a table, and the unit then."""
MIN_WORSE_RATIO = 1.05
"""Times the error before beyond which it is marked as worse."""
TIME = "time since the mission's start [s]"
PREFIX = "acting_"
CLOCK = "time"
BODY = ("forward", "left", "up")
MIN_DRAWN_FORCE = 1e-9
"""N or N m below which a curve is no more than rounding."""
DASHES: tuple[Dash, ...] = ("solid", "dash", "dot")


def flights(contents: Contents) -> PageSection | None:
    """Return the RMSE of each flight, and four charts of each; held-out flights first."""
    result = contents.result
    found = [] if result is None else list(result.flights)
    if not found and not contents.traces:
        return None
    held = {flight.name for flight in found if flight.split == "holdout"}
    order = sorted(contents.traces, key=lambda name: name not in held)
    charts = [
        chart
        for name in order
        for chart in _flight_charts(name, contents.traces[name], held, open_=name == order[0])
    ]
    legend = "Recorded (wide grey), " + (
        "simulated with the start values (dotted) and with the fitted coefficients."
        if found
        else "and simulated."
    )
    tables = [] if result is None else _tables(contents, result)
    return PageSection(
        "flights",
        "Flights",
        starts_in_words(found),
        tables=tables,
        charts=charts,
        note=f"{legend} Drag to zoom, double-click to zoom out." if charts else "",
    )


def _tables(contents: Contents, result: RunResult) -> list[Table]:
    tables = [flights_table(outcome(result).flights)]
    axes = [f"{axis} [{PER_AXIS[axis][1]}]" for axis in RMSE_UNITS]
    by_axis = [(_title(f), *_pairs(f.rmse_initial, f.rmse_best)) for f in result.flights]
    tables.append(Table(("flight", *axes), by_axis, words=("flight",), fold="RMSE axis by axis"))
    if contents.laps is not None and (laps := _laps(contents.laps)):
        tables.append(Table(("lap", *axes), laps, words=("lap",), fold="RMSE lap by lap"))
    if ahead := [row for flight in result.flights for row in _predictions(flight)]:
        quantities = [
            f"{name.replace('_', ' ')} [{unit}]" for name, unit in PREDICTED_UNITS.items()
        ]
        fold = (
            "Open-loop predictions from recorded states: mean error before → after, knowing the "
            "torque that was unseen just before (of a state that stays as it is)"
        )
        tables.append(
            Table(("flight", "after [s]", *quantities), ahead, words=("flight",), fold=fold)
        )
    return tables


def _flight_charts(
    name: str, arrays: Mapping[str, Array], held: set[str], *, open_: bool
) -> list[Chart]:
    title = f"{name}, held out" if name in held else name
    charts = (
        _errors(name, title, arrays),
        _over_time(name, title, "position", arrays),
        _over_time(name, title, "attitude", arrays),
        _from_above(name, title, arrays),
    )
    return [
        replace(
            chart,
            clock="" if chart.key.endswith("_top") else name,
            fold="" if open_ and not number else title,
        )
        for number, chart in enumerate(charts)
    ]


def _over_time(name: str, title: str, quantity: str, arrays: Mapping[str, Array]) -> Chart:
    unit = PLOT_UNITS[quantity]
    time = rounded(arrays[f"{quantity}_time"], 3)
    digits = 4 if quantity == "position" else 3
    panels = []
    for column, axis in enumerate(AXES[quantity]):
        curves = [
            Line(which, time, rounded(arrays[quantity + suffix][:, column], digits), look)
            for which, (suffix, look) in CURVES.items()
            if quantity + suffix in arrays
        ]
        panels.append(Panel(curves, y_title=f"{axis} [{unit}]"))
    return Chart(f"{name}_{quantity}", f"{title}: {quantity}", panels, x_title=TIME, height=520)


def _errors(name: str, title: str, arrays: Mapping[str, Array]) -> Chart:
    panels = []
    for quantity, scale, unit in (("position", 1e3, "mm"), ("attitude", 1.0, "°")):
        time = rounded(arrays[f"{quantity}_time"], 3)
        curves = []
        for which, (suffix, look) in CURVES.items():
            if not suffix or quantity + suffix not in arrays:
                continue
            error = arrays[quantity + suffix] - arrays[quantity]
            if quantity == "attitude":
                error = (error + 180.0) % 360.0 - 180.0
            size = np.maximum(scale * np.linalg.norm(error, axis=1), MIN_DRAWN)
            curves.append(Line(which, time, rounded(size, 4), look))
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


def _title(flight: FlightResult) -> str:
    return flight.name + (", held out" if flight.split == "holdout" else "")


def _predictions(flight: FlightResult) -> list[tuple[Cell | str, ...]]:
    """Return a flight's open-loop predictions, by how far they look ahead."""
    nothing = (None,) * len(flight.predicted_best)
    rows = zip(
        flight.predicted_initial,
        flight.predicted_best,
        flight.predicted_with_observer or nothing,
        flight.predicted_holding or nothing,
        strict=True,
    )
    return [
        (
            _title(flight),
            f"{best.seconds:g}",
            *(
                _predictions_table(
                    *(getattr(of, n, None) for of in (before, best, observed, naive))
                )
                for n in PREDICTED_UNITS
            ),
        )
        for before, best, observed, naive in rows
    ]


def _predictions_table(
    before: float | None, best: float | None, observed: float | None, held: float | None
) -> Cell | str:
    if best is None:
        return "–"
    text = f"{short(before) or 'crash'} → {short(best)}"
    if observed is not None:
        text += f", {short(observed)}"
    if held is None:
        return text
    return Cell(f"{text} ({short(held)})", look="worse" if best > held else "")


def _pairs(before: AxesRmse, after: AxesRmse) -> list[Cell | str]:
    """Return six errors before and after, a crash as such, and a dash for what is followed."""
    cells: list[Cell | str] = []
    flown = any(getattr(rmse, axis) is not None for rmse in (before, after) for axis in RMSE_UNITS)
    for axis in RMSE_UNITS:
        one, other = getattr(before, axis), getattr(after, axis)
        if one is None and other is None and flown:
            cells.append("–" if after.x is not None else "crash")
            continue
        scale = PER_AXIS[axis][0]
        text = " → ".join("crash" if v is None else f"{scale * v:.3g}" for v in (one, other))
        worse = one is not None and (other is None or other > MIN_WORSE_RATIO * one)
        cells.append(Cell(text, look="worse" if worse else ""))
    return cells


def _laps(table: RmseTable) -> list[tuple[Cell | str, ...]]:
    by_lap = {(row.flight, row.lap, row.vehicle): row.rmse for row in table.rows}
    return [
        (
            f"{flight}, lap {lap}",
            *_pairs(by_lap[flight, lap, "initial"], by_lap[flight, lap, "best"]),
        )
        for flight, lap in dict.fromkeys(
            (row.flight, row.lap) for row in table.rows if row.lap is not None
        )
    ]


def forces(contents: Contents) -> PageSection | None:
    """Return two charts: forces and moments of each term, along each body axis.

    Of the flight that accelerates most: the others' curves are much the same.
    """
    flights = {
        name: {key.removeprefix(PREFIX): a for key, a in arrays.items() if key.startswith(PREFIX)}
        for name, arrays in contents.traces.items()
        if PREFIX + CLOCK in arrays
    }
    if not flights:
        return None
    name = max(flights, key=lambda name: _weight_of(flights[name]))
    of_term = flights[name]
    time = of_term.pop(CLOCK)
    charts = (
        _chart(name, "forces", "N", time, {n: v[:, :3] for n, v in of_term.items()}),
        _chart(name, "moments", "N m", time, {n: v[:, 3:] for n, v in of_term.items()}),
    )
    note = (
        f"What each term of the model does along the simulated {name}, the flight that accelerates "
        "most: about the centre of mass, in body axes. Forces add up to mass times acceleration, "
        "moments to the rate of change of the angular momentum. Click a name in a legend to hide "
        "its curve. tune simulate --forces FILE.csv writes the same at full rate for any "
        "trajectory."
    )
    return PageSection(
        "forces", "Forces and moments by term", charts=charts, note=note, folded=True
    )


def _weight_of(of_term: Mapping[str, Array]) -> float:
    """Return the root mean square of mass times acceleration, N."""
    total = sum(values[:, :3] for name, values in of_term.items() if name != CLOCK)
    return float(np.sqrt(np.mean(np.square(total)))) if np.size(total) else 0.0


def _chart(
    flight: str, quantity: str, unit: str, time: Array, of_term: Mapping[str, Array]
) -> Chart:
    clock = rounded(time, 3)
    styles = {name: _style(number) for number, name in enumerate(of_term)}
    panels = [
        Panel(
            [
                Line(name.replace("_", " "), clock, rounded(values[:, axis], 5), styles[name])
                for name, values in of_term.items()
                if np.abs(values[:, axis]).max(initial=0.0) > MIN_DRAWN_FORCE
            ],
            y_title=f"{title} [{unit}]",
        )
        for axis, title in enumerate(BODY)
    ]
    title = f"{flight}: {quantity}"
    return Chart(
        f"{flight}_{quantity}", title, panels, x_title=TIME, height=520, clock=f"{flight} forces"
    )


def _style(number: int) -> LineStyle:
    return LineStyle(
        PALETTE[number % len(PALETTE)], dash=DASHES[number // len(PALETTE) % len(DASHES)]
    )
