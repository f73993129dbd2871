"""The accelerations that the model's forces and moments make of recorded states and inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.rigid_body import Motion, angular_acceleration
from sim_jax.terms.air import Air
from sim_jax.terms.total import total_wrench
from tuner.equation_error.measured import Measured
from tuner.recordings.flight import Array
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.model import Model, with_coefficients

NUDGE = 1e-3
"""Change of a scaled coordinate over its usual size, and of a rotor's speed over itself, by which
accelerations are differentiated: they are linear in most."""
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


@dataclass(frozen=True)
class Accelerations:
    """The model's accelerations at all recorded steps of several flights.

    Attributes
    ----------
    model
        Holds the coefficients that do not move.
    parameters
        The K that do.
    flights
        Their steps.
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
        nudge = NUDGE * np.array([p.usual or 1.0 for p in self.parameters])
        points = np.stack([point, *(point + np.diag(nudge)), *(point - np.diag(nudge))])
        names = tuple(name for p in self.parameters for name in p.ratios)
        numbers = np.stack([list(values_at(self.parameters, there).values()) for there in points])
        motion, speed, acceleration = steps
        there = motion, speed * (1.0 + faster), acceleration
        made = np.asarray(_accelerations(self.model, names, numbers, there))
        above, below = np.split(made[1:], 2)
        return made[0], np.moveaxis((above - below) / (2.0 * nudge)[:, None, None], 0, -1)


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


@eqx.filter_jit
def _accelerations(
    model: Model,
    names: tuple[str, ...],
    numbers: Array,
    steps: tuple[Motion, Array, Array],
) -> jax.Array:
    """Return (B, M, 6) specific force and angular acceleration, body axes, at B sets of values.

    Parameters
    ----------
    model
        Holds the coefficients that are not named.
    names, numbers
        Coefficients, and their values (B, names).
    steps
        Motion, leaves (M,), and rotor speeds and their change, (M, 4).
    """
    motion = steps[0]
    speeds, changes = (tuple(map(jnp.asarray, part.T)) for part in steps[1:])

    def made(row: jax.Array) -> jax.Array:
        vehicle = with_coefficients(model, dict(zip(names, row, strict=True))).vehicle
        air = Air.around(vehicle, motion, rotor_acceleration=changes)
        acting = total_wrench(vehicle, motion, speeds, air)
        turning = angular_acceleration(vehicle.body, motion.body_rate, acting.moment)
        pull = acting.force * (1.0 / vehicle.body.mass)
        return jnp.concatenate([pull.stacked(), turning.stacked()]).T

    found: jax.Array = jax.vmap(made)(jnp.asarray(numbers))
    return found
