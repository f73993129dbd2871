"""The accelerations that the model's forces and moments make of recorded states and inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from lanes import Argument, Program, program_of
from sim_jax.environment import Air
from sim_jax.rigid_body import Motion, angular_acceleration
from sim_jax.terms import total
from sim_jax.terms.total import total_wrench
from tuner.core.numerics import Array
from tuner.equation_error.measured import Measured
from tuner.objective.simulation import CODE
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model, with_coefficients

NUDGE = 1e-3
"""Change of a rotor's speed over itself by which accelerations are differentiated."""
ROTORS = 4
EVERY = 5
"""Steps of which one tells how the noise of rotor speeds moves what is computed."""


@dataclass(frozen=True)
class Linear:
    """The accelerations of one flight's N steps about a point of K scaled coordinates.

    Attributes
    ----------
    left
        (N, 6) recorded accelerations minus the model's.
    columns
        (N, 6, K) derivatives of the model's.
    moved
        (6, K, K): how the noise of rotor speeds moves columns together; the mean over steps and sum
        over rotors of products of derivatives by a rotor's speed.
    crossed
        (6, K): likewise of columns and the model's accelerations.
    """

    left: Array
    columns: Array
    moved: Array
    crossed: Array


class ModelAccelerations(Protocol):
    """The model's accelerations at all steps of several flights, see `Accelerations`."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The K that move."""
        ...

    @property
    def flights(self) -> tuple[Measured, ...]:
        """Their steps."""
        ...

    def at(self, point: Array, *, noise: bool = True) -> tuple[Linear, ...]:
        """Return each flight's accelerations about a point (K,) of scaled coordinates."""
        ...


@dataclass(frozen=True)
class Accelerations:
    """The model's accelerations at all recorded steps of several flights.

    Attributes
    ----------
    model
        Holds the coefficients that do not move.
    parameters
        The K that do.
    """

    model: Model
    parameters: tuple[Parameter, ...]
    flights: tuple[Measured, ...]
    _steps: tuple[Motion, Array, Array] = field(init=False, repr=False)
    _few: tuple[Motion, Array, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_steps", _joined(self.flights, 1))
        object.__setattr__(self, "_few", _joined(self.flights, EVERY))

    def at(self, point: Array, *, noise: bool = True) -> tuple[Linear, ...]:
        """Return each flight's accelerations about a point (K,) of scaled coordinates.

        ``noise``: whether the rotor speeds' is asked for, which takes most of the time.
        """
        modelled, columns = self._with_columns(point, np.zeros(ROTORS), self._steps)
        parts, few = _places(self.flights, 1), _places(self.flights, EVERY)
        size = len(self.parameters)
        moved, crossed = np.zeros((len(parts), 6, size, size)), np.zeros((len(parts), 6, size))
        for rotor in range(ROTORS if noise else 0):
            ends = [
                self._with_columns(point, sign * NUDGE * np.eye(ROTORS)[rotor], self._few)
                for sign in (1.0, -1.0)
            ]
            change = 2.0 * NUDGE * self._few[1][:, rotor, None]
            made = (ends[0][0] - ends[1][0]) / change
            by = (ends[0][1] - ends[1][1]) / change[..., None]
            for number, rows in enumerate(few):
                count = rows.stop - rows.start
                moved[number] += np.einsum("nak,nal->akl", by[rows], by[rows]) / count
                crossed[number] += np.einsum("nak,na->ak", by[rows], made[rows]) / count
        return tuple(
            Linear(part.accelerations - modelled[rows], columns[rows], moved[n], crossed[n])
            for n, (part, rows) in enumerate(zip(self.flights, parts, strict=True))
        )

    def _with_columns(
        self, point: Array, faster: Array, steps: tuple[Motion, Array, Array]
    ) -> tuple[Array, Array]:
        """Return accelerations (M, 6) and columns (M, 6, K) with rotors (4,) faster by a share."""
        motion, speed, acceleration = steps
        numbers, directions = _numbers(self.parameters, point)
        given = (
            jax.tree.map(np.asarray, self.model),
            numbers,
            (motion, (speed * (1.0 + faster)).T, acceleration.T),
        )
        run = _program_for(given)(given, directions, lanes=len(speed))
        return run.values, run.columns if directions else np.zeros((*run.values.shape, 0))


def _joined(flights: Sequence[Measured], every: int) -> tuple[Motion, Array, Array]:
    """Return motion, rotor speeds and their change at every so many steps of all flights."""
    motions = [jax.tree.map(lambda leaf: leaf[::every], part.motion) for part in flights]
    return (
        jax.tree.map(lambda *leaves: np.concatenate(leaves), *motions),
        np.concatenate([part.rotor_speed[::every] for part in flights]),
        np.concatenate([part.rotor_acceleration[::every] for part in flights]),
    )


def _places(flights: Sequence[Measured], every: int) -> list[slice]:
    """Return where each flight's steps lie among all flights'."""
    ends = np.cumsum([0, *(len(part.rotor_speed[::every]) for part in flights)]).tolist()
    return [slice(*pair) for pair in pairwise(ends)]


def values_at(parameters: Sequence[Parameter], point: Array) -> dict[str, float]:
    """Return coefficient -> value of scaled coordinates (K,), tied ones too."""
    return {
        name: float(np.exp(x) if parameter.scale == "log" else x) * ratio
        for parameter, x in zip(parameters, point, strict=True)
        for name, ratio in parameter.ratios.items()
    }


def _numbers(parameters: Sequence[Parameter], point: Array) -> tuple[dict[str, Array], list[Array]]:
    """Return coefficient -> value at a point (K,), and the derivatives (K,), sorted by name."""
    values, slopes = values_at(parameters, point), dict[str, Array]()
    for number, parameter in enumerate(parameters):
        for name, ratio in parameter.ratios.items():
            slope = values[name] if parameter.scale == "log" else ratio
            slopes[name] = slope * np.eye(len(parameters))[number]
    names = sorted(values)
    return {name: np.asarray(values[name]) for name in names}, [slopes[name] for name in names]


def _program_for(given: Any) -> Program:
    model, numbers, steps = given
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False), model),
        dict.fromkeys(numbers, Argument((), float, lanes=False, moves=True)),
        jax.tree.map(partial(Argument.of, lanes=True), steps),
    )
    return program_of(
        _accelerations, arguments, name="accelerations", made_of=total.TERMS, packages=CODE
    )


def _accelerations(given: Any, _: Mapping[str, int]) -> jax.Array:
    """Return specific force and angular acceleration (6,), body axes, at one step."""
    model, numbers, (motion, speeds, changes) = given
    vehicle = with_coefficients(model, numbers).vehicle
    air = Air.around(vehicle, motion, rotor_acceleration=tuple(changes))
    acting = total_wrench(vehicle, motion, tuple(speeds), air)
    turning = angular_acceleration(vehicle.body, motion.body_rate, acting.moment)
    pull = acting.force * (1.0 / vehicle.body.mass)
    return jnp.concatenate([pull.stacked(), turning.stacked()])
