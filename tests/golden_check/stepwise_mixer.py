"""PX4's mixer step by step, to the rounding: what `sim_jax.control.mixer` has in closed form.

Four outputs are shifted along one direction after the other until what overshoots on either side is
balanced. It gives the same commands as the closed form, but for the rounding of single precision,
on which the last microsecond of a PWM pulse can hang. It is NumPy's: nothing of it is compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from sim_jax.control.gains import MixerSettings
from sim_jax.control.mixer import HALF_SQRT2, YAW_HEADROOM

Outputs: TypeAlias = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
Scales: TypeAlias = tuple[float, float, float, float]
Rounding: TypeAlias = Callable[[np.ndarray], np.ndarray]

ROLL: Scales = (-HALF_SQRT2, HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
PITCH: Scales = (HALF_SQRT2, -HALF_SQRT2, HALF_SQRT2, -HALF_SQRT2)
YAW: Scales = (1.0, 1.0, -1.0, -1.0)
THRUST: Scales = (1.0, 1.0, 1.0, 1.0)


def exact(value: np.ndarray) -> np.ndarray:
    """Do not round."""
    return value


def single(value: np.ndarray) -> np.ndarray:
    """Round to single precision."""
    return np.asarray(value, np.float32).astype(float)


def mix(
    rounded: Rounding, settings: MixerSettings, torque: np.ndarray, thrust: np.ndarray
) -> Outputs:
    """Return four motor commands in 0..1, not in PWM steps.

    Parameters
    ----------
    rounded
        What is done after every operation: `single` or `exact`.
    settings
        Airmode and thrust factor.
    torque, thrust
        Normalised set-points, FRD; (3, n) and (n,).
    """
    within, thrust = np.clip(torque, -1.0, 1.0), np.clip(thrust, 0.0, 1.0)
    a, b, c, d = _desaturated(rounded, settings.airmode, within, thrust)
    if settings.thrust_factor > 0:
        a, b, c, d = (_linearised(rounded, out, settings.thrust_factor) for out in (a, b, c, d))
    a, b, c, d = (np.clip(out, 0.0, 1.0) for out in (a, b, c, d))
    return a, b, c, d


def _desaturated(
    rounded: Rounding, airmode: int, torque: np.ndarray, thrust: np.ndarray
) -> Outputs:
    """Return four outputs, which may still overshoot 0..1 where nothing can give way any more."""
    roll, pitch, yaw = torque
    still = np.zeros_like(roll)
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


def _linearised(rounded: Rounding, output: np.ndarray, thrust_factor: float) -> np.ndarray:
    """Invert thrust = (1 - f)·u + f·u², PX4's model of the command's curve."""
    factor = np.asarray(thrust_factor)
    linear = rounded(1.0 - factor)
    square = rounded(rounded(linear * linear) / rounded(4.0 * factor * factor))
    positive = np.maximum(output, 0.0)
    root = rounded(np.sqrt(rounded(square + rounded(positive / factor))))
    return rounded(root - rounded(linear / (2.0 * factor)))


def _mix_yaw(rounded: Rounding, outputs: Outputs, yaw: np.ndarray) -> Outputs:
    outputs = _unsaturate(rounded, _add(rounded, outputs, yaw, YAW), YAW, YAW_HEADROOM)
    return _unsaturate(rounded, outputs, THRUST, reduce_only=True)


def _unsaturate(
    rounded: Rounding,
    outputs: Outputs,
    scales: Scales,
    upper: float = 1.0,
    *,
    reduce_only: bool = False,
) -> Outputs:
    """Shift the outputs along a direction until the saturation on both sides is balanced."""
    first = _gain_to_unsaturate(rounded, outputs, scales, upper)
    shifted = _add(rounded, outputs, first, scales)
    second = 0.5 * _gain_to_unsaturate(rounded, shifted, scales, upper)
    balanced = _add(rounded, shifted, second, scales)
    if not reduce_only:
        return balanced
    a, b, c, d = (np.where(first > 0, out, new) for out, new in zip(outputs, balanced, strict=True))
    return a, b, c, d


def _gain_to_unsaturate(
    rounded: Rounding, outputs: Outputs, scales: Scales, upper: float
) -> np.ndarray:
    least = most = np.zeros_like(outputs[0])
    for out, scale in zip(outputs, scales, strict=True):
        needed = rounded(rounded(np.clip(out, 0.0, upper) - out) / scale)
        least, most = np.minimum(needed, least), np.maximum(needed, most)
    return rounded(least + most)


def _add(rounded: Rounding, outputs: Outputs, amount: np.ndarray, scales: Scales) -> Outputs:
    a, b, c, d = (
        rounded(out + rounded(amount * scale)) for out, scale in zip(outputs, scales, strict=True)
    )
    return a, b, c, d
