"""Where a recorded signal enters the loop and replaces everything upstream of it."""

from __future__ import annotations

from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from sim_jax.control.position import ReferencePoint
from sim_jax.numeric import Scalar
from sim_jax.vector import Vec3
from sim_jax.vehicle import PerRotor


class ReferenceInlet(eqx.Module):
    """The whole loop is simulated; leaves of ``points`` are (ticks, \\*batch), one a control tick.

    After its end the last point is held.
    """

    points: ReferencePoint
    spins: Bool[Array, "*batch"] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    """Where true, the rate set-point is (0, 0, yaw_rate) and only thrust is position-controlled."""
    yaw_rate: Scalar = eqx.field(default_factory=lambda: jnp.zeros(()))
    """rad/s, body z."""


class BodyRateInlet(eqx.Module):
    """Rate and thrust set-points enter; leaves are (physics steps, \\*batch)."""

    rate: Vec3
    """rad/s, body FLU."""
    thrust: Float[Array, "steps *batch"]


class ActuatorInlet(eqx.Module):
    """Motor commands 0..1 enter; leaves are (physics steps, \\*batch)."""

    command: PerRotor


class RotorSpeedInlet(eqx.Module):
    """Rotor speeds in rad/s enter the aerodynamics; leaves are (physics steps, \\*batch)."""

    speed: PerRotor


SingleInlet: TypeAlias = ReferenceInlet | BodyRateInlet | ActuatorInlet | RotorSpeedInlet


class MixedInlet(eqx.Module):
    """Each vehicle of a batch has its own inlet; the loop is stepped once for every part."""

    parts: tuple[SingleInlet, ...]
    """For the whole batch each; what a part holds for a vehicle of another part is ignored."""
    kind: Int[Array, "*batch"]
    """Number of the part that each vehicle uses."""


Inlet: TypeAlias = SingleInlet | MixedInlet
