"""Which recorded signal is fed into the simulated loop, and as what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.control.position import ReferencePoint
from sim_jax.inlet import (
    ActuatorInlet,
    BodyRateInlet,
    Inlet,
    MixedInlet,
    ReferenceInlet,
    RotorSpeedInlet,
    SingleInlet,
)
from sim_jax.schedule import Schedule
from sim_jax.vector import Vec3
from tuner.errors import RecordingError
from tuner.flights.flight import SIGNALS, Array, Flight, Series
from tuner.padding import padded_size

InletName = Literal["reference", "body_rate", "actuator", "rotor_speed"]

MISSED = 1.5
"""Periods of a loop between two samples beyond which its output was not recorded in full."""

#: What must have been recorded for each, the upstream ones first.
NEEDS: Mapping[InletName, tuple[str, ...]] = {
    "reference": ("reference_position",),
    "body_rate": ("rate_setpoint", "thrust_setpoint"),
    "actuator": ("command",),
    "rotor_speed": ("rotor_speed",),
}
#: What a simulation through each inlet says nothing about, since it was fed in or left out.
SILENT: Mapping[InletName, tuple[str, ...]] = {
    "reference": (),
    "body_rate": (),
    "actuator": ("command",),
    "rotor_speed": ("command", "rotor_speed"),
}


def inlet_for(flight: Flight, said: str) -> InletName:
    """Return the inlet of a flight: the one named, or the most upstream one that it can feed.

    A reference without velocities is a list of set-points to some other controller, not the
    reference of ours, so that it is only used where it is asked for.

    Raises
    ------
    RecordingError
        The recording does not hold what the inlet needs.
    """
    for name, needs in NEEDS.items():
        fits = all(_complete(flight, signal) for signal in needs)
        if said == name and not fits:
            raise RecordingError(
                flight.path,
                f"holds no {' and no '.join(needs)} for the {name} inlet",
                "name its trajectory in the job file" if name == "reference" else "use inlet: auto",
            )
        told = name != "reference" or flight.has("reference_velocity")
        if said == name or (said == "auto" and fits and told):
            return name
    raise RecordingError(
        flight.path,
        "holds neither a reference with velocities, nor rate set-points, nor four motor commands, "
        "nor four rotor speeds",
        "name its trajectory in the job file",
    )


def _complete(flight: Flight, signal: str) -> bool:
    return flight.has(signal) and bool(np.isfinite(flight.signals[signal]).any(axis=0).all())


def inlets_of(names: Sequence[InletName], flights: Sequence[Flight], schedule: Schedule) -> Inlet:
    """Lay what was recorded side by side, each segment's for its own inlet.

    Parameters
    ----------
    names
        F inlets.
    flights, schedule
        As of `inlet_of`.
    """
    kinds = [name for name in NEEDS if name in names]
    if len(kinds) == 1:
        return inlet_of(kinds[0], flights, schedule)
    parts = []
    for kind in kinds:
        feeding = [
            flight if name == kind else _silent(flight, NEEDS[kind])
            for name, flight in zip(names, flights, strict=True)
        ]
        parts.append(inlet_of(kind, feeding, schedule))
    return MixedInlet(tuple(parts), jnp.asarray([kinds.index(name) for name in names]))


def _silent(flight: Flight, signals: Sequence[str]) -> Flight:
    """Return a flight whose signals are zero throughout."""
    widths = {name: SIGNALS[name][0] for name in signals}
    ends = np.array([0.0, flight.duration])
    return replace(
        flight,
        signals=dict(flight.signals)
        | {name: np.zeros((len(flight.time), width)) for name, width in widths.items()},
        series=dict(flight.series)
        | {name: Series(ends, np.zeros((2, width))) for name, width in widths.items()},
    )


def inlet_of(name: InletName, flights: Sequence[Flight], schedule: Schedule) -> SingleInlet:
    """Lay what was recorded side by side; after its end the last value holds.

    Set-points and commands hold until the loop that makes them runs again. Where they were recorded
    less often than that, they are taken to move steadily from one sample to the next: holding them
    would make them late.

    Parameters
    ----------
    name
        Which inlet.
    flights
        F segments.
    schedule
        All but the reference enter at its ``physics_rate``.
    """
    if name == "reference":
        return _reference(flights)
    physics_rate = schedule.physics_rate
    longest = max(flight.duration for flight in flights)
    clock = np.arange(padded_size(int(np.ceil(longest * physics_rate)) + 2)) / physics_rate

    def laid(signal: str, update_rate: float | None) -> list[jax.Array]:
        read = between if update_rate is None or sparse(flights, signal, update_rate) else held
        table = np.stack([read(flight.series[signal], clock) for flight in flights], axis=-1)
        return [jnp.asarray(table[:, column]) for column in range(table.shape[1])]

    if name == "body_rate":
        (thrust,) = laid("thrust_setpoint", schedule.position_control_rate)
        return BodyRateInlet(Vec3(*laid("rate_setpoint", schedule.position_control_rate)), thrust)
    if name == "actuator":
        a, b, c, d = laid("command", schedule.rate_control_rate)
        return ActuatorInlet((a, b, c, d))
    a, b, c, d = laid("rotor_speed", None)
    return RotorSpeedInlet((a, b, c, d))


def sparse(flights: Sequence[Flight], signal: str, update_rate: float) -> bool:
    """Tell whether a signal was recorded less often than it was made, at a rate in Hz."""
    gaps = np.concatenate([np.diff(flight.series[signal].time) for flight in flights])
    return bool(np.median(gaps) * update_rate > MISSED)


def held(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that holds until its next sample, at (m,) times."""
    columns = []
    for column in series.values.T:
        known = np.isfinite(column)
        place = np.searchsorted(series.time[known], clock + 1e-9, side="right") - 1
        columns.append(column[known][np.maximum(place, 0)])
    return np.column_stack(columns)


def between(series: Series, clock: Array) -> Array:
    """Read a signal (n, k) that moves linearly between its samples, at (m,) times."""
    columns = []
    for column in series.values.T:
        known = np.isfinite(column)
        columns.append(np.interp(clock, series.time[known], column[known]))
    return np.column_stack(columns)


def _reference(flights: Sequence[Flight]) -> ReferenceInlet:
    length = padded_size(max(len(flight.time) for flight in flights))
    columns = [_points(flight, length) for flight in flights]
    position, velocity, acceleration = (
        Vec3.of(jnp.asarray(np.stack([c[part] for c in columns], axis=-1))) for part in range(3)
    )
    spins = [flight.yaw_rate_setpoint for flight in flights]
    return ReferenceInlet(
        ReferencePoint(position, velocity, acceleration),
        spins=jnp.asarray([spin is not None for spin in spins]),
        yaw_rate=jnp.asarray([spin or 0.0 for spin in spins]),
    )


def _points(flight: Flight, length: int) -> list[Array]:
    """Return position, velocity and acceleration, each (3, length), the last point held."""
    parts = []
    for name in ("reference_position", "reference_velocity", "reference_acceleration"):
        values = flight.signals.get(name)
        rows = np.zeros((len(flight.time), 3)) if values is None else np.nan_to_num(values)
        parts.append(np.pad(rows, ((0, length - len(rows)), (0, 0)), mode="edge").T)
    return parts
