"""PX4's mixer step by step, to the rounding: what `sim_jax.control.mixer` has in closed form.

Four outputs are shifted along one direction after the other until what overshoots on either side is
balanced. It gives the same commands as the closed form, but for the rounding of single precision,
on which the last microsecond of a PWM pulse can hang; it is several times slower.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp

from sim_jax.control.gains import MixerSettings
from sim_jax.control.mixer import HALF_SQRT2, YAW_HEADROOM
from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar, safe_sqrt, saturate
from sim_jax.vehicle import PerRotor

Scales: TypeAlias = tuple[float, float, float, float]
Rounding: TypeAlias = Callable[[Scalar], Scalar]

ROLL: Scales = (-HALF_SQRT2, HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
PITCH: Scales = (HALF_SQRT2, -HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
YAW: Scales = (1.0, 1.0, -1.0, -1.0)
THRUST: Scales = (1.0, 1.0, 1.0, 1.0)


def exact(value: Scalar) -> Scalar:
    """Do not round."""
    return value


def mix(rounded: Rounding, settings: MixerSettings, torque: Vec3, thrust: Scalar) -> PerRotor:
    """Return four motor commands in 0..1, not in PWM steps.

    Parameters
    ----------
    rounded
        What is done after every operation: `sim_jax.control.mixer.as_float32` or `exact`.
    settings
        Airmode and thrust factor.
    torque, thrust
        Normalised set-points, FRD.
    """
    within = Vec3(*(saturate(axis, -1.0, 1.0) for axis in (torque.x, torque.y, torque.z)))
    outputs = _desaturated(rounded, settings.airmode, within, saturate(thrust, 0.0, 1.0))
    if settings.thrust_factor > 0:
        outputs = tuple(_linearised(rounded, out, settings.thrust_factor) for out in outputs)
    return tuple(saturate(out, 0.0, 1.0) for out in outputs)


def _desaturated(rounded: Rounding, airmode: int, torque: Vec3, thrust: Scalar) -> PerRotor:
    """Return four outputs, which may still overshoot 0..1 where nothing can give way any more."""
    still = jnp.zeros_like(torque.x)
    tilting = _add(rounded, (still, still, still, still), torque.x, ROLL)
    tilting = _add(rounded, tilting, torque.y, PITCH)
    if airmode == 2:  # thrust may rise to keep all three, then yaw gives way
        outputs = _add(rounded, _add(rounded, tilting, torque.z, YAW), thrust, THRUST)
        return _unsaturate(rounded, _unsaturate(rounded, outputs, THRUST), YAW)
    outputs = _add(rounded, tilting, thrust, THRUST)
    if airmode == 1:  # thrust may rise to keep roll and pitch
        return _mix_yaw(rounded, _unsaturate(rounded, outputs, THRUST), torque.z)
    # thrust may only be reduced; then roll, then pitch give way
    outputs = _unsaturate(rounded, outputs, THRUST, reduce_only=True)
    outputs = _unsaturate(rounded, _unsaturate(rounded, outputs, ROLL), PITCH)
    return _mix_yaw(rounded, outputs, torque.z)


def _linearised(rounded: Rounding, output: Scalar, thrust_factor: float) -> Scalar:
    """Invert thrust = (1 - f)·u + f·u², PX4's model of the command's curve."""
    factor = jnp.asarray(thrust_factor, output.dtype)
    linear = rounded(1.0 - factor)
    square = rounded(rounded(linear * linear) / rounded(4.0 * factor * factor))
    positive = jnp.where(output < 0, 0.0, output)
    root = rounded(safe_sqrt(rounded(square + rounded(positive / factor))))
    return rounded(root - rounded(linear / (2.0 * factor)))


def _mix_yaw(rounded: Rounding, outputs: PerRotor, yaw: Scalar) -> PerRotor:
    outputs = _unsaturate(rounded, _add(rounded, outputs, yaw, YAW), YAW, YAW_HEADROOM)
    return _unsaturate(rounded, outputs, THRUST, reduce_only=True)


def _unsaturate(
    rounded: Rounding,
    outputs: PerRotor,
    scales: Scales,
    upper: float = 1.0,
    *,
    reduce_only: bool = False,
) -> PerRotor:
    """Shift the outputs along a direction until the saturation on both sides is balanced."""
    first = _gain_to_unsaturate(rounded, outputs, scales, upper)
    shifted = _add(rounded, outputs, first, scales)
    second = 0.5 * _gain_to_unsaturate(rounded, shifted, scales, upper)
    balanced = _add(rounded, shifted, second, scales)
    if not reduce_only:
        return balanced
    a, b, c, d = (
        jnp.where(first > 0, out, new) for out, new in zip(outputs, balanced, strict=True)
    )
    return a, b, c, d


def _gain_to_unsaturate(
    rounded: Rounding, outputs: PerRotor, scales: Scales, upper: float
) -> Scalar:
    least = most = jnp.zeros_like(outputs[0])
    for out, scale in zip(outputs, scales, strict=True):
        needed = rounded(rounded(saturate(out, 0.0, upper) - out) / scale)
        least = jnp.where(needed < least, needed, least)
        most = jnp.where(needed > most, needed, most)
    return rounded(least + most)


def _add(rounded: Rounding, outputs: PerRotor, amount: Scalar, scales: Scales) -> PerRotor:
    a, b, c, d = (
        rounded(out + rounded(amount * scale)) for out, scale in zip(outputs, scales, strict=True)
    )
    return a, b, c, d
