"""PX4's quad-X mixer (1.12 to 1.13): torque and thrust to four commands, with desaturation."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax
import jax.numpy as jnp

from sim_jax.control.gains import MixerSettings
from sim_jax.control.rate import Saturation
from sim_jax.numeric import Flag, Scalar, safe_sqrt, saturate
from sim_jax.vector import Vec3

#: One value per rotor, PX4 order: front right, rear left, front left, rear right.
PerRotor: TypeAlias = tuple[Scalar, Scalar, Scalar, Scalar]
_Scales: TypeAlias = tuple[float, float, float, float]
_Rounding: TypeAlias = Callable[[Scalar], Scalar]

HALF_SQRT2 = 0.7071070075035095
"""PX4's own rounding in its generated mixer table: 0.707107 in single precision."""
ROLL: _Scales = (-HALF_SQRT2, HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
PITCH: _Scales = (HALF_SQRT2, -HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
YAW: _Scales = (1.0, 1.0, -1.0, -1.0)
THRUST: _Scales = (1.0, 1.0, 1.0, 1.0)

YAW_HEADROOM = 1.149999976158142
"""Upper limit while yaw is mixed in, 1.15 in single precision: some yaw response is left at full
thrust."""
LOW_CLIP = 0.00499998
"""A command below this counts as clipped low. PX4 asks for output < -0.99 on its -1..1 scale in
single precision, where a command of exactly 0.005 comes out as -0.99 and does not count."""


def _single(value: Scalar) -> Scalar:
    """Round to single precision, whatever precision the rollout runs in."""
    return jax.lax.reduce_precision(value, exponent_bits=8, mantissa_bits=23)


def _exact(value: Scalar) -> Scalar:
    return value


def _add(rounded: _Rounding, outputs: PerRotor, amount: Scalar, scales: _Scales) -> PerRotor:
    a, b, c, d = (
        rounded(out + rounded(amount * scale)) for out, scale in zip(outputs, scales, strict=True)
    )
    return a, b, c, d


def _gain_to_unsaturate(
    rounded: _Rounding, outputs: PerRotor, scales: _Scales, upper: float
) -> Scalar:
    least = most = jnp.zeros_like(outputs[0])
    for out, scale in zip(outputs, scales, strict=True):
        needed = rounded(rounded(saturate(out, 0.0, upper) - out) / scale)
        least = jnp.where(needed < least, needed, least)
        most = jnp.where(needed > most, needed, most)
    return rounded(least + most)


def _unsaturate(
    rounded: _Rounding,
    outputs: PerRotor,
    scales: _Scales,
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


def _mix_yaw(rounded: _Rounding, outputs: PerRotor, yaw: Scalar) -> PerRotor:
    outputs = _unsaturate(rounded, _add(rounded, outputs, yaw, YAW), YAW, YAW_HEADROOM)
    return _unsaturate(rounded, outputs, THRUST, reduce_only=True)


def _desaturated(rounded: _Rounding, airmode: int, torque: Vec3, thrust: Scalar) -> PerRotor:
    roll, pitch, yaw = torque.x, torque.y, torque.z
    still = jnp.zeros_like(roll)
    tilting = _add(rounded, (still, still, still, still), roll, ROLL)
    tilting = _add(rounded, tilting, pitch, PITCH)
    if airmode == 2:  # thrust may rise to keep all three, then yaw gives way
        outputs = _add(rounded, _add(rounded, tilting, yaw, YAW), thrust, THRUST)
        return _unsaturate(rounded, _unsaturate(rounded, outputs, THRUST), YAW)
    outputs = _add(rounded, tilting, thrust, THRUST)
    if airmode == 1:  # thrust may rise to keep roll and pitch
        return _mix_yaw(rounded, _unsaturate(rounded, outputs, THRUST), yaw)
    # thrust may only be reduced; then roll, then pitch give way
    outputs = _unsaturate(rounded, outputs, THRUST, reduce_only=True)
    outputs = _unsaturate(rounded, _unsaturate(rounded, outputs, ROLL), PITCH)
    return _mix_yaw(rounded, outputs, yaw)


def _linearised(rounded: _Rounding, output: Scalar, thrust_factor: float) -> Scalar:
    """Invert thrust = (1 - f)·u + f·u², PX4's model of the command's curve."""
    factor = jnp.asarray(thrust_factor, output.dtype)
    linear = rounded(1.0 - factor)
    square = rounded(rounded(linear * linear) / rounded(4.0 * factor * factor))
    positive = jnp.where(output < 0, 0.0, output)
    root = rounded(safe_sqrt(rounded(square + rounded(positive / factor))))
    return rounded(root - rounded(linear / (2.0 * factor)))


def _quantised(command: Scalar) -> Scalar:
    """Truncate to whole microseconds of a 1000..2000 pulse; the derivative passes straight."""
    pulse = jnp.floor(_single(1500.0 + _single(500.0 * _single(2.0 * command - 1.0))))
    return command + jax.lax.stop_gradient((pulse - 1000.0) * 1e-3 - command)


def mix(settings: MixerSettings, torque: Vec3, thrust: Scalar) -> PerRotor:
    """Return four motor commands in 0..1.

    Parameters
    ----------
    settings
        Airmode, thrust factor, and whether commands move in PWM steps.
    torque
        Normalised torque set-point, FRD; each axis counts up to ±1.
    thrust
        Normalised collective thrust; counts from 0 to 1.
    """
    rounded = _single if settings.single_precision else _exact
    within = Vec3(*(saturate(axis, -1.0, 1.0) for axis in (torque.x, torque.y, torque.z)))
    outputs = _desaturated(rounded, settings.airmode, within, saturate(thrust, 0.0, 1.0))
    if settings.thrust_factor > 0:
        a, b, c, d = (_linearised(rounded, out, settings.thrust_factor) for out in outputs)
        outputs = (a, b, c, d)
    a, b, c, d = (saturate(out, 0.0, 1.0) for out in outputs)
    if settings.pwm_quantisation:
        a, b, c, d = (_quantised(out) for out in (a, b, c, d))
    return a, b, c, d


def saturation(settings: MixerSettings, commands: PerRotor) -> Saturation:
    """Return the directions of torque that rotors clipped low cannot give any more.

    A rotor clipped low stops roll and pitch in airmode 0 and yaw in airmodes 0 and 1; clipping
    high sets no flag with PX4's defaults.
    """
    low = [command < LOW_CLIP for command in commands]
    none = jnp.zeros_like(low[0])

    def any_low(scales: _Scales, sign: int, counts: bool) -> Flag:
        flag = none
        if counts:
            for clipped, scale in zip(low, scales, strict=True):
                flag = flag | clipped if scale * sign > 0 else flag
        return flag

    tilt, turn = settings.airmode == 0, settings.airmode in (0, 1)
    return Saturation(
        positive=(any_low(ROLL, -1, tilt), any_low(PITCH, -1, tilt), any_low(YAW, -1, turn)),
        negative=(any_low(ROLL, 1, tilt), any_low(PITCH, 1, tilt), any_low(YAW, 1, turn)),
    )
