"""Figures of single commands: a simulated flight, and errors of several coefficient sets."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from tuner.report.chart import FITTED, GREY, PALETTE, RECORDED, Chart, Line, Look, Panel, rounded

if TYPE_CHECKING:  # drawn without jax
    from tuner.evaluate.rmse import FlightErrors
    from tuner.evaluate.simulate import Simulation

SMALLEST = 1e-3
"""mm below which an error is drawn as this on a logarithmic axis."""
MOST = 8
"""Flights that a figure compares: more panels cannot be read."""


def flight_figure(flight: Simulation, title: str) -> Chart:
    """Return a simulated flight: position beside its reference, tilt, rotor speeds, over time."""
    time, signals = rounded(flight.time, 4), flight.signals
    panels = [
        Panel(
            [
                Line("reference", time, rounded(signals["reference_position"][:, n], 5), RECORDED),
                Line("flown", time, rounded(signals["position"][:, n], 5), FITTED),
            ],
            y_title=f"{axis} [m]",
        )
        for n, axis in enumerate("xyz")
    ]
    speed = np.linalg.norm(signals["velocity"], axis=1)
    panels.append(Panel([Line("speed", time, rounded(speed, 4), Look(PALETTE[2]))], "speed [m/s]"))
    rotors = [
        Line(f"rotor {n + 1}", time, rounded(column, 2), Look(PALETTE[n % len(PALETTE)], width=1.0))
        for n, column in enumerate(signals["rotor_speed"].T)
    ]
    panels.append(Panel(rotors, y_title="rotors [rad/s]"))
    return Chart("flight", title, panels, x_title="time [s]", height=820)


def comparison_figure(flown: Mapping[str, Mapping[str, FlightErrors]]) -> Chart:
    """Return the position error over time of each vehicle, a panel a flight."""
    looks = [Look(colour) for colour in PALETTE] + [Look(GREY, dash="dash")]
    flights = list(dict.fromkeys(name for errors in flown.values() for name in errors))[:MOST]
    panels = []
    for name in flights:
        lines = []
        for number, (vehicle, errors) in enumerate(flown.items()):
            position = errors[name].position
            error = 1e3 * np.linalg.norm(position.simulated - position.recorded, axis=1)
            shown = rounded(np.maximum(error, SMALLEST), 4)
            time = rounded(position.time, 3)
            lines.append(Line(vehicle, time, shown, looks[min(number, len(looks) - 1)]))
        panels.append(Panel(lines, y_title=f"{name} [mm]", y_scale="log"))
    title = "Position error over time"
    return Chart("comparison", title, panels, x_title="time [s]", height=120 + 160 * len(panels))
