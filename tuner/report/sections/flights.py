"""Recorded, initial and fitted flight over time and from above."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.flights.flight import Array
from tuner.report.chart import FITTED, INITIAL, RECORDED, Chart, Line, Panel, rounded
from tuner.report.contents import Contents
from tuner.report.section import Section

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
