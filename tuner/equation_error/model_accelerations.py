"""Accelerations by the model's forces and moments at recorded states and inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from lanes import Argument, program_of
from sim_jax.environment import Air
from sim_jax.rigid_body import angular_acceleration
from sim_jax.terms import total
from sim_jax.terms.total import total_wrench
from tuner.core.numerics import Array
from tuner.equation_error.recorded_accelerations import Steps, rotor_response, with_rotors
from tuner.objective.simulation import CODE
from tuner.recordings.flight import Series
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model, with_coefficients

MOTOR_STEP = 1e-2
"""Step of a motor's logarithm, or of a number over its usual size, in finite differences."""


@dataclass(frozen=True)
class LinearisedAccelerations:
    """The accelerations of one flight's N steps about a point of K scaled coordinates.

    Attributes
    ----------
    steps
        As they were recorded.
    errors
        (N, 6) recorded accelerations minus the model's.
    columns
        (N, 6, K) derivatives of the model's, or by fewer coordinates where only these are asked.
    """

    steps: Steps
    errors: Array
    columns: Array


@dataclass(frozen=True)
class ModelAccelerations:
    """The model's accelerations at all recorded steps of several flights.

    Attributes
    ----------
    model
        Gives the fixed coefficients.
    parameters
        The K free ones.
    commands
        Of each flight (n, 4), held from tick to tick of a clock, where rotors follow these by the
        motors' curve and lags; none where rotor speeds were recorded.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    flights: tuple[Steps, ...]
    commands: tuple[Series, ...] = ()

    def at(
        self, point: Array, by: NDArray[np.intp] | None = None
    ) -> tuple[LinearisedAccelerations, ...]:
        """Return each flight's accelerations about a point (K,) of scaled coordinates.

        With derivatives by some of these; by default by all.
        """
        flights, by = self._with_rotors(point), np.arange(len(point)) if by is None else by
        made = _modelled(self.model, self.parameters, point, flights, by)
        errors = [
            part.accelerations - values for part, (values, _) in zip(flights, made, strict=True)
        ]
        columns = [of_flight.copy() for _, of_flight in made]
        here = self._model(point) if self.commands else self.model
        for number, which in enumerate(by if self.commands else ()):
            parameter = self.parameters[which]
            if moves_rotors(parameter.name):
                step = MOTOR_STEP * (parameter.usual or 1.0)
                beside = self._with_rotors(point + step * np.eye(len(point))[which])
                ends = _modelled(here, (), np.zeros(0), beside, by[:0])
                for flight, (part, (modelled, _)) in enumerate(zip(beside, ends, strict=True)):
                    change = errors[flight] - (part.accelerations - modelled)
                    columns[flight][:, :, number] = change / step
        return tuple(map(LinearisedAccelerations, flights, errors, columns))

    def _model(self, point: Array) -> Model:
        values = values_at(self.parameters, point)
        return with_coefficients(self.model, {n: np.asarray(v) for n, v in values.items()})

    def _with_rotors(self, point: Array) -> tuple[Steps, ...]:
        """Return the steps with the rotor speeds that a point's motors make of commands."""
        if not self.commands:
            return self.flights
        model, pairs = self._model(point), zip(self.flights, self.commands, strict=True)
        return tuple(with_rotors(part, rotor_response(model, command)) for part, command in pairs)


def moves_rotors(name: str) -> bool:
    """Return whether a coefficient is of the motors' curve and lags that `rotor_response` has."""
    row = COEFFICIENTS[name]
    return row.part == "motors" and not row.is_effect


def values_at(parameters: Sequence[Parameter], point: Array) -> dict[str, float]:
    """Return coefficient -> value of scaled coordinates (K,), tied ones too."""
    return {
        name: float(np.exp(x) if parameter.scale == "log" else x) * ratio
        for parameter, x in zip(parameters, point, strict=True)
        for name, ratio in parameter.ratios.items()
    }


def _modelled(
    model: Model,
    parameters: Sequence[Parameter],
    point: Array,
    flights: Sequence[Steps],
    by: NDArray[np.intp],
) -> list[tuple[Array, Array]]:
    """Return each flight's modelled accelerations (N, 6) and columns (N, 6, k) by k coordinates."""
    # motion, rotor speeds and accelerations of all flights' steps
    steps: Any = jax.tree.map(
        lambda *leaves: np.concatenate(leaves, axis=-1),
        *((part.motion, part.rotor_speed.T, part.rotor_acceleration.T) for part in flights),
    )
    values, slopes = values_at(parameters, point), dict[str, Array]()
    for number, parameter in enumerate(parameters):
        for name, ratio in parameter.ratios.items():
            slope = values[name] if parameter.scale == "log" else ratio
            slopes[name] = slope * (by == number)
    numbers = {name: np.asarray(values[name]) for name in sorted(values)}
    given = (jax.tree.map(np.asarray, model), numbers, steps)
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False), given[0]),
        dict.fromkeys(numbers, Argument((), float, lanes=False, moves=True)),
        jax.tree.map(partial(Argument.of, lanes=True), steps),
    )
    program = program_of(
        _accelerations, arguments, name="accelerations", made_of=total.TERMS, packages=CODE
    )
    run = program(given, [slopes[name] for name in numbers], lanes=steps[1].shape[1])
    columns = run.columns if numbers else np.zeros((*run.values.shape, 0))
    ends = np.cumsum([len(part.rotor_speed) for part in flights])[:-1]
    return list(zip(np.split(run.values, ends), np.split(columns, ends), strict=True))


def _accelerations(given: Any, _: Mapping[str, int]) -> jax.Array:
    """Return specific force and angular acceleration (6,), body axes, at one step."""
    model, numbers, (motion, speeds, changes) = given
    vehicle = with_coefficients(model, numbers).vehicle
    air = Air.around(vehicle, motion, rotor_acceleration=tuple(changes))
    acting = total_wrench(vehicle, motion, tuple(speeds), air)
    turning = angular_acceleration(vehicle.body, motion.body_rate, acting.moment)
    pull = acting.force * (1.0 / vehicle.body.mass)
    return jnp.concatenate([pull.stacked(), turning.stacked()])
