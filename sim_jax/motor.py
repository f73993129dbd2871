"""Command to rotor speed: RPM curve, speed limit, first-order lag up and down (Eq. 4.2, 5.3).

A second lag may stand before the rotor's own: of the motor's current, or of a smoothed command.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp

from sim_jax.numeric import Flag, Scalar
from sim_jax.vehicle import Motor

MIN_TIME_CONSTANT_S = 1e-9
"""A shorter lag is none."""


class LagSlope(eqx.Module):
    """Time constants that depend on rotor speed: τ·(1 + slope·(Ω - Ω_hover)/Ω_hover).

    Source: thesis 5, where bench and flight disagree about the time constants.
    """

    slope: Scalar
    hover_speed: Scalar
    """rad/s."""

    def stretch(self, speed: Scalar) -> Scalar:
        """Return the factor on the time constants at a speed; a tenth at least."""
        return jnp.maximum(1.0 + self.slope * (speed / self.hover_speed - 1.0), 0.1)


class SecondLag(eqx.Module):
    """A lag of first order before the rotor's own, over the same step: both exact in series.

    The rotor speed's gap g and the lagged reference's gap e to a reference that holds follow
    e' = -e/τ₂ and τ·g' = e - g. Below zero τ₂ is a lead: the law goes on smoothly through zero,
    where it does nothing.
    """

    time_constant: Scalar
    """τ₂, s."""
    step: Scalar | float
    """s."""
    acts: Flag
    steps: Scalar
    """The step over τ₂ where it lags."""
    decay: Scalar
    """Which share of e a step leaves where it lags."""
    mean: Scalar
    """Its mean over the step."""

    @staticmethod
    def over(time_constant: Scalar, step: Scalar | float) -> SecondLag:
        """Prepare a step of ``step`` s; the time constant is τ₂ in s."""
        acts = time_constant > MIN_TIME_CONSTANT_S
        steps = step / jnp.where(acts, time_constant, 1.0)
        return SecondLag(time_constant, step, acts, steps, jnp.exp(-steps), _mean_decay(steps))

    def decays(self) -> tuple[Scalar, Scalar]:
        """Return which share of e a step leaves, and its mean over the step."""
        return jnp.where(self.acts, self.decay, 0.0), jnp.where(self.acts, self.mean, 0.0)

    def carried(
        self, time_constant: Scalar, own: Scalar, decay: Scalar, mean: Scalar
    ) -> tuple[Scalar, Scalar]:
        """Return which share of e is in g after a step, and its mean over the step.

        Parameters
        ----------
        time_constant, own, decay, mean
            τ in s, the step over it, the share of g that a step leaves, and its mean over the step.
        """
        slower = jnp.where(self.steps < own, self.decay, decay)
        both = slower * _mean_decay(jnp.abs(self.steps - own))
        after, during = own * both, self.mean - both
        lead = self.time_constant / (time_constant - jnp.minimum(self.time_constant, 0.0))
        return jnp.where(self.acts, after, lead * decay), jnp.where(self.acts, during, lead * mean)


class Lag(eqx.Module):
    """The exact first-order filter over one physics step, prepared once a rollout."""

    decay_up: Scalar
    decay_down: Scalar
    mean_up: Scalar
    mean_down: Scalar
    steps: tuple[Scalar, ...] = ()
    """The step over both time constants; for a slope alone."""
    slope: LagSlope | None = None
    second: SecondLag | None = None
    constants: tuple[Scalar, ...] = ()
    """Both time constants, s; for a slope and a second lag."""
    carried: tuple[tuple[Scalar, Scalar], ...] = ()
    """Contributions of the second lag with both, if these are constant."""

    @staticmethod
    def over(
        motor: Motor,
        step: Scalar | float,
        slope: LagSlope | None = None,
        second: Scalar | None = None,
    ) -> Lag:
        """Prepare the filter α = exp(-step/τ), and the mean of the decay over the step.

        Parameters
        ----------
        motor
            Gives both time constants in s.
        step
            Physics step in s, or a part of it, which may be zero.
        slope
            Where the time constants change with the speed.
        second
            s, of a second lag before the rotor's own.
        """
        constants = motor.time_constant_up, motor.time_constant_down
        up, down = (step / constant for constant in constants)
        decays, means = (jnp.exp(-up), jnp.exp(-down)), (_mean_decay(up), _mean_decay(down))
        lag = None if second is None else SecondLag.over(second, step)
        return Lag(
            *decays,
            *means,
            steps=() if slope is None else (up, down),
            slope=slope,
            second=lag,
            constants=() if lag is None or slope is None else constants,
            carried=()
            if lag is None or slope is not None
            else tuple(map(lag.carried, constants, (up, down), decays, means)),
        )

    def advance(
        self, speed: Scalar, reference: Scalar, lagged: Scalar | None = None
    ) -> tuple[Scalar, Scalar]:
        """Return the rotor speed after the step and its mean over the step, in rad/s.

        ``lagged``: the reference speed before the step as the second lag leaves it.
        """
        gap = speed - reference
        if self.second is None or lagged is None:
            decay, mean, _ = self._decays(speed, reference > speed)
            return reference + decay * gap, reference + mean * gap
        behind = lagged - reference
        rising = reference + self.second.decays()[1] * behind > speed
        decay, mean, (after, during) = self._decays(speed, rising)
        return reference + decay * gap + after * behind, reference + mean * gap + during * behind

    def lag_reference(self, lagged: Scalar, reference: Scalar) -> Scalar:
        """Return the reference speed after the step as the second lag leaves it, in rad/s."""
        assert self.second is not None
        return reference + self.second.decays()[0] * (lagged - reference)

    def _decays(self, speed: Scalar, rising: Flag) -> tuple[Scalar, Scalar, tuple[Scalar, ...]]:
        """Return which share of a gap the step leaves, its mean over the step, what is carried."""
        if self.slope is None:
            decay = jnp.where(rising, self.decay_up, self.decay_down)
            mean: Scalar = jnp.where(rising, self.mean_up, self.mean_down)
            both = zip(*self.carried, strict=True)
            return decay, mean, tuple(jnp.where(rising, up, down) for up, down in both)
        stretch, (up, down) = self.slope.stretch(speed), self.steps
        steps = jnp.where(rising, up, down) / stretch
        mean = _mean_decay(steps)
        decay = 1.0 - steps * mean
        if self.second is None:
            return decay, mean, ()
        up, down = self.constants
        constant = jnp.where(rising, up, down) * stretch
        return decay, mean, self.second.carried(constant, steps, decay, mean)


class SwitchedLag(eqx.Module):
    """The same filter over a step in which a delayed command changes part of the way through."""

    early: Lag
    late: Lag
    share: Scalar
    """Part of the step before the change, 0..1."""

    @staticmethod
    def over(
        motor: Motor,
        step: float,
        share: Scalar,
        slope: LagSlope | None = None,
        second: Scalar | None = None,
    ) -> SwitchedLag:
        """Prepare both parts of a step of ``step`` s."""
        return SwitchedLag(
            Lag.over(motor, step * share, slope, second),
            Lag.over(motor, step * (1.0 - share), slope, second),
            share,
        )

    def advance(
        self, speed: Scalar, before: Scalar, after: Scalar, lagged: Scalar | None = None
    ) -> tuple[Scalar, Scalar]:
        """Return the rotor speed after the step and its mean, in rad/s.

        ``before`` and ``after`` are the reference speeds of the two parts. Taking their mean for
        the whole step instead would smooth what the motor does, and a fit would make up for that
        with time constants a percent too short.
        """
        middle, first = self.early.advance(speed, before, lagged)
        then = None if lagged is None else self.early.lag_reference(lagged, before)
        end, second = self.late.advance(middle, after, then)
        return end, self.share * first + (1.0 - self.share) * second

    def lag_reference(self, lagged: Scalar, before: Scalar, after: Scalar) -> Scalar:
        """Return the reference speed after the step as the second lag leaves it, in rad/s."""
        return self.late.lag_reference(self.early.lag_reference(lagged, before), after)


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
