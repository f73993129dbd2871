"""Which loop runs when: rates of physics, rate control, position control and the log."""

from __future__ import annotations

from math import lcm
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Bool, Int

from sim_jax.numeric import Array
from sim_jax.rigid_body import Integrator


class Schedule(eqx.Module):
    """The rates of a simulated flight; all static, each combination compiles once."""

    physics_rate: int = eqx.field(static=True, default=400)
    """Hz of the integration; the fastest."""
    rate_control_rate: int = eqx.field(static=True, default=400)
    """Hz of rate controller, mixer and gyro filters (SITL: 250)."""
    position_control_rate: int = eqx.field(static=True, default=100)
    """Hz of position and attitude control, and of the reference."""
    log_rate: int = eqx.field(static=True, default=100)
    """Hz of the logged samples; divides physics_rate."""
    integrator: Literal["midpoint", "semi_implicit"] | Integrator = eqx.field(
        static=True, default="midpoint"
    )
    """Second order with the rotors' mean speed over the step; first order as Gazebo's engine; or a
    function that takes the step. The last two hold the rotor speed of before the step, as Gazebo
    does."""
    pose_rate: float | None = eqx.field(static=True, default=None)
    """Hz at which poses reach the controller, which keeps the last in between; None: every tick."""
    longest_estimate_latency: float = eqx.field(static=True, default=0.0)
    """The length of the estimate's delay line, s; 0 for none."""
    longest_actuator_latency: float = eqx.field(static=True, default=0.0)
    """The length of the commands' delay line, s; 0 for none."""

    def __check_init__(self) -> None:
        for name in ("rate_control_rate", "position_control_rate", "log_rate"):
            if not 0 < getattr(self, name) <= self.physics_rate:
                raise ValueError(f"{name} must be above 0 and at most physics_rate")
        if self.physics_rate % self.log_rate:
            raise ValueError("log_rate must divide physics_rate")

    @property
    def step(self) -> float:
        """Seconds of one physics step."""
        return 1.0 / self.physics_rate

    @property
    def block_rate(self) -> int:
        """Hz of the outer loop, on whose ticks position control runs and samples are logged.

        The slowest such rate; that of physics where the two do not fit into it.
        """
        both = lcm(self.position_control_rate, self.log_rate)
        return self.physics_rate if self.physics_rate % both else both

    @property
    def steps_per_block(self) -> int:
        """Physics steps in one turn of the outer loop."""
        return self.physics_rate // self.block_rate

    @property
    def blocks_per_sample(self) -> int:
        """Turns of the outer loop from one logged sample to the next."""
        return self.block_rate // self.log_rate

    def control_tick(self, step: Int[Array, ""]) -> Int[Array, ""]:
        """Return the number of the position controller's tick that is current at a physics step."""
        steps = jnp.asarray(self.physics_rate, step.dtype)
        return lax.div(step * self.position_control_rate, steps)

    def is_due(self, step: Int[Array, ""], rate: int) -> Bool[Array, ""]:
        """Return whether a loop of a rate in Hz runs at a physics step.

        That is where ⌊step·rate/physics_rate⌋ is greater than it was at the last step.
        """
        return lax.rem(step * rate, jnp.asarray(self.physics_rate, step.dtype)) < rate
