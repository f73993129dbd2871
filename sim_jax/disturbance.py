"""What pushes a vehicle and is no law of its motion: gusts, turbulence, thrust that wanders."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int

from sim_jax.numeric import Array
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.schedule import Schedule
from sim_jax.trees import row_of
from sim_jax.vector import Vec3


class Disturbance(eqx.Module):
    """Series with a value for every tick, linear in between; what is None is not there.

    After its end the last value stays.
    """

    gust: Vec3 | None = None
    """m/s, world ENU, leaves (ticks, \\*batch): the air's velocity beside the steady wind."""
    force: Vec3 | None = None
    """N, world ENU, leaves (ticks, \\*batch): acts at the centre of mass."""
    thrust: Float[Array, "ticks *batch"] | None = None
    """N along body z."""
    moment: Vec3 | None = None
    """N m about the centre of mass, body axes, leaves (ticks, \\*batch)."""
    rate: float | None = eqx.field(static=True, default=None)
    """Hz of the ticks; None for those of position control."""

    def during(self, step: Int[Array, ""], schedule: Schedule) -> Disturbance:
        """Return the values in the middle of a physics step, every leaf (\\*batch)."""
        rate = schedule.position_control_rate if self.rate is None else self.rate
        ticks = (step + 0.5) * (rate / schedule.physics_rate)
        tick = jnp.floor(ticks)
        before, share = tick.astype(step.dtype), ticks - tick

        def between(old: Array, new: Array) -> Array:
            return old + share.astype(old.dtype) * (new - old)

        now: Disturbance = jax.tree.map(between, row_of(self, before), row_of(self, before + 1))
        return now

    def plus(self, other: Disturbance) -> Disturbance:
        """Return what both are together, in this one's ticks."""

        def both(first: Any, second: Any) -> Any:
            return first if second is None else second if first is None else first + second

        return Disturbance(
            gust=both(self.gust, other.gust),
            force=both(self.force, other.force),
            thrust=both(self.thrust, other.thrust),
            moment=both(self.moment, other.moment),
            rate=self.rate,
        )

    def added_to(self, wrench: Wrench, motion: Motion) -> Wrench:
        """Return what acts about the centre of mass where values (\\*batch) act besides."""
        force, moment = wrench.force, wrench.moment
        if self.force is not None:
            force = force + motion.attitude.to_body(self.force)
        if self.thrust is not None:
            force = Vec3(force.x, force.y, force.z + self.thrust)
        if self.moment is not None:
            moment = moment + self.moment
        return Wrench(force, moment)
