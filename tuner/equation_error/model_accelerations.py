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
from sim_jax import terms
from sim_jax.environment import Air
from sim_jax.rigid_body import angular_acceleration
from tuner.core.numerics import Array
from tuner.equation_error.recorded_accelerations import (
    Mask,
    Steps,
    directions,
    rotor_response,
    weighed_rotors,
    with_rotors,
)
from tuner.objective.simulation import CODE
from tuner.recordings.flight import Series
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model, with_coefficients


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
        by = np.arange(len(point)) if by is None else by
        values, slopes = values_at(self.parameters, point), self._slopes(point)
        motors = [n for n, p in enumerate(self.parameters) if moves_rotors(p.name)] or [-1]
        flights, turned = self.flights, None
        if self.commands:
            of_motors = {n: slope[motors] for n, slope in slopes.items() if moves_rotors(n)}
            flights, turned = self._by_commands(
                values, directions(self.model, of_motors, len(motors))
            )
        of_point = {name: slope[by] for name, slope in slopes.items()}
        by_motors = by[:, None] == motors
        made = _modelled(self.model, values, of_point, flights, turned=turned, by_motors=by_motors)
        return tuple(
            LinearisedAccelerations(part, part.accelerations - accelerations, columns)
            for part, (accelerations, columns) in zip(flights, made, strict=True)
        )

    def _slopes(self, point: Array) -> dict[str, Array]:
        """Return coefficient -> derivatives (K,) of its value by a point's coordinates (K,)."""
        return {
            name: ratio * parameter.error_at(x, 1.0) * unit
            for parameter, x, unit in zip(self.parameters, point, np.eye(len(point)), strict=True)
            for name, ratio in parameter.ratios.items()
        }

    def _by_commands(
        self, values: Mapping[str, float], slopes: Model
    ) -> tuple[tuple[Steps, ...], Array]:
        """Return the steps with the rotor speeds that motors make of commands, and derivatives.

        These (8, q, N) are those of all flights' rotor speeds and accelerations along q directions.
        """
        model = with_coefficients(self.model, {n: np.asarray(v) for n, v in values.items()})
        steps, changes = list[Steps](), list[Array]()
        for part, command in zip(self.flights, self.commands, strict=True):
            speeds, derivatives = rotor_response(model, command, slopes)
            steps.append(with_rotors(part, speeds))
            weighed = weighed_rotors(part, derivatives).reshape(2, len(part.time), 4, -1)
            changes.append(np.concatenate(list(weighed), axis=1))
        return tuple(steps), np.moveaxis(np.concatenate(changes), 0, -1)


def moves_rotors(name: str) -> bool:
    """Return whether a coefficient is of the motors' curve and lags that `rotor_response` has."""
    row = COEFFICIENTS[name]
    return row.part == "motors" and not row.is_effect


def values_at(parameters: Sequence[Parameter], point: Array) -> dict[str, float]:
    """Return coefficient -> value of scaled coordinates (K,), tied ones too."""
    return {
        name: parameter.value_at(x) * ratio
        for parameter, x in zip(parameters, point, strict=True)
        for name, ratio in parameter.ratios.items()
    }


def _modelled(
    model: Model,
    values: Mapping[str, float],
    slopes: Mapping[str, Array],
    flights: Sequence[Steps],
    *,
    turned: Array | None,
    by_motors: Mask,
) -> list[tuple[Array, Array]]:
    """Return each flight's modelled accelerations (N, 6) and columns (N, 6, k) by k coordinates.

    Of these, ``by_motors`` (k, q) are directions along which rotor speeds change, too: by
    ``turned`` (8, q, N), of all flights.
    """
    # motion, rotor speeds and accelerations of all flights' steps
    steps: Any = jax.tree.map(
        lambda *leaves: np.concatenate(leaves, axis=-1),
        *(
            (part.motion, np.hstack([part.rotor_speed, part.rotor_acceleration]).T)
            for part in flights
        ),
    )
    numbers = {name: np.asarray(values[name]) for name in sorted(values)}
    tangents, shift = [slopes[name] for name in numbers], None
    if turned is not None:
        shift = np.zeros(turned.shape[1])
        tangents.append(by_motors.astype(float))
    given = (jax.tree.map(np.asarray, model), (numbers, shift), (*steps, turned))
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False), given[0]),
        jax.tree.map(partial(Argument.of, lanes=False, moves=True), given[1]),
        jax.tree.map(partial(Argument.of, lanes=True), given[2]),
    )
    program = program_of(
        _accelerations, arguments, name="accelerations", made_of=terms.TERMS, packages=CODE
    )
    run = program(given, tangents, lanes=steps[1].shape[1])
    columns = np.zeros((*run.values.shape, 0)) if run.columns is None else run.columns
    ends = np.cumsum([len(part.rotor_speed) for part in flights])[:-1]
    return list(zip(np.split(run.values, ends), np.split(columns, ends), strict=True))


def _accelerations(given: Any, _: Mapping[str, int]) -> jax.Array:
    """Return specific force and angular acceleration (6,), body axes, at one step."""
    model, (numbers, shift), (motion, rotors, turned) = given
    if shift is not None:
        rotors = rotors + jnp.sum(turned * shift, axis=1)
    speeds, changes = jnp.split(rotors, 2)
    vehicle = with_coefficients(model, numbers).vehicle
    air = Air.around(vehicle, motion, rotor_acceleration=tuple(changes))
    acting = terms.total_wrench(vehicle, motion, tuple(speeds), air)
    turning = angular_acceleration(vehicle.body, motion.body_rate, acting.moment)
    pull = acting.force * (1.0 / vehicle.body.mass)
    return jnp.concatenate([pull.stacked(), turning.stacked()])
