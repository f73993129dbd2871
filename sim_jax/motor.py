"""Command to rotor speed: RPM curve, speed limit, first-order lag up and down (Eq. 4.2, 5.3)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from sim_jax.numeric import Scalar
from sim_jax.vehicle import Motor


class Lag(eqx.Module):
    """The exact first-order filter over one physics step, prepared once a rollout."""

    decay_up: Scalar
    decay_down: Scalar
    mean_up: Scalar
    mean_down: Scalar

    @staticmethod
    def over(motor: Motor, step: Scalar | float) -> Lag:
        """Prepare the filter α = exp(-step/τ), and the mean of the decay over the step.

        Parameters
        ----------
        motor
            Gives both time constants in s.
        step
            Physics step in s.
        """
        decay_up = jnp.exp(-step / motor.time_constant_up)
        decay_down = jnp.exp(-step / motor.time_constant_down)
        return Lag(
            decay_up=decay_up,
            decay_down=decay_down,
            mean_up=(1.0 - decay_up) * motor.time_constant_up / step,
            mean_down=(1.0 - decay_down) * motor.time_constant_down / step,
        )

    def advance(self, speed: Scalar, reference: Scalar) -> tuple[Scalar, Scalar]:
        """Return the rotor speed after the step and its mean over the step, in rad/s."""
        rising = reference > speed
        gap = speed - reference
        after = reference + jnp.where(rising, self.decay_up, self.decay_down) * gap
        mean = reference + jnp.where(rising, self.mean_up, self.mean_down) * gap
        return after, mean


def reference_speed(motor: Motor, command: Scalar) -> Scalar:
    """Return the rotor speed in rad/s that a command in 0..1 asks for."""
    shifted = command + motor.input_offset
    speed = shifted * (motor.input_scaling + motor.quadratic * shifted) + motor.zero_position_armed
    return jnp.where(speed > motor.max_rotor_velocity, motor.max_rotor_velocity, speed)
