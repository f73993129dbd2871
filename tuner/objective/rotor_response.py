"""Rotor speeds in response to recorded commands, by the simulator's own curve and lag."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import numpy as np

from lanes import Argument, program_of
from sim_jax.motor import Lag, reference_speed
from sim_jax.vehicle import Motor
from tuner.core.numerics import Array
from tuner.objective.simulation import CODE


@dataclass(frozen=True)
class MotorLags:
    """Time constants and delay of rotors.

    Attributes
    ----------
    up, down
        s, time constants.
    delay
        s from a command to its effect.
    """

    up: float
    down: float
    delay: float

    @property
    def coordinates(self) -> Array:
        """Logarithms of the time constants, and the latency in s."""
        return np.array([np.log(self.up), np.log(self.down), self.delay])

    @staticmethod
    def at(coordinates: Array) -> MotorLags:
        """Return the lags of some coordinates."""
        up, down, delay = coordinates
        return MotorLags(float(np.exp(up)), float(np.exp(down)), float(delay))


def rotor_speeds(command: Array, step: float, motor: Motor, lags: MotorLags) -> Array:
    """Return (n, 4) rad/s at the times of commands (n, 4), settled at the first one.

    A command holds until the next, ``step`` s later: over each step its mean is followed.
    """
    still = jax.tree.map(lambda _: np.zeros(1), motor)
    return linearised_speeds(command, step, motor, lags, slopes=still, delays=np.zeros(1))[0]


def linearised_speeds(
    command: Array, step: float, motor: Motor, lags: MotorLags, *, slopes: Motor, delays: Array
) -> tuple[Array, Array]:
    """Return the same and (n, 4, Q), their derivatives along Q directions.

    Parameters
    ----------
    slopes, delays
        (Q,) change of each of the motor's numbers, time constants included, and of the delay in s.
    """
    time = np.arange(len(command)) * step
    delay = time - lags.delay
    held = np.vstack([np.zeros(command.shape[1]), np.cumsum(command[:-1], axis=0)]) * step
    total = np.column_stack([np.interp(delay, time, column) for column in held.T])
    total += np.minimum(delay, 0.0)[:, None] * command[0]
    mean = np.diff(total, axis=0) / step
    # a longer delay moves the commands that are held just before both ends of each step into it
    before = np.arange(len(command)) - 1 - int(np.floor(lags.delay / step + 1e-9))
    change = -np.diff(command[np.clip(before, 0, len(command) - 1)], axis=0) / step
    lagging = eqx.tree_at(
        lambda m: (m.time_constant_up, m.time_constant_down), motor, (lags.up, lags.down)
    )
    given = (jax.tree.map(np.asarray, (lagging, 0.0)), np.asarray(float(step)), mean, change)
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False, moves=True), given[0]),
        Argument.of(given[1], lanes=False),
        *[Argument(("turns",), float, lanes=True)] * 2,
    )
    program = program_of(_followed, arguments, name="rotor speeds", made_of=Lag, packages=CODE)
    moved = jax.tree.leaves((slopes, delays))
    run = program(given, moved, lanes=mean.shape[1], turns=len(mean))
    (begun, speeds), (begins, columns) = run.values, run.columns
    # (4, Q) and (4, Q, turns)
    columns = np.concatenate([begins[..., None], columns], axis=2)
    return np.column_stack([begun, speeds]).T, np.moveaxis(columns, 2, 0)


def _followed(given: Any, _: Mapping[str, int]) -> tuple[Any, Any]:
    """Return one rotor's steady speed at its first command, and its later speeds (turns,)."""
    (motor, shift), step, mean, change = given
    command = mean + shift * change
    lag, begun = Lag.over(motor, step), reference_speed(motor, command[0])

    def advance(speed: Any, command: Any) -> tuple[Any, Any]:
        after, _ = lag.advance(speed, reference_speed(motor, command))
        return after, after

    return begun, jax.lax.scan(advance, begun, command)[1]
