"""Units that no topic map gives, told by the range of the numbers and by physics.

What is certain is read so; what is not stays as it is, and is asked for where it matters.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from tuner.core.errors import RecordingError
from tuner.core.numerics import GRAVITY
from tuner.recordings.flight import Array
from tuner.recordings.units import quaternion_of, to_si
from tuner.recordings.yardstick import NAMED, Stamped, fits_gravity

#: Units that are told, and how a sentence calls them.
NAMES = {
    "si": "in SI units",
    "deg": "in degrees",
    "deg/s": "in degrees per second",
    "g": "in g",
    "mg": "in thousandths of g",
    "mV": "in millivolts",
    "percent": "in percent",
    "pwm_us": "in microseconds of PWM",
    "pwm_16bit": "of 16 bits",
    "signed": "from -1 to 1",
}
#: How far a steady specific force, as recorded, is from gravity, of a vehicle that flies or stands.
FORCE = (0.75, 1.4)
#: rad that are more than a tilt, and less than a vehicle in the air has of them in degrees.
MOST_TILT, LEAST_TILT = 0.55 * math.pi, 0.06
#: rad/s that no vehicle turns at for a tenth of its flight: gyros end at 35.
FASTEST_TURN = 40.0
FEWEST = 20


def unit_by_range(signal: str, values: Array, assumed: str) -> str:
    """Return the unit of `UNITS` in which recorded numbers make sense; the assumed one if unsure.

    Parameters
    ----------
    signal
        Name in `SIGNALS`.
    values
        (n, k) as recorded; NaN where not measured.
    assumed
        What is usual.
    """
    rule = _RULES.get(signal)
    known = values[np.isfinite(values).all(axis=1)] if signal != "command" else values
    if rule is None or len(known) < FEWEST or not np.isfinite(known).any():
        return assumed
    return rule(known) or assumed


def _command(values: Array) -> str | None:
    known = values[np.isfinite(values)]
    low, middle, often, high = np.quantile(known, (0.002, 0.5, 0.9, 0.99))
    if low >= -1.02 and high <= 1.02:
        return "signed" if low < -0.03 else "si"
    pulses = (known == 0) | ((known > 880) & (known < 2200))
    if pulses.mean() > 0.99 and 1100 < often < 2200:
        return "pwm_us"
    if low >= 0 and middle > 3 and often > 20 and high <= 100.5:
        return "percent"
    if low >= 0 and often > 10_000 and high <= 65_536:
        return "pwm_16bit"
    return None


def _rates(values: Array) -> str | None:
    """Return degrees per second where no gyro measures so many radians."""
    often = float(np.quantile(np.linalg.norm(values, axis=1), 0.9))
    return "deg/s" if often > FASTEST_TURN else None


def _voltage(values: Array) -> str | None:
    return "mV" if 2000 < float(np.median(values)) < 100_000 else None


def _force(values: Array) -> str | None:
    """Return the unit in which the mean is gravity, which turns with the body but little."""
    low, high = FORCE
    size = float(np.linalg.norm(np.median(values, axis=0)))
    for unit, factor in (("si", 1.0), ("g", GRAVITY), ("mg", 1e-3 * GRAVITY)):
        if low < size * factor / GRAVITY < high:
            return unit
    return None


_RULES: Mapping[str, Callable[[Array], str | None]] = {
    "command": _command,
    "battery_voltage": _voltage,
    "acceleration": _force,
    "body_rate": _rates,
}


def unit_of_angles(path: object, attitude: Stamped, position: Stamped | None, *, must: bool) -> str:
    """Return whether roll, pitch and yaw are in degrees (``deg``) or radians (``si``).

    Parameters
    ----------
    path
        The recording, for errors.
    attitude
        (n, 3) as recorded.
    position
        As recorded, in any unit of length; None without one.
    must
        Whether it is an error that neither range nor gravity tells; else it is radians.

    Raises
    ------
    RecordingError
        It cannot be told.
    """
    angles = np.abs(attitude.values[np.isfinite(attitude.values).all(axis=1)])
    if not len(angles):
        return "si"
    tilt = float(np.quantile(angles[:, :2], 0.99))
    if float(np.quantile(angles, 0.99)) > math.tau + 0.1 or tilt > MOST_TILT:
        return "deg"
    if tilt < LEAST_TILT:
        return "si"
    if position is not None:
        attitudes = {
            unit: Stamped(attitude.time, quaternion_of(to_si(attitude.values, unit)))
            for unit in ("si", "deg")
        }
        for lengths in (("si",), ("si", *NAMED)):  # metres first: a radian is 57 degrees
            fitting = [
                u for u, turned in attitudes.items() if fits_gravity(position, turned, lengths)
            ]
            if len(fitting) == 1:
                return fitting[0]
    if must:
        raise RecordingError(
            str(path),
            f"its angles reach {tilt:.2g}, and neither their size nor the motion tells degrees "
            "from radians",
            "give the attitude's unit (deg or si) in the topic map",
        )
    return "si"
