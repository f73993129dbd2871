"""Force and moment of each term along a simulated flight, as in the thesis's Fig. 8.2."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.flights.flight import Array
from tuner.report.chart import PALETTE, Chart, Dash, Line, Look, Panel, rounded
from tuner.report.contents import Contents
from tuner.report.section import Section

PREFIX = "acting_"
CLOCK = "time"
AXES = ("forward", "left", "up")
FAINTEST = 1e-9
"""N or N m below which a curve is no more than rounding."""
DASHES: tuple[Dash, ...] = ("solid", "dash", "dot")


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
    return Chart(
        f"{flight}_{quantity}",
        f"{flight}: {quantity}",
        panels,
        x_title="time since the mission's start [s]",
        height=520,
    )


def _look(number: int) -> Look:
    return Look(PALETTE[number % len(PALETTE)], dash=DASHES[number // len(PALETTE) % len(DASHES)])
