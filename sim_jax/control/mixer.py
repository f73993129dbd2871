"""PX4's quad-X mixer (1.12 to 1.13): torque and thrust to four commands, with desaturation.

PX4 shifts the outputs along thrust, roll, pitch and yaw in turn until what overshoots is balanced.
For a quad X the end of each such shift is known: the amount along the direction comes to lie within
the interval that saturates nothing or, where there is none, in the middle of the two limits.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from sim_jax.control.gains import MixerSettings
from sim_jax.control.rate import Saturation
from sim_jax.geometry import Vec3
from sim_jax.numeric import Flag, Scalar, any_lane, magnitude, maximum, minimum, safe_sqrt, saturate
from sim_jax.vehicle import PerRotor

ROTORS = 4
"""The rotors of a quad X."""
HALF_SQRT2 = 0.7071070075035095
"""PX4's own rounding in its generated mixer table: 0.707107 in single precision."""
YAW_HEADROOM = 1.149999976158142
"""Upper limit while yaw is mixed in, 1.15 in single precision: some yaw response is left at full
thrust."""
LOW_CLIP = 0.00499998
"""A command below this counts as clipped low. PX4 asks for output < -0.99 on its -1..1 scale in
single precision, where a command of exactly 0.005 comes out as -0.99 and does not count."""


def _balance(amount: Scalar, lower: Scalar, upper: Scalar) -> Scalar:
    """Bring an amount between its limits, or to their middle where they exclude each other."""
    middle = 0.5 * (lower + upper)
    return saturate(amount, minimum(lower, middle), maximum(upper, middle))


def _reduce(amount: Scalar, lower: Scalar, upper: Scalar) -> Scalar:
    """Do the same, but only downwards."""
    return minimum(amount, maximum(upper, 0.5 * (lower + upper)))


def _yaw_limits(
    thrust: Scalar, ahead: Scalar, across: Scalar, highest: float
) -> tuple[Scalar, Scalar]:
    """Return the least and most yaw that keep all rotors within 0..highest.

    Rotors that yaw drives up lie at thrust ± ahead, those that it drives down at thrust ± across.
    """
    lower = maximum(ahead - thrust, thrust + across - highest)
    return lower, -maximum(thrust + ahead - highest, across - thrust)


def _thrust_limits(yaw: Scalar, ahead: Scalar, across: Scalar) -> tuple[Scalar, Scalar]:
    """Return the least and most thrust that keep all rotors within 0..1."""
    return maximum(ahead - yaw, across + yaw), 1.0 - maximum(ahead + yaw, across - yaw)


def _sum(roll: Scalar, pitch: Scalar, yaw: Scalar, thrust: Scalar) -> PerRotor:
    up, down = thrust + yaw, thrust - yaw
    return up + (pitch - roll), up - (pitch - roll), down + (pitch + roll), down - (pitch + roll)


def _outputs(airmode: int, torque: Vec3, thrust: Scalar) -> PerRotor:
    roll, pitch, yaw = torque.x * HALF_SQRT2, torque.y * HALF_SQRT2, torque.z
    if airmode == 0:  # thrust may only be reduced; then roll, then pitch give way
        tilt = magnitude(roll) + magnitude(pitch)
        thrust = _reduce(thrust, tilt, 1.0 - tilt)
        margin = minimum(thrust, 1.0 - thrust)
        for_roll = maximum(margin - magnitude(pitch), jnp.zeros_like(margin))
        roll = saturate(roll, -for_roll, for_roll)
        for_pitch = maximum(margin - magnitude(roll), jnp.zeros_like(margin))
        pitch = saturate(pitch, -for_pitch, for_pitch)
    elif airmode == 1:  # thrust may rise to keep roll and pitch
        tilt = magnitude(roll) + magnitude(pitch)
        thrust = _balance(thrust, tilt, 1.0 - tilt)
    ahead, across = magnitude(pitch - roll), magnitude(pitch + roll)
    if airmode == 2:  # thrust may rise to keep all three, then yaw gives way
        thrust = _balance(thrust, *_thrust_limits(yaw, ahead, across))
        yaw = _balance(yaw, *_yaw_limits(thrust, ahead, across, 1.0))
    else:  # yaw gives way, then thrust
        yaw = _balance(yaw, *_yaw_limits(thrust, ahead, across, YAW_HEADROOM))
        thrust = _reduce(thrust, *_thrust_limits(yaw, ahead, across))
    return _sum(roll, pitch, yaw, thrust)


def as_float32(value: Scalar) -> Scalar:
    """Round to single precision, whatever precision the rollout runs in."""
    return jax.lax.reduce_precision(value, exponent_bits=8, mantissa_bits=23)


def quantise(command: Scalar) -> Scalar:
    """Truncate to whole microseconds of a 1000..2000 pulse; the derivative passes straight."""
    pulse = jnp.floor(as_float32(1500.0 + as_float32(500.0 * as_float32(2.0 * command - 1.0))))
    return command + jax.lax.stop_gradient((pulse - 1000.0) * 1e-3 - command)


def _linearised(output: Scalar, thrust_factor: float) -> Scalar:
    """Invert thrust = (1 - f)·u + f·u², PX4's model of the command's curve."""
    factor = jnp.asarray(thrust_factor, output.dtype)
    linear = 1.0 - factor
    square = (linear * linear) / (4.0 * factor * factor)
    positive = jnp.where(output < 0, 0.0, output)
    return safe_sqrt(square + positive / factor) - linear / (2.0 * factor)


def _excess(middle: Scalar, reach: Scalar) -> Flag:
    """Return whether outputs this far either side of a middle leave 0..1."""
    return (middle < reach) | (middle + reach > 1.0)


def _desaturate_lanes(
    airmode: int, torque: Vec3, thrust: Scalar, desaturates: Flag | bool, counts: Flag | bool
) -> PerRotor:
    """Mix; desaturation, which is most of the work, is left out while no vehicle saturates."""
    roll, pitch, yaw = torque.x * HALF_SQRT2, torque.y * HALF_SQRT2, torque.z
    ahead, across = jnp.abs(pitch - roll), jnp.abs(pitch + roll)
    without_yaw = _excess(thrust, maximum(ahead, across))
    saturates = without_yaw | _excess(thrust + yaw, ahead) | _excess(thrust - yaw, across)
    plain = _sum(roll, pitch, yaw, thrust)

    def desaturated() -> PerRotor:
        a, b, c, d = (
            jnp.where(desaturates, *outputs)
            for outputs in zip(_outputs(airmode, torque, thrust), plain, strict=True)
        )
        return a, b, c, d

    mixed: PerRotor = jax.lax.cond(
        any_lane(saturates & desaturates & counts), desaturated, lambda: plain
    )
    return mixed


def mix(
    settings: MixerSettings,
    torque: Vec3,
    thrust: Scalar,
    *,
    desaturates: Flag | bool = True,
    counts: Flag | bool = True,
) -> PerRotor:
    """Return four motor commands in 0..1.

    Parameters
    ----------
    settings
        Airmode, thrust factor, and whether commands move in PWM steps.
    torque
        Normalised torque set-point, FRD; each axis counts up to ±1.
    thrust
        Normalised collective thrust; counts from 0 to 1.
    desaturates
        Whether torque and thrust give way where a rotor would leave its range, as in PX4; else each
        rotor's command is clipped by itself.
    counts
        Whether anybody looks at a vehicle's commands; if not, they may lack desaturation.
    """
    within = Vec3(*(saturate(axis, -1.0, 1.0) for axis in (torque.x, torque.y, torque.z)))
    thrust = saturate(thrust, 0.0, 1.0)
    outputs = _desaturate_lanes(settings.airmode, within, thrust, desaturates, counts)
    if settings.thrust_factor > 0:
        a, b, c, d = (_linearised(out, settings.thrust_factor) for out in outputs)
        outputs = (a, b, c, d)
    a, b, c, d = (saturate(out, 0.0, 1.0) for out in outputs)
    if settings.pwm_quantisation:
        a, b, c, d = (quantise(out) for out in (a, b, c, d))
    return a, b, c, d


def torque_of(settings: MixerSettings, commands: PerRotor) -> Vec3:
    """Return the normalised torque set-point, FRD, with which four commands in 0..1 are mixed."""
    factor = settings.thrust_factor
    first, second, third, fourth = (
        command * (1.0 - factor + factor * command) for command in commands
    )
    ahead, across = first - second, third - fourth
    return Vec3(
        0.25 * (across - ahead) / HALF_SQRT2,
        0.25 * (across + ahead) / HALF_SQRT2,
        0.25 * (first + second - third - fourth),
    )


def saturation(settings: MixerSettings, commands: PerRotor) -> Saturation:
    """Return the directions of torque that rotors clipped low cannot give any more.

    A rotor clipped low stops roll and pitch in airmode 0 and yaw in airmodes 0 and 1; clipping
    high sets no flag with PX4's defaults.
    """
    front_right, rear_left, front_left, rear_right = (command < LOW_CLIP for command in commands)
    none = jnp.zeros_like(front_right)

    def only(flag: Flag, *airmodes: int) -> Flag:
        return flag if settings.airmode in airmodes else none

    left, right = rear_left | front_left, front_right | rear_right
    front, rear = front_right | front_left, rear_left | rear_right
    ccw, cw = front_right | rear_left, front_left | rear_right
    return Saturation(
        positive=(only(right, 0), only(rear, 0), only(cw, 0, 1)),
        negative=(only(left, 0), only(front, 0), only(ccw, 0, 1)),
    )
