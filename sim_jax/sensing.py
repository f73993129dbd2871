"""Sensing of the controllers: a delayed state estimate, a filtered gyro.

And what tachometers read of the rotors, which nothing acts upon.
"""

from __future__ import annotations

from math import ceil, pi, sqrt

import equinox as eqx
import jax.numpy as jnp
from jax import lax
from jaxtyping import Float, Int

from sim_jax.control.gains import Filters
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import MIN_TIME_CONSTANT_S
from sim_jax.numeric import Array, Scalar
from sim_jax.rigid_body import Motion


def history_length(longest: float, step: float) -> int:
    """Return the number of steps in a delay line of ``longest`` seconds."""
    return ceil(longest / step - 1e-9) + 2


def push(
    history: Float[Array, "length rows *batch"],
    values: Float[Array, "rows *batch"],
    step: Int[Array, ""],
) -> Float[Array, "length rows *batch"]:
    """Write the newest values of a delay line at physics step number ``step``."""
    written: Array = lax.dynamic_update_index_in_dim(history, values, _place(step, history), 0)
    return written


def _place(step: Int[Array, "*steps"], history: Array) -> Int[Array, "*steps"]:
    """Return which slot belongs to a step; steps must not be negative, which spares checks."""
    return lax.rem(step, jnp.full_like(step, history.shape[0]))


def _slot(
    history: Float[Array, "length rows *batch"], step: Int[Array, ""], back: Scalar
) -> Float[Array, "rows *batch"]:
    """Read the values written ``back`` whole steps ago; no further back than there are slots.

    What all vehicles share is one slot; if each has its own, all slots are gone through.
    """
    length = history.shape[0]
    back = jnp.clip(lax.stop_gradient(back), 0, length - 1)
    if jnp.ndim(back) == 0:
        index = _place(step + length - back.astype(step.dtype), history)
        shared: Array = lax.dynamic_index_in_dim(history, index, 0, keepdims=False)
        return shared
    ages = _place(step + length - jnp.arange(length), history)
    ages = ages.reshape((length,) + (1,) * jnp.ndim(back))
    return jnp.sum(jnp.where(ages == back, 1.0, 0.0)[:, None] * history, axis=0)


def look_back(
    history: Float[Array, "length rows *batch"], step: Int[Array, ""], age: Scalar
) -> Float[Array, "rows *batch"]:
    """Read a delay line ``age`` steps back, fractions interpolated linearly.

    At whole steps the derivative is that of greater ages.
    """
    whole = jnp.floor(lax.stop_gradient(age))
    newer, older = _slot(history, step, whole), _slot(history, step, whole + 1.0)
    return newer + (age - whole) * (older - newer)


def read_between(
    history: Float[Array, "length rows *batch"], step: Int[Array, ""], age: Scalar
) -> tuple[Float[Array, "rows *batch"], Float[Array, "rows *batch"]]:
    """Read a delay line of held values ``age`` steps back, over the step that begins now.

    Returns the value at the start of the step, and the one that replaces it when a fraction
    age - ⌊age⌋ of the step has passed.
    """
    whole = jnp.floor(lax.stop_gradient(age))
    return _slot(history, step, whole + 1.0), _slot(history, step, whole)


def pack_motion(motion: Motion) -> Float[Array, "10 *batch"]:
    """Return position, velocity and attitude, which an estimator delivers, as rows."""
    return jnp.concatenate(
        [motion.position.stacked(), motion.velocity.stacked(), motion.attitude.stacked()]
    )


def unpack_motion(rows: Float[Array, "10 *batch"]) -> tuple[Vec3, Vec3, Quaternion]:
    """Return position, velocity and attitude from rows; the attitude is normalised again."""
    return Vec3.of(rows[0:3]), Vec3.of(rows[3:6]), Quaternion.of(rows[6:10]).normalized()


def constant_history(motion: Motion, length: int, step: float) -> Float[Array, "length 10 *batch"]:
    """Fill a delay line as if the vehicle had arrived with constant velocity and attitude.

    Slot 0 is the present; ``step`` is the physics step in s.
    """
    ages = (-jnp.arange(length) % length) * step
    ages = ages.astype(motion.position.x.dtype).reshape((length,) + (1,) * motion.position.x.ndim)
    now = jnp.broadcast_to(pack_motion(motion), (length, *pack_motion(motion).shape))
    moved = now[:, 0:3] - now[:, 3:6] * ages[:, None]
    return jnp.concatenate([moved, now[:, 3:]], axis=1)


MAX_CUTOFF = 0.495
"""Highest cut-off of the gyro's filter, as a share of the rate at which it runs."""


class GyroFilter(eqx.Module):
    """PX4's low-passes on the gyro, prepared once a rollout; None leaves one out."""

    b0: Scalar | None
    a1: Scalar | None
    a2: Scalar | None
    derivative_share: Scalar | None

    @staticmethod
    def at(filters: Filters, rate: float) -> GyroFilter:
        """Prepare PX4's LowPassFilter2p (Butterworth) and AlphaFilter at a sample rate in Hz.

        The cut-off is kept below half of that rate, which a search may try to pass.
        """
        b0 = a1 = a2 = derivative_share = None
        if filters.gyro_cutoff is not None:
            share = jnp.minimum(filters.gyro_cutoff / rate, MAX_CUTOFF)
            ohm = jnp.tan(pi * share)
            norm = 1.0 + sqrt(2.0) * ohm + ohm * ohm
            b0 = ohm * ohm / norm
            a1 = 2.0 * (ohm * ohm - 1.0) / norm
            a2 = (1.0 - sqrt(2.0) * ohm + ohm * ohm) / norm
        if filters.dgyro_cutoff is not None:
            constant = 1.0 / (2.0 * pi * filters.dgyro_cutoff)
            derivative_share = (1.0 / rate) / (constant + 1.0 / rate)
        return GyroFilter(b0, a1, a2, derivative_share)


class GyroMemory(eqx.Module):
    """State of the gyro's filters; what a left-out filter would need is None."""

    newer: Vec3 | None
    older: Vec3 | None
    rate: Vec3
    """rad/s, filtered rate of the last sample."""
    acceleration: Vec3
    """rad/s², filtered derivative of the last sample."""

    @staticmethod
    def settled(gyro: GyroFilter, rate: Vec3) -> GyroMemory:
        """Return the state after a long time at a constant rate."""
        settled = None if gyro.b0 is None else rate * (1.0 / (4.0 * gyro.b0))
        return GyroMemory(settled, settled, rate, Vec3.zeros(rate.x))


def filter_gyro(gyro: GyroFilter, memory: GyroMemory, rate: Vec3, sample_rate: float) -> GyroMemory:
    """Take one gyro sample in rad/s through the filters."""
    newer, older, smooth = memory.newer, memory.older, rate
    if gyro.b0 is not None and newer is not None and older is not None:
        assert gyro.a1 is not None
        assert gyro.a2 is not None
        fresh = rate - newer * gyro.a1 - older * gyro.a2
        smooth = (fresh + newer * 2.0 + older) * gyro.b0
        newer, older = fresh, newer
    acceleration = (smooth - memory.rate) * sample_rate
    if gyro.derivative_share is not None:
        acceleration = (
            memory.acceleration + (acceleration - memory.acceleration) * gyro.derivative_share
        )
    return GyroMemory(newer, older, smooth, acceleration)


class Tachometer(eqx.Module):
    """A filter of first order on the recorded rotor speeds, exact for speeds that are linear.

    ``(1 + (τ - lag) s) / (1 + τ s)``, its memory ``τ / lag``: 1 of a low-pass, more of one that is
    computed sample by sample, which passes a part of each change at once, 1/2 of a dead time.
    Below zero its lag is a lead: the law goes on smoothly through zero, where it does nothing.
    """

    lag: Scalar
    """s."""
    kept: Scalar
    """Share of a difference that a step leaves."""
    step: float = eqx.field(static=True)
    """s."""

    @staticmethod
    def over(lag: Scalar, step: float, memory: Scalar | float = 1.0) -> Tachometer:
        """Prepare the filter for steps of so many s."""
        acts = lag > MIN_TIME_CONSTANT_S
        kept = jnp.where(acts, jnp.exp(-step / (memory * jnp.where(acts, lag, 1.0))), 0.0)
        return Tachometer(lag, kept, step)

    def reading(self, read: Scalar, before: Scalar, after: Scalar) -> Scalar:
        """Return the reading after a step from the last one, and the speeds before and after."""
        behind = self.lag * (after - before) / self.step
        return after - behind + self.kept * (read - before + behind)
