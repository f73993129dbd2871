"""The accelerations that the model's forces and moments make of recorded states and inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

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

SPEED_STEP = 1e-3
"""Change of a rotor's speed over itself by which accelerations are differentiated."""
CHANGE_STEP = 100.0
"""rad/s², likewise of a rotor's acceleration."""
MOTOR_STEP = 1e-2
"""Step of a motor's logarithm, or of a number over its usual size, likewise."""
ROTORS = 4
EVERY = 5
"""Steps of which one tells how the noise of rotor speeds moves what is computed."""


@dataclass(frozen=True)
class Linear:
    """The accelerations of one flight's N steps about a point of K scaled coordinates.

    Attributes
    ----------
    steps
        As they were recorded.
    left
        (N, 6) recorded accelerations minus the model's.
    columns
        (N, 6, K) derivatives of the model's.
    moved
        (2, 2, 6, K, K): how the noise of rotor speeds moves columns together; the mean over steps
        and sum over rotors of products of derivatives by a rotor's speed and by its acceleration.
        Zero without noise.
    crossed
        (2, 2, 6, K): likewise of columns and the model's accelerations.
    """

    steps: Steps
    left: Array
    columns: Array
    moved: Array
    crossed: Array


@dataclass(frozen=True)
class ModelAccelerations:
    """The model's accelerations at all recorded steps of several flights.

    Attributes
    ----------
    model
        Holds the coefficients that do not move.
    parameters
        The K that do.
    commands
        Of each flight (n, 4), held from tick to tick of a clock, where rotors follow these by the
        motors' curve and lags; none where rotor speeds were recorded.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    flights: tuple[Steps, ...]
    commands: tuple[Series, ...] = ()

    @property
    def noisy(self) -> bool:
        """Whether rotor speeds hold noise."""
        return any(part.noise > 0.0 for part in self.flights)

    @property
    def noiseless(self) -> ModelAccelerations:
        """The same with rotor speeds that are taken as they are."""
        return replace(self, flights=tuple(replace(part, noise=0.0) for part in self.flights))

    def at(self, point: Array) -> tuple[Linear, ...]:
        """Return each flight's accelerations about a point (K,) of scaled coordinates.

        With noise, which takes most of the time.
        """
        flights, size = self._with_rotors(point), len(self.parameters)
        made = _made(self.model, self.parameters, point, flights)
        left = [
            part.accelerations - values for part, (values, _) in zip(flights, made, strict=True)
        ]
        columns = [of_flight.copy() for _, of_flight in made]
        for number, parameter in enumerate(self.parameters if self.commands else ()):
            if moves_rotors(parameter.name):
                step = MOTOR_STEP * (parameter.usual or 1.0)
                beside = self._with_rotors(point + step * np.eye(size)[number])
                ends = _made(self._model(point), (), np.zeros(0), beside)
                for flight, (part, (modelled, _)) in enumerate(zip(beside, ends, strict=True)):
                    change = left[flight] - (part.accelerations - modelled)
                    columns[flight][:, :, number] = change / step
        moved = np.zeros((len(left), 2, 2, 6, size, size))
        crossed = np.zeros((len(left), 2, 2, 6, size))
        for rotor in range(ROTORS if self.noisy else 0):
            slopes = [
                self._slopes(point, flights, which * np.eye(ROTORS)[rotor])
                for which in np.eye(2)[:, :, None]
            ]
            for number, of_flight in enumerate(zip(*slopes, strict=True)):
                values, columns_by = (
                    np.stack(parts).swapaxes(1, 2) for parts in zip(*of_flight, strict=True)
                )
                mean = columns_by.mT / values.shape[-1]
                moved[number] += mean[:, None] @ columns_by
                crossed[number] += (mean[:, None] @ values[..., None])[..., 0]
        return tuple(map(Linear, flights, left, columns, moved, crossed))

    def _slopes(
        self, point: Array, flights: Sequence[Steps], by: Array
    ) -> list[tuple[Array, Array]]:
        """Return each flight's derivatives of accelerations (n, 6) and of columns (n, 6, K).

        By the rotors' speed, accelerations or both, which move by (2, 4) of their steps.
        """
        change = np.array([[SPEED_STEP], [CHANGE_STEP]]) * by
        above, below = (
            _made(self.model, self.parameters, point, [_faster(part, c) for part in flights])
            for c in (change, -change)
        )
        spans = [
            2.0 * (part.rotor_speed[::EVERY] @ change[0] + change[1].sum()) for part in flights
        ]
        return [
            ((high[0] - low[0]) / span[:, None], (high[1] - low[1]) / span[:, None, None])
            for high, low, span in zip(above, below, spans, strict=True)
        ]

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


def _faster(part: Steps, change: Array) -> Steps:
    """Return every so manyth step, with rotors (4,) faster by a share, and so many rad/s²."""
    return replace(
        part,
        motion=jax.tree.map(lambda leaf: leaf[::EVERY], part.motion),
        rotor_speed=part.rotor_speed[::EVERY] * (1.0 + change[0]),
        rotor_acceleration=part.rotor_acceleration[::EVERY] + change[1],
    )


def _made(
    model: Model, parameters: Sequence[Parameter], point: Array, flights: Sequence[Steps]
) -> list[tuple[Array, Array]]:
    """Return each flight's modelled accelerations (N, 6) and columns (N, 6, K)."""
    values, slopes = values_at(parameters, point), dict[str, Array]()
    for number, parameter in enumerate(parameters):
        for name, ratio in parameter.ratios.items():
            slope = values[name] if parameter.scale == "log" else ratio
            slopes[name] = slope * np.eye(len(parameters))[number]
    steps = jax.tree.map(
        lambda *leaves: np.concatenate(leaves, axis=-1),
        *((part.motion, part.rotor_speed.T, part.rotor_acceleration.T) for part in flights),
    )
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
