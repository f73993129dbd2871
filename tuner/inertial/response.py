"""Rotor speeds that follow recorded commands, by the simulator's own curve and lag."""

from __future__ import annotations

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.motor import Lag, reference_speed
from sim_jax.vehicle import Motor
from tuner.inertial.signals import Stretch
from tuner.recordings.flight import Array


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


def rotor_speeds(stretch: Stretch, motor: Motor, lags: Lags) -> Array:
    """Return (n, 4) rad/s, settled at the first command."""
    late = [
        np.interp(stretch.time - lags.late, stretch.time, column) for column in stretch.command.T
    ]
    return np.asarray(_followed(np.column_stack(late), motor, lags.up, lags.down, stretch.step))


@jax.jit
def _followed(command: Array, motor: Motor, up: float, down: float, step: float) -> jax.Array:
    lagging = eqx.tree_at(
        lambda m: (m.time_constant_up, m.time_constant_down),
        motor,
        (jnp.asarray(up), jnp.asarray(down)),
    )
    lag = Lag.over(lagging, step)
    asked = jax.vmap(lambda row: reference_speed(motor, row))(jnp.asarray(command))

    def advance(speed: jax.Array, reference: jax.Array) -> tuple[jax.Array, jax.Array]:
        after, _ = lag.advance(speed, reference)
        return after, after

    return jax.lax.scan(advance, asked[0], asked)[1]
