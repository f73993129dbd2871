"""Command to rotor speed: RPM curve, speed limit, first-order lag up and down (Eq. 4.2, 5.3)."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from sim_jax.numeric import Scalar
from sim_jax.vehicle import Motor


class LagSlope(eqx.Module):
    """How the time constants change with the rotor speed: τ·(1 + slope·(Ω - Ω_hover)/Ω_hover).

    Source: thesis 5, where bench and flight disagree about the time constants.
    """

    slope: Scalar
    hover_speed: Scalar
    """rad/s."""

    def stretch(self, speed: Scalar) -> Scalar:
        """Return the factor on the time constants at a speed; a tenth at least."""
        return jnp.maximum(1.0 + self.slope * (speed / self.hover_speed - 1.0), 0.1)


class Lag(eqx.Module):
    """The exact first-order filter over one physics step, prepared once a rollout."""

    decay_up: Scalar
    decay_down: Scalar
    mean_up: Scalar
    mean_down: Scalar
    steps: tuple[Scalar, ...] = ()
    """The step over both time constants; for a slope alone."""
    slope: LagSlope | None = None

    @staticmethod
    def over(motor: Motor, step: Scalar | float, slope: LagSlope | None = None) -> Lag:
        """Prepare the filter α = exp(-step/τ), and the mean of the decay over the step.

        Parameters
        ----------
        motor
            Gives both time constants in s.
        step
            Physics step in s, or a part of it, which may be zero.
        slope
            Where the time constants change with the speed.
        """
        up, down = step / motor.time_constant_up, step / motor.time_constant_down
        return Lag(
            decay_up=jnp.exp(-up),
            decay_down=jnp.exp(-down),
            mean_up=_mean_decay(up),
            mean_down=_mean_decay(down),
            steps=() if slope is None else (up, down),
            slope=slope,
        )

    def advance(self, speed: Scalar, reference: Scalar) -> tuple[Scalar, Scalar]:
        """Return the rotor speed after the step and its mean over the step, in rad/s."""
        rising = reference > speed
        gap = speed - reference
        if self.slope is not None:
            up, down = self.steps
            steps = jnp.where(rising, up, down) / self.slope.stretch(speed)
            return reference + jnp.exp(-steps) * gap, reference + _mean_decay(steps) * gap
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
    def over(
        motor: Motor, step: float, share: Scalar, slope: LagSlope | None = None
    ) -> SwitchedLag:
        """Prepare both parts of a step of ``step`` s."""
        return SwitchedLag(
            Lag.over(motor, step * share, slope),
            Lag.over(motor, step * (1.0 - share), slope),
            share,
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


def command_of(motor: Motor, speed: Scalar) -> Scalar:
    """Return the command in 0..1 that asks for a rotor speed in rad/s below the largest."""
    wanted = speed - motor.zero_position_armed
    slope = motor.input_scaling
    # the smaller root, in the form that stays finite where the curve is a line
    root = jnp.sqrt(slope * slope + 4.0 * motor.quadratic * wanted)
    return 2.0 * wanted / (slope + root) - motor.input_offset
