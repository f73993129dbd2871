"""PX4's quad-X mixer (1.12 to 1.13): torque and thrust to four commands, with desaturation."""

from __future__ import annotations

from typing import TypeAlias

import jax
import jax.numpy as jnp

from sim_jax.control.gains import MixerSettings
from sim_jax.control.rate import Saturation
from sim_jax.numeric import Scalar, safe_sqrt, saturate
from sim_jax.vector import Vec3

#: One value per rotor, PX4 order: front right, rear left, front left, rear right.
PerRotor: TypeAlias = tuple[Scalar, Scalar, Scalar, Scalar]
_Scales: TypeAlias = tuple[float, float, float, float]

HALF_SQRT2 = 0.707107
"""PX4's own rounding in its generated mixer table."""
ROLL: _Scales = (-HALF_SQRT2, HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
PITCH: _Scales = (HALF_SQRT2, -HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
YAW: _Scales = (1.0, 1.0, -1.0, -1.0)
THRUST: _Scales = (1.0, 1.0, 1.0, 1.0)

YAW_HEADROOM = 1.15
"""Upper limit while yaw is mixed in: some yaw response is left at full thrust."""
LOW_CLIP = 0.005
"""A command below this counts as clipped low (-0.99 on PX4's -1..1 scale)."""


def _add(outputs: PerRotor, amount: Scalar, scales: _Scales) -> PerRotor:
    a, b, c, d = (out + amount * scale for out, scale in zip(outputs, scales, strict=True))
    return a, b, c, d


def _gain_to_unsaturate(outputs: PerRotor, scales: _Scales, upper: float) -> Scalar:
    least = most = jnp.zeros_like(outputs[0])
    for out, scale in zip(outputs, scales, strict=True):
        needed = (saturate(out, 0.0, upper) - out) * (1.0 / scale)
        least = jnp.where(needed < least, needed, least)
        most = jnp.where(needed > most, needed, most)
    return least + most


def _unsaturate(
    outputs: PerRotor, scales: _Scales, upper: float = 1.0, *, reduce_only: bool = False
) -> PerRotor:
    """Shift the outputs along a direction until the saturation on both sides is balanced."""
    first = _gain_to_unsaturate(outputs, scales, upper)
    shifted = _add(outputs, first, scales)
    second = 0.5 * _gain_to_unsaturate(shifted, scales, upper)
    if not reduce_only:
        return _add(shifted, second, scales)
    return _add(outputs, jnp.where(first > 0, 0.0, first + second), scales)


def _mix_yaw(outputs: PerRotor, yaw: Scalar) -> PerRotor:
    outputs = _unsaturate(_add(outputs, yaw, YAW), YAW, YAW_HEADROOM)
    return _unsaturate(outputs, THRUST, reduce_only=True)


def _without_yaw(torque: Vec3, thrust: Scalar) -> PerRotor:
    outputs = (thrust, thrust, thrust, thrust)
    return _add(_add(outputs, torque.x, ROLL), torque.y, PITCH)


def _desaturated(airmode: int, torque: Vec3, thrust: Scalar) -> PerRotor:
    if airmode == 0:  # thrust may only be reduced; then roll, then pitch give way
        outputs = _unsaturate(_without_yaw(torque, thrust), THRUST, reduce_only=True)
        outputs = _unsaturate(_unsaturate(outputs, ROLL), PITCH)
        return _mix_yaw(outputs, torque.z)
    if airmode == 1:  # thrust may rise to keep roll and pitch
        return _mix_yaw(_unsaturate(_without_yaw(torque, thrust), THRUST), torque.z)
    outputs = _add(_without_yaw(torque, thrust), torque.z, YAW)
    return _unsaturate(_unsaturate(outputs, THRUST), YAW)


def _linearised(output: Scalar, thrust_factor: float) -> Scalar:
    """Invert thrust = (1 - f)·u + f·u², PX4's model of the command's curve."""
    ahead = (1.0 - thrust_factor) / (2.0 * thrust_factor)
    positive = jnp.where(output < 0, 0.0, output)
    return safe_sqrt(ahead * ahead + positive / thrust_factor) - ahead


def _quantised(command: Scalar) -> Scalar:
    """Truncate to whole microseconds of a 1000..2000 pulse; the derivative passes straight."""
    steps = jnp.floor(command * 1000.0 + 1e-4) * 1e-3
    return command + jax.lax.stop_gradient(steps - command)


def mix(settings: MixerSettings, torque: Vec3, thrust: Scalar) -> PerRotor:
    """Return four motor commands in 0..1.

    Parameters
    ----------
    settings
        Airmode, thrust factor and whether commands move in PWM steps.
    torque
        Normalised torque set-point, FRD.
    thrust
        Normalised collective thrust, 0..1.
    """
    outputs = _desaturated(settings.airmode, torque, thrust)
    if settings.thrust_factor > 0:
        a, b, c, d = (_linearised(out, settings.thrust_factor) for out in outputs)
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

    def any_low(scales: _Scales, sign: int, counts: bool) -> Scalar:
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
