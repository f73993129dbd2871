"""When a flight has ended badly: the state is frozen there, so that every number stays finite."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from sim_jax.numeric import Flag
from sim_jax.rigid_body import Motion


class Limits(eqx.Module):
    """The space in which a flight counts as flying; static."""

    floor: float = eqx.field(static=True, default=0.227)
    """m, height of the landing gear below which the vehicle has hit the ground."""
    half_width: float = eqx.field(static=True, default=50.0)
    """m from the origin along any axis beyond which the vehicle has flown away."""
    fastest_rate: float = eqx.field(static=True, default=60.0)
    """rad/s of body rate about any axis beyond which the vehicle tumbles."""

    def broken_by(self, motion: Motion) -> Flag:
        """Return which vehicles are outside the limits; not-a-number counts as outside."""
        position, rate = motion.position, motion.body_rate
        inside = position.z >= self.floor
        for distance in (position.x, position.y, position.z):
            inside &= jnp.abs(distance) <= self.half_width
        for speed in (rate.x, rate.y, rate.z):
            inside &= jnp.abs(speed) <= self.fastest_rate
        return ~inside


AIRBORNE = Limits(floor=-1e3, half_width=1e3)
"""For recordings that leave the ground or an origin elsewhere: only tumbling ends the flight."""
