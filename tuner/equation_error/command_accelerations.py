"""Accelerations of flights whose rotors follow recorded commands: by the motors' curve and lags.

What moves a motor moves its rotor's speeds, and these the accelerations: by differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tuner.core.numerics import Array
from tuner.equation_error.measured import Measured, measured_with, with_rotors, without_gaps_of
from tuner.equation_error.model import Accelerations, Linear, values_at
from tuner.objective.inlets import MISSED, linear_interpolation, zero_order_hold
from tuner.objective.rotor_response import Lags, rotor_speeds
from tuner.recordings.flight import Flight, Series
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model, with_coefficients

NUDGE = 1e-2
"""Step of a logarithm, or of a number over its usual size, for derivatives."""


@dataclass(frozen=True)
class CommandAccelerations:
    """As `tuner.equation_error.model.Accelerations`, with commands in place of rotor speeds.

    Attributes
    ----------
    model, parameters
        As there; of the parameters those that `moves_rotors` tells move rotor speeds.
    commands
        Of each flight (n, 4), held from tick to tick of a clock.
    flights
        Their steps, whose rotor speeds are those that the model has.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    commands: tuple[Series, ...]
    flights: tuple[Measured, ...]
    _moving: tuple[int, ...] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        moving = tuple(n for n, p in enumerate(self.parameters) if moves_rotors(p.name))
        object.__setattr__(self, "_moving", moving)

    def at(self, point: Array, *, noise: bool = True) -> tuple[Linear, ...]:
        """Return each flight's accelerations about a point (K,) of scaled coordinates.

        ``noise``: commands have none.
        """
        del noise
        here = self._flown(point)
        linear = Accelerations(self.model, self.parameters, here).at(point, noise=False)
        nudges = [NUDGE * (self.parameters[n].usual or 1.0) for n in self._moving]
        beside = [
            part
            for number, nudge in zip(self._moving, nudges, strict=True)
            for part in self._flown(point + nudge * np.eye(len(point))[number])
        ]
        if not beside:
            return linear
        ends = Accelerations(self._model(point), (), tuple(beside)).at(np.zeros(0), noise=False)
        columns = [one.columns.copy() for one in linear]
        for place, (number, nudge) in enumerate(zip(self._moving, nudges, strict=True)):
            for flight, one in enumerate(linear):
                end = ends[place * len(linear) + flight]
                columns[flight][:, :, number] = (one.left - end.left) / nudge
        return tuple(replace(one, columns=c) for one, c in zip(linear, columns, strict=True))

    def _model(self, point: Array) -> Model:
        values = values_at(self.parameters, point)
        return with_coefficients(self.model, {n: np.asarray(v) for n, v in values.items()})

    def _flown(self, point: Array) -> tuple[Measured, ...]:
        """Return the steps with the rotor speeds that a point's motors have."""
        model, parts = self._model(point), zip(self.flights, self.commands, strict=True)
        return tuple(with_rotors(part, rotor_response(model, command)) for part, command in parts)


def moves_rotors(name: str) -> bool:
    """Return whether a coefficient is of the motors' curve and lags that `rotor_response` has."""
    row = COEFFICIENTS[name]
    return row.part == "motors" and not row.is_effect


def rotor_response(model: Model, command: Series) -> Series:
    """Return the rotor speeds (n, 4) that follow commands on a clock."""
    motor, late = model.vehicle.motor, float(model.vehicle.setup.actuator_latency)
    lags = Lags(float(motor.time_constant_up), float(motor.time_constant_down), late)
    step = float(command.time[1] - command.time[0])
    return Series(command.time, rotor_speeds(command.values, step, motor, lags))


Commands = tuple[Series, ...]
"""Of each flight."""


def read_commands(
    model: Model, flights: Sequence[tuple[Flight, float]], rate: float
) -> tuple[tuple[Measured, ...], tuple[Commands, Commands]] | None:
    """Return the steps of some flights; their commands, and the same of every second sample.

    None where a flight says too little.

    Parameters
    ----------
    model
        Whose motors follow the commands.
    flights
        Each with the s by which its commands are stamped late.
    rate
        Hz of the loop that computes commands.
    """
    commands, coarser = (
        tuple(_held(*flight, rate, every) for flight in flights) for every in (1, 2)
    )
    pairs = zip(flights, commands, strict=True)
    parts = [measured_with(flight, rotor_response(model, c), noise=0.0) for (flight, _), c in pairs]
    known = tuple(
        without_gaps_of(_on_time(*flight), part)
        for flight, part in zip(flights, parts, strict=True)
        if part is not None
    )
    return (known, (commands, coarser)) if len(known) == len(parts) else None


def _on_time(flight: Flight, late: float) -> Series:
    recorded = flight.series["command"]
    return Series(recorded.time - late, recorded.values)


def _held(flight: Flight, late: float, rate: float, every: int) -> Series:
    """Return one of so many recorded commands of a flight, on the loop's clock or their own."""
    recorded = _on_time(flight, late)
    taken = Series(recorded.time[::every], recorded.values[::every])
    read = zero_order_hold if taken.rate * MISSED > rate else linear_interpolation
    rate = max(rate, recorded.rate)
    clock = np.arange(int(flight.duration * rate)) / rate
    return Series(clock, read(taken, clock))
