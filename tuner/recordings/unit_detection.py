"""Convert recorded numbers to SI, ENU, FLU and (w, x, y, z), and infer units from physics.

Units that no topic map gives are inferred from gravity and from the range of the numbers. A certain
unit is used; an uncertain one is left as it is, or asked for where it matters. The unit of lengths
follows from gravity. Thrust and gravity alone accelerate a multirotor in hover and slow flight:

    a_xy = (g + a_z) t

where t is the horizontal direction of thrust with the tangent of its tilt as length. In a unit of
which k make a metre, a_xy and a_z are k times as large but g is not, so that a_xy - a_z t = k g t.
Drag, wind and noise of the tilt make k smaller, by a third in slow flights and more in some hovers;
nothing makes it larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array, finite_rows
from tuner.recordings.flight import SIGNALS, RawSeries
from tuner.recordings.interpolation import both_known, rotate, upward
from tuner.recordings.notes import Note, NoteCode


class Unit(NamedTuple):
    """A unit of recorded numbers: SI value = factor * recorded + offset.

    Attributes
    ----------
    phrase
        As sentences on an inferred unit name it; empty of one that is not inferred.
    spellings
        As names of columns and rows of units write it, in small letters between blanks.
    """

    factor: float
    offset: float = 0.0
    phrase: str = ""
    spellings: str = ""


UNITS: Mapping[str, Unit] = {
    "si": Unit(
        *(1.0, 0.0, "in SI units"),
        "m m/s m/s2 m/s^2 m/s² m/s/s rad rad/s rads radians v volt volts",
    ),
    "rpm": Unit(math.tau / 60, spellings="rpm 1/min"),
    "hz": Unit(math.tau, spellings="hz rps"),
    "deg": Unit(math.pi / 180, 0.0, "in degrees", "deg ° degrees"),
    "deg/s": Unit(math.pi / 180, 0.0, "in degrees per second", "deg/s °/s dps degs"),
    "g": Unit(9.80665, 0.0, "in g", "g gs"),
    "mg": Unit(9.80665e-3, 0.0, "in thousandths of g", "mg"),
    "mm": Unit(1e-3, 0.0, "in millimetres", "mm mm/s"),
    "cm": Unit(1e-2, 0.0, "in centimetres", "cm cm/s"),
    "ft": Unit(0.3048, 0.0, "in feet"),
    "mV": Unit(1e-3, 0.0, "in millivolts", "mv"),
    "percent": Unit(1e-2, 0.0, "in percent", "% percent"),
    "pwm_us": Unit(1e-3, -1.0, "in microseconds of PWM", "pwm"),
    "pwm_16bit": Unit(1 / 65535, 0.0, "of 16 bits"),
    "dshot": Unit(1 / 1999, -48 / 1999),
    "signed": Unit(0.5, 0.5, "from -1 to 1"),
}
"""Name in a topic map -> unit."""


def to_si(values: Array, unit: str) -> Array:
    """Convert recorded numbers of any shape to SI."""
    return UNITS[unit].factor * values + UNITS[unit].offset


def to_enu_flu(values: Array, signal: str) -> Array:
    """Turn (n, k) values of a signal from NED world and FRD body axes to ENU and FLU.

    A quaternion from FRD to NED becomes one from FLU to ENU: the world turns by
    (0, 1, 1, 0)/sqrt(2), the body by (0, 1, 0, 0).
    """
    axes = SIGNALS[signal].axes
    if axes == "world":
        north, east, down = values.T
        return np.column_stack([east, north, -down])
    if axes == "body":
        forward, right, down = values.T
        return np.column_stack([forward, -right, -down])
    if axes == "attitude":
        w, x, y, z = values.T
        return np.column_stack([w + z, x + y, x - y, w - z]) / math.sqrt(2)
    if signal == "thrust_setpoint":  # PX4's thrust points down
        return -values
    return values


def quaternion_of(angles: Array) -> Array:
    """Return (n, 4) quaternions of (n, 3) roll, pitch and yaw in rad, turned about z, y, then x."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(0.5 * angles.T), np.sin(0.5 * angles.T)
    return np.column_stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def turned_about_z(q: Array, angle: float) -> Array:
    """Return (n, 4) attitudes whose body axes are turned by an angle in rad about their z."""
    (w, x, y, z), c, s = q.T, math.cos(0.5 * angle), math.sin(0.5 * angle)
    return np.column_stack([c * w - s * z, c * x + s * y, c * y - s * x, c * z + s * w])


@dataclass(frozen=True)
class SignalReading:
    """Another frame, order or unit of recorded numbers: a row of the table of hypotheses.

    Attributes
    ----------
    name
        As a sentence names it.
    read
        (n, k) recorded values, and (n, 4) right attitudes at their times -> right values.
    """

    name: str
    read: Callable[[Array, Array], Array]


INVERSE = np.array([1.0, -1.0, -1.0, -1.0])
"""Turns a quaternion (w, x, y, z) into its inverse."""
_DEGREE = math.pi / 180
_SCALAR_LAST = [3, 0, 1, 2]
_TURN_READINGS = (
    SignalReading("in FRD axes", lambda w, _: to_enu_flu(w, "body_rate")),
    SignalReading("in degrees per second", lambda w, _: w * _DEGREE),
    SignalReading("in FRD axes and degrees", lambda w, _: to_enu_flu(w, "body_rate") * _DEGREE),
    SignalReading("in milliradians per second", lambda w, _: w * 1e-3),
    SignalReading("in milliradians, not degrees, per second", lambda w, _: w * 1e-3 / _DEGREE),
)
SCALAR_FIRST = SignalReading("scalar-first", lambda q, _: q[:, [1, 2, 3, 0]])
"""Without a yaw it leans as the right attitude does along x: a gyro alone tells it."""
IN_WORLD_AXES = SignalReading("in world axes", lambda w, q: rotate(q * INVERSE, w))
READINGS: Mapping[str, tuple[SignalReading, ...]] = {
    "attitude": (
        SignalReading("scalar-last", lambda q, _: q[:, _SCALAR_LAST]),
        SignalReading("world to body", lambda q, _: q * INVERSE),
        SignalReading("NED and FRD", lambda q, _: to_enu_flu(q, "attitude")),
        SignalReading(
            "scalar-last, NED and FRD", lambda q, _: to_enu_flu(q[:, _SCALAR_LAST], "attitude")
        ),
    ),
    "body_rate": (*_TURN_READINGS, IN_WORLD_AXES),
    "rate_setpoint": _TURN_READINGS,
    "velocity": (
        SignalReading("in body axes", lambda v, q: rotate(q, v)),
        SignalReading("in NED axes", lambda v, _: to_enu_flu(v, "velocity")),
        SignalReading(  # gravity alone does not tell these two apart
            "in kilometres per hour, not feet per second", lambda v, _: v / 3.6 / UNITS["ft"].factor
        ),
    ),
    "acceleration": (
        SignalReading("in FRD axes", lambda a, _: to_enu_flu(a, "acceleration")),
        SignalReading("with x and y swapped", lambda a, _: a[:, [1, 0, 2]]),
        SignalReading(
            "in axes turned left about z", lambda a, _: a[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
        ),
        SignalReading(
            "in axes turned right about z", lambda a, _: a[:, [1, 0, 2]] * [1.0, -1.0, 1.0]
        ),
    ),
}
"""Signal -> other ways in which it may be recorded than declared; the likelier first."""


LENGTH_SIGNALS = {"position": False, "velocity": True}
"""Signals that may be in another unit than metres -> whether they are speeds."""
LENGTH_UNITS = ("ft", "cm", "mm")
"""Units of length that are inferred."""

BIN_S = 0.1
"""Medians over bins remove noise, bursts of stamps and single corrupt samples."""
HALF_BINS = 3
"""An acceleration is a mean over so many bins to either side."""
MAX_FILLED_UP = 4
"""Places for a sample up to which bins are filled up to the fullest, which is sorted faster."""
MAX_DISTANCE_S = 300.0
"""Stamps farther from the median one are ignored as wrong."""
MIN_SLOW_STEP_S = 0.03
"""Times with a longer step may be a thousand times too long."""
MIN_TILT_COSINE = 0.3
"""Below this the vehicle lies on its side, and thrust carries little of the weight."""

MIN_TILT_RMS = 0.002
"""rad. A smaller tilt, root mean square, is noise."""
MIN_AGREEMENT = 0.8
"""The least share of the tilt that points along the acceleration,"""
SIGNIFICANCE = 3.0
"""which must exceed chance by so many standard deviations."""
SCALE_RANGE = (0.45, 1.6)
"""The range of a unit's apparent scale: drag and noise shrink it."""
MIN_OTHER_UNIT_SCALE = 2.0
"""No flight in metres has a larger apparent scale."""
MAX_SPEED_RATIO = 3.0
"""The largest ratio of recorded speed to the position's derivative in the same unit."""
GRAVITY_RANGE = (0.75, 1.4)
"""The range of the mean specific force over gravity, in flight or at rest."""
MAX_TURN_RATE = 40.0
"""rad/s. No vehicle turns faster for a tenth of its flight: gyros saturate at 35."""
MIN_SAMPLES = 20
"""Fewer samples do not show their unit."""


@dataclass(frozen=True)
class Scale:
    """The scale of recorded lengths by the recorded tilt.

    Attributes
    ----------
    per_metre
        Units per metre.
    agreement
        Share of the tilt, 0..1, that points along the acceleration.
    sure
        Whether the agreement is sufficient, and significant.
    """

    per_metre: float = 1.0
    agreement: float = 0.0
    sure: bool = False


def scales_of(recorded: Mapping[str, RawSeries]) -> dict[str, Scale]:
    """Return the scale of each signal of `LENGTH_SIGNALS` that a recording holds.

    Position and speed share the better known one if the speed is the position's derivative.

    Parameters
    ----------
    recorded
        Signal -> its samples as recorded: position and speed (n, 3), and attitude (m, 4)
        quaternions in any order and frame that `frames` knows.
    """
    if "attitude" not in recorded:
        return {}
    scales = {
        signal: scale_of(recorded[signal], recorded["attitude"], speeds=speeds)
        for signal, speeds in LENGTH_SIGNALS.items()
        if signal in recorded
    }
    if len(scales) > 1 and _share_a_unit(recorded["position"], recorded["velocity"]):
        return dict.fromkeys(scales, _best_known(scales.values()))
    return scales


def quicker(recorded: Mapping[str, RawSeries]) -> dict[str, RawSeries] | None:
    """Return signals with a thousandth of their times, if gravity shows that; None if it does not.

    The step of a table's times does not tell slow microseconds from quick milliseconds.
    """
    if not {"position", "attitude"} <= set(recorded):
        return None
    step = np.diff(np.sort(recorded["position"].time))
    if not len(step) or np.median(step) < MIN_SLOW_STEP_S:
        return None
    quick = {name: replace(samples, time=1e-3 * samples.time) for name, samples in recorded.items()}
    slowly, quickly = (
        fits_gravity(signals["position"], signals["attitude"]) for signals in (recorded, quick)
    )
    return quick if quickly and not slowly else None


def fits_gravity(
    position: RawSeries, attitude: RawSeries, units: Iterable[str] = ("si", *LENGTH_UNITS)
) -> bool:
    """Return whether positions in one of some units accelerate along the tilt."""
    scale, (low, high) = scale_of(position, attitude), SCALE_RANGE
    return scale.sure and any(low < scale.per_metre * UNITS[unit].factor < high for unit in units)


def unit_of(signal: str, topic: str, scale: Scale) -> tuple[str, Note | None]:
    """Return the unit of `UNITS` of recorded lengths, metres (``si``) if unsure, and a note."""
    if not scale.sure or scale.per_metre < MIN_OTHER_UNIT_SCALE:
        return "si", None
    low, high = SCALE_RANGE
    for unit in LENGTH_UNITS:
        if low < scale.per_metre * UNITS[unit].factor < high:
            return unit, NoteCode.UNIT_READ.note(signal, UNITS[unit].phrase, topic=topic)
    return "si", NoteCode.UNIT_DOUBTED.note(signal, topic=topic, times=scale.per_metre)


def units_of_references(
    recorded: Mapping[str, RawSeries], read: Mapping[str, tuple[str, Note | None]]
) -> dict[str, tuple[str, Note | None]]:
    """Return the unit of each reference that is in the unit of the position, as of `unit_of`.

    It is where the reference's size is nearer to that of the position as recorded than in metres.
    """
    unit, note = read.get("position", ("si", None))
    if note is None or unit == "si" or "reference_position" not in recorded:
        return {}
    names = ("position", "reference_position")
    flown, wanted = (math.sqrt(np.nanmean(np.square(recorded[name].values))) for name in names)
    if wanted < flown * math.sqrt(UNITS[unit].factor):
        return {}
    return {
        name: (unit, replace(note, names=(name, note.names[1])))
        for name in recorded
        if SIGNALS[name].axes == "world" and name not in LENGTH_SIGNALS
    }


def scale_of(lengths: RawSeries, attitude: RawSeries, *, speeds: bool = False) -> Scale:
    """Return the scale of recorded positions or speeds, for the best-fitting attitude reading.

    Parameters
    ----------
    speeds
        Whether the lengths are speeds.
    """
    lengths, attitude = _near_middle(lengths, attitude)
    if not len(lengths.time) or not len(attitude.time):
        return Scale()
    centres = _bin_centres(lengths, attitude)
    push = _accelerations(lengths, centres, speeds=speeds)
    readings = (
        attitude.values,
        *(r.read(attitude.values, attitude.values) for r in READINGS["attitude"]),
    )
    return _best_known(
        _slope_scale(*_force_and_tilt(push, RawSeries(attitude.time, values), centres))
        for values in readings
    )


def force_and_tilt(position: RawSeries, attitude: RawSeries) -> tuple[Array, Array]:
    """Return a_xy - a_z t and t, see above, at times a bin apart: (n, 2) each.

    Both are the same weighted mean over `HALF_BINS` bins to either side. Times without either, or
    with the vehicle on its side, are left out.
    """
    centres = _bin_centres(position, attitude)
    return _force_and_tilt(_accelerations(position, centres), attitude, centres)


def _accelerations(lengths: RawSeries, centres: Array, *, speeds: bool = False) -> Array:
    """Return accelerations, (n, 3), at all bins but `HALF_BINS` at either end."""
    if len(centres) <= 2 * HALF_BINS:
        return np.empty((0, 3))
    at = _binned(lengths, centres)
    if speeds:
        at = np.where(np.isfinite(at), np.nancumsum(at, axis=0) * BIN_S, np.nan)
    # a second difference is the mean of the second derivative by a triangle of weights
    second = at[2 * HALF_BINS :] - 2 * at[HALF_BINS:-HALF_BINS] + at[: -2 * HALF_BINS]
    return np.asarray(second / (HALF_BINS * BIN_S) ** 2)


def _force_and_tilt(push: Array, attitude: RawSeries, centres: Array) -> tuple[Array, Array]:
    """Return the result of `force_and_tilt` from accelerations."""
    if not len(push):
        return np.empty((0, 2)), np.empty((0, 2))
    norm = np.linalg.norm(attitude.values, axis=1, keepdims=True)
    turned = attitude.values / np.where(norm > 0.5, norm, np.nan)
    up = upward(turned)
    weights = np.convolve(np.ones(HALF_BINS), np.ones(HALF_BINS)) / HALF_BINS**2
    columns = _binned(RawSeries(attitude.time, up), centres).T
    leant = np.column_stack([np.convolve(c, weights, "valid")[1:-1] for c in columns])
    known = finite_rows(push) & (leant[:, 2] > MIN_TILT_COSINE)
    tilt = leant[known, :2] / leant[known, 2:]
    return push[known, :2] - push[known, 2:] * tilt, tilt


def _slope_scale(pull: Array, tilt: Array) -> Scale:
    """Return the slope of (n, 2) forces over tilts, by least absolute deviations."""
    if len(tilt) <= 2 * HALF_BINS:
        return Scale()
    # a constant tilt is wind, or markers defined on a slope
    pull, tilt = pull - np.median(pull, axis=0), tilt - np.median(tilt, axis=0)
    size = np.linalg.norm(tilt, axis=1)
    pull, tilt, size = pull[size > 0], tilt[size > 0], size[size > 0]
    if not len(size) or np.sqrt(np.mean(size**2)) < MIN_TILT_RMS:
        return Scale()
    slope = (pull * tilt).sum(axis=1) / size**2
    order = np.argsort(slope)
    middle = np.searchsorted(np.cumsum(size[order]), 0.5 * size.sum())
    agreement = float(size[slope > 0].sum() / size.sum())
    # the means overlap: one in HALF_BINS of them is independent
    chance = 0.5 * np.sqrt(HALF_BINS * (size**2).sum()) / size.sum()
    sure = bool(agreement > max(MIN_AGREEMENT, 0.5 + SIGNIFICANCE * chance))
    return Scale(float(slope[order][middle]) / GRAVITY, agreement, sure)


def _best_known(scales: Iterable[Scale]) -> Scale:
    return max(scales, key=lambda scale: (scale.sure, scale.agreement))


def _share_a_unit(position: RawSeries, speed: RawSeries) -> bool:
    """Return whether the position's derivative has about the size of a recorded speed."""
    position, speed = _near_middle(position, speed)
    if not len(position.time) or not len(speed.time):
        return False
    centres = _bin_centres(position, speed)
    if len(centres) < 2:
        return False
    moved = np.gradient(_binned(position, centres), BIN_S, axis=0)
    compared = both_known(moved, _binned(speed, centres))
    if not len(compared[0]):
        return False
    slower, faster = sorted(np.median(np.linalg.norm(values, axis=1)) for values in compared)
    return bool(faster < MAX_SPEED_RATIO * slower)


def _bin_centres(*signals: RawSeries) -> Array:
    """Return the centres, in s, of bins over all samples of some signals."""
    first = min(samples.time.min() for samples in signals)
    last = max(samples.time.max() for samples in signals)
    return np.asarray(first + BIN_S * (np.arange(int((last - first) / BIN_S) + 1) + 0.5))


def _near_middle(*signals: RawSeries) -> list[RawSeries]:
    """Return signals' samples near the median stamp of the last; stamps far off are wrong."""
    last = signals[-1].time
    middle = np.median(last) if len(last) else 0.0
    return [s.where(np.abs(s.time - middle) < MAX_DISTANCE_S) for s in signals]


def _binned(samples: RawSeries, centres: Array) -> Array:
    """Return (n, k) values at the centres (n,) of bins, interpolated between the bins' medians.

    NaN where no bin within `HALF_BINS` to either side holds a sample.
    """
    result, seen = np.full((len(centres), samples.values.shape[1]), np.nan), None
    for number, column in enumerate(result.T):
        time, value = samples.column(number)
        if seen is None or not np.array_equal(time, seen):  # columns are mostly known together
            seen, bins = time, ((time - centres[0]) / BIN_S + 0.5).astype(np.int64)
            held, medians_of = _medians_in(bins)
            when = medians_of(time)
        if len(held) < 2:
            continue
        column[:] = np.interp(centres, when, medians_of(value), np.nan, np.nan)
        # the nearest bins with samples, before and after each
        behind = np.clip(np.searchsorted(held, np.arange(len(centres))), 0, len(held) - 1)
        before = np.where(held[behind] > np.arange(len(centres)), np.maximum(behind - 1, 0), behind)
        column[held[behind] - held[before] > HALF_BINS] = np.nan
    return result


def _medians_in(bins: NDArray[np.int64]) -> tuple[NDArray[np.int64], Callable[[Array], Array]]:
    """Return the bins (b,) that hold samples, and what makes medians (b,) in these of values (m,).

    ``bins`` (m,) are the samples'. Of two numbers in the middle it is the larger one.
    """
    held, row, count = np.unique(bins, return_inverse=True, return_counts=True)
    first, largest = np.cumsum(count) - count, int(count.max(initial=0))
    order = np.argsort(row, kind="stable")
    row = row[order]
    place = np.arange(len(row)) - first[row]

    def medians_of(values: Array) -> Array:
        if largest * len(held) > MAX_FILLED_UP * len(row):
            return np.asarray(values[np.lexsort((values, bins))][first + count // 2])
        table = np.full((len(held), largest), np.inf)
        table[row, place] = values[order]
        return np.asarray(np.sort(table, axis=1)[np.arange(len(held)), count // 2])

    return held, medians_of


MAX_TILT_RAD, MIN_TILT_DEG = 0.55 * math.pi, 0.06
"""rad. No tilt is larger; no tilt in degrees stays below so many."""


def unit_by_range(signal: str, values: Array, assumed: str) -> str:
    """Return the unit of `UNITS` by the range of recorded numbers; the assumed one if unsure.

    It is empty for commands that cannot be pulses, as an ESC's digital steps.

    Parameters
    ----------
    signal
        Name in `SIGNALS`.
    values
        (n, k) as recorded; NaN where not measured.
    """
    rule = _RANGE_RULES.get(signal)
    known = values[finite_rows(values)] if signal != "command" else values
    if rule is None or len(known) < MIN_SAMPLES or not np.isfinite(known).any():
        return assumed
    found = rule(known)
    return found or ("" if assumed == "pwm_us" and _are_no_pulses(known) else assumed)


NO_COMMAND_RANGE = (1.02, 850.0)
"""Numbers in between are neither commands from 0 to 1 nor pulse widths in µs."""


def _are_no_pulses(values: Array) -> bool:
    low, high = NO_COMMAND_RANGE
    known = values[np.isfinite(values) & (values != 0)]
    return bool(np.mean((known > low) & (known < high)) > 0.01) if len(known) else False


def _command_unit(values: Array) -> str | None:
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


def _acceleration_unit(values: Array) -> str | None:
    """Return the unit in which the mean is gravity."""
    low, high = GRAVITY_RANGE
    size = float(np.linalg.norm(np.median(values, axis=0)))
    for unit, factor in (("si", 1.0), ("g", GRAVITY), ("mg", 1e-3 * GRAVITY)):
        if low < size * factor / GRAVITY < high:
            return unit
    return None


_RANGE_RULES: Mapping[str, Callable[[Array], str | None]] = {
    "command": _command_unit,
    "battery_voltage": lambda v: "mV" if 2000 < float(np.median(v)) < 100_000 else None,
    "acceleration": _acceleration_unit,
    "body_rate": lambda w: (
        "deg/s" if np.quantile(np.linalg.norm(w, axis=1), 0.9) > MAX_TURN_RATE else None
    ),
}


def unit_of_angles(
    path: object, attitude: RawSeries, position: RawSeries | None, *, required: bool
) -> str:
    """Return whether roll, pitch and yaw are in degrees (``deg``) or radians (``si``).

    Parameters
    ----------
    attitude
        (n, 3) as recorded.
    position
        As recorded, in any unit of length; None without one.
    required
        Whether an uncertain unit is an error; otherwise it is radians.

    Raises
    ------
    RecordingError
        The unit is uncertain, and `required`.
    """
    angles = np.abs(attitude.complete().values)
    if not len(angles):
        return "si"
    tilt = float(np.quantile(angles[:, :2], 0.99))
    if float(np.quantile(angles, 0.99)) > math.tau + 0.1 or tilt > MAX_TILT_RAD:
        return "deg"
    if tilt < MIN_TILT_DEG:
        return "si"
    if position is not None:
        attitudes = {
            unit: RawSeries(attitude.time, quaternion_of(to_si(attitude.values, unit)))
            for unit in ("si", "deg")
        }
        for lengths in (("si",), ("si", *LENGTH_UNITS)):  # metres first: a radian is 57 degrees
            fitting = [
                u for u, turned in attitudes.items() if fits_gravity(position, turned, lengths)
            ]
            if len(fitting) == 1:
                return fitting[0]
    if required:
        raise RecordingError(
            str(path),
            f"its angles reach {tilt:.2g}, and neither their size nor the motion tells degrees "
            "from radians",
            "give the attitude's unit (deg or si) in the topic map",
        )
    return "si"
