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
    time = np.arange(len(command)) * step
    delay = time - lags.delay
    held = np.vstack([np.zeros(command.shape[1]), np.cumsum(command[:-1], axis=0)]) * step
    total = np.column_stack([np.interp(delay, time, column) for column in held.T])
    total += np.minimum(delay, 0.0)[:, None] * command[0]
    mean = np.diff(total, axis=0) / step
    lagging = eqx.tree_at(
        lambda m: (m.time_constant_up, m.time_constant_down), motor, (lags.up, lags.down)
    )
    given = (jax.tree.map(np.asarray, (lagging, float(step))), mean)
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False), given[0]),
        Argument(("turns",), float, lanes=True),
    )
    program = program_of(_followed, arguments, name="rotor speeds", made_of=Lag, packages=CODE)
    begun, speeds = program(given, lanes=mean.shape[1], turns=len(mean)).values
    return np.column_stack([begun, speeds]).T


def _followed(given: Any, _: Mapping[str, int]) -> tuple[Any, Any]:
    """Return one rotor's steady speed at its first command, and its later speeds (turns,)."""
    (motor, step), command = given
    lag, begun = Lag.over(motor, step), reference_speed(motor, command[0])

    def advance(speed: Any, command: Any) -> tuple[Any, Any]:
        after, _ = lag.advance(speed, reference_speed(motor, command))
        return after, after

    return begun, jax.lax.scan(advance, begun, command)[1]
