"""The rotor speeds that follow recorded commands, by the simulator's own curve and lag."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.motor import Lag, reference_speed
from sim_jax.vehicle import Motor
from tuner.core.numerics import Array


@dataclass(frozen=True)
class Lags:
    """How rotors follow commands.

    Attributes
    ----------
    up, down
        s, time constants.
    late
        s from a command to its effect.
    """

    up: float
    down: float
    late: float

    @property
    def coordinates(self) -> Array:
        """Logarithms of the time constants, and the latency in s."""
        return np.array([np.log(self.up), np.log(self.down), self.late])

    @staticmethod
    def at(coordinates: Array) -> Lags:
        """Return the lags of some coordinates."""
        up, down, late = coordinates
        return Lags(float(np.exp(up)), float(np.exp(down)), float(late))


def rotor_speeds(command: Array, step: float, motor: Motor, lags: Lags) -> Array:
    """Return (n, 4) rad/s at the times of commands (n, 4), settled at the first one.

    A command holds until the next, ``step`` s later: over each step its mean is followed.
    """
    time = np.arange(len(command)) * step
    late = time - lags.late
    held = np.vstack([np.zeros(command.shape[1]), np.cumsum(command[:-1], axis=0)]) * step
    total = np.column_stack([np.interp(late, time, column) for column in held.T])
    total += np.minimum(late, 0.0)[:, None] * command[0]
    mean = np.diff(total, axis=0) / step
    return np.asarray(_followed(mean, motor, lags.up, lags.down, step))


@jax.jit
def _followed(command: Array, motor: Motor, up: float, down: float, step: float) -> jax.Array:
    lagging = eqx.tree_at(
        lambda m: (m.time_constant_up, m.time_constant_down),
        motor,
        (jnp.asarray(up), jnp.asarray(down)),
    )
    lag = Lag.over(lagging, step)
    asked = jax.vmap(lambda row: reference_speed(motor, row))(jnp.asarray(command))

    def advance(speed: Any, reference: Any) -> tuple[Any, Any]:
        after, _ = lag.advance(speed, reference)
        return after, after

    speeds: jax.Array = jax.lax.scan(advance, asked[0], asked)[1]
    return jnp.concatenate([asked[:1], speeds])
