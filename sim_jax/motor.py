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
            Physics step in s, or a part of it, which may be zero.
        """
        up, down = step / motor.time_constant_up, step / motor.time_constant_down
        return Lag(
            decay_up=jnp.exp(-up),
            decay_down=jnp.exp(-down),
            mean_up=_mean_decay(up),
            mean_down=_mean_decay(down),
        )

    def advance(self, speed: Scalar, reference: Scalar) -> tuple[Scalar, Scalar]:
        """Return the rotor speed after the step and its mean over the step, in rad/s."""
        rising = reference > speed
        gap = speed - reference
        after = reference + jnp.where(rising, self.decay_up, self.decay_down) * gap
        mean = reference + jnp.where(rising, self.mean_up, self.mean_down) * gap
        return after, mean


class SwitchedLag(eqx.Module):
    """The same filter over a step in which a delayed command changes part of the way through."""

    early: Lag
    late: Lag
    share: Scalar
    """Part of the step before the change, 0..1."""

    @staticmethod
    def over(motor: Motor, step: float, share: Scalar) -> SwitchedLag:
        """Prepare both parts of a step of ``step`` s."""
        return SwitchedLag(
            Lag.over(motor, step * share), Lag.over(motor, step * (1.0 - share)), share
        )

    def advance(self, speed: Scalar, before: Scalar, after: Scalar) -> tuple[Scalar, Scalar]:
        """Return the rotor speed after the step and its mean, in rad/s.

        ``before`` and ``after`` are the reference speeds of the two parts. Taking their mean for
        the whole step instead would smooth what the motor does, and a fit would make up for that
        with time constants a percent too short.
        """
        middle, first = self.early.advance(speed, before)
        end, second = self.late.advance(middle, after)
        return end, self.share * first + (1.0 - self.share) * second


def _mean_decay(steps: Scalar) -> Scalar:
    """Return (1 - e^-x)/x, the mean of the decay over x time constants, smooth at zero."""
    small = steps < 1e-4
    safe = jnp.where(small, 1.0, steps)
    return jnp.where(small, 1.0 - 0.5 * steps, -jnp.expm1(-safe) / safe)


def reference_speed(motor: Motor, command: Scalar) -> Scalar:
    """Return the rotor speed in rad/s that a command in 0..1 asks for."""
    shifted = command + motor.input_offset
    speed = shifted * (motor.input_scaling + motor.quadratic * shifted) + motor.zero_position_armed
    return jnp.where(speed > motor.max_rotor_velocity, motor.max_rotor_velocity, speed)
