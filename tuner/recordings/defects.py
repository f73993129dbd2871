"""Defects of a signal: order, duplicates, NaN, quaternions, outliers, stale ends; all are counted.

After a crash a controller may stop and a logger go on writing its variables; motion capture without
markers may repeat its last pose for good. At the end of such a recording a signal repeats itself to
the bit although position or gyro show motion. A vehicle at rest repeats itself too, and is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array
from tuner.recordings.flight import SIGNALS, Series
from tuner.recordings.interpolation import rms, runs, upward
from tuner.recordings.notes import Kind, Note, NoteCode

MAX_BEYOND_SHARE = 0.5
"""With more samples out of range a signal is in another unit rather than corrupt."""

MAX_EQUAL_STAMP_SHARE = 0.5
"""With more stamps shared by different samples the stamps are too coarse for a flight."""

MAX_RECORDING_S = 43_200.0
"""No recording lasts longer to either side of its middle."""
OUTLIER_THRESHOLD = 6.0
"""An outlier sticks out by so many times more than samples nearby."""
MAX_EXCURSION_S = 1.0
"""A pose that jumped away for longer does not come back."""
MIN_STALE_S = 1.0
"""A stale end lasts at least so long,"""
MIN_MOTION_M = 0.05
"""while the vehicle moves by so much,"""
MIN_TURN_RATE = 0.2
"""or its gyro shows so much, root mean square in rad/s."""
MIN_TILT_RAD = 0.05
"""A vehicle with a larger tilt, root mean square, must move."""
MIN_HELD_SHARE = 0.4
"""A signal whose rows repeat the one before in so large a share was measured less often,"""
MIN_HELD_CHANGES = 20
"""if it has so many changes,"""
MIN_HELD_REGULAR = 0.8
"""and so large a share of them are about equally far apart."""
MEASURED_SIGNALS = (
    "position", "velocity", "attitude", "body_rate", "acceleration", "rotor_speed",
)  # fmt: skip
"""Signals that change from one measurement to the next; a command may stay."""
MOTION_SIGNALS = ("attitude", "body_rate")
"""Signals that change whenever a vehicle moves."""


def clean(
    signal: str, topic: str, time: Array, values: Array
) -> tuple[Array, Array, tuple[Note, ...]]:
    """Return the trustworthy samples of a signal in strictly increasing time.

    Parameters
    ----------
    signal
        Name in `SIGNALS`; decides which tests apply.
    time
        (n,) seconds, any order.
    values
        (n, k).

    Returns
    -------
    tuple
        Time (m,), values (m, k) with m <= n, and what was dropped or repaired.
    """
    notes = []

    def note(count: int, code: NoteCode, kind: Kind = "info", **numbers: float) -> None:
        if count:
            notes.append(code.note(signal, kind=kind, topic=topic, count=int(count), **numbers))

    low, high = SIGNALS[signal].range
    if signal == "command":
        values = _disarmed_as_zero(values, low)
    beyond: NDArray[np.bool_] = np.asarray((values < low) | (values > high), dtype=np.bool_)
    dropped = int(beyond.any(axis=1).sum())
    if dropped > MAX_BEYOND_SHARE * int((values != 0).any(axis=1).sum()):  # 0 is 0 in each unit
        median = float(np.nanmedian(values))
        note(dropped, NoteCode.UNIT_UNKNOWN, "warning", lower=low, upper=high, median=median)
        beyond |= True  # the few samples in range are not the signal
    else:
        note(dropped, NoteCode.OUT_OF_RANGE, lower=low, upper=high)
    values = np.where(beyond, np.nan, values)
    if signal in {"command", "thrust_setpoint"}:
        values = np.clip(values, 0.0, 1.0)

    one_per_row = signal == "rotor_speed"
    empty = np.isnan(values).all(axis=1) if one_per_row else np.isnan(values).any(axis=1)
    empty |= ~np.isfinite(time)
    counted = np.asarray(beyond.any(axis=1))
    note(int((empty & ~counted).sum()), NoteCode.NOT_A_NUMBER)
    usable = np.logical_not(empty)
    time, values = time[usable], values[usable]

    late = int((np.diff(time) < 0).sum())
    note(late, NoteCode.OUT_OF_ORDER)
    order = np.argsort(time, kind="stable")
    time, values = time[order], values[order]
    apart = (
        np.abs(time - np.median(time)) > MAX_RECORDING_S
        if len(time)
        else np.zeros(0, dtype=np.bool_)
    )
    note(int(apart.sum()), NoteCode.FAR_IN_TIME)
    time, values = time[~apart], values[~apart]
    time, values, doubles, unlike = _merge_equal_times(time, values)
    if signal != "rotor_speed" and unlike > MAX_EQUAL_STAMP_SHARE * len(time):
        step = float(np.median(np.diff(time)))
        note(doubles, NoteCode.STAMPS_COARSE, "warning", seconds=step)
    else:
        note(doubles, NoteCode.STAMPED_TWICE)
    note(0 if signal == "lap" else _count_missing(time), NoteCode.SAMPLES_MISSING)

    if signal == "attitude":
        time, values, odd = _unit_quaternions(time, values)
        note(odd, NoteCode.NO_UNIT_QUATERNION)

    if signal in MEASURED_SIGNALS:
        held = is_held(time, values)
        rate = 1.0 / float(np.median(np.diff(time[~held]))) if held.any() else 0.0
        note(int(held.sum()), NoteCode.HELD, rate=rate)
        time, values = time[~held], values[~held]
    if signal in LIMITS:
        time, values = _without_outliers(signal, time, values, note)
    return time, values, tuple(notes)


def _disarmed_as_zero(values: Array, low: float) -> Array:
    """Return commands (n, k) in which pulses of disarmed motors, below any command, are zero.

    Autopilots send them to all motors alike; one alone is corrupt.
    """
    disarmed = ((values < low) & (values >= -1.0)).all(axis=1, keepdims=True)
    return np.where(disarmed, 0.0, values)


def _without_outliers(
    signal: str, time: Array, values: Array, note: Callable[..., None]
) -> tuple[Array, Array]:
    """Drop repeated poses, excursions and outliers, and note them."""
    limits = LIMITS[signal]
    if signal in ("position", "attitude"):
        stuck = is_repeated(time, values, limits)
        note(int(stuck.sum()), NoteCode.REPEATED)
        away, lasting = find_excursions(time[~stuck], values[~stuck], limits)
        note(int(away.sum()), NoteCode.AWAY_AND_BACK)
        note(lasting, NoteCode.AWAY_FOR_GOOD, "warning")
        time, values = time[~stuck][~away], values[~stuck][~away]
    outlier = np.zeros(values.shape, dtype=np.bool_)
    for column in range(values.shape[1]):
        measured = np.flatnonzero(np.isfinite(values[:, column]))
        outlier[measured, column] = is_outlier(time[measured], values[measured, column], limits)
    note(int(outlier.any(axis=1).sum()), NoteCode.OUTLIERS)
    if signal == "rotor_speed":
        values = np.where(outlier, np.nan, values)
        keep = np.isfinite(values).any(axis=1)
    else:
        keep = np.asarray(~outlier.any(axis=1))
    return time[keep], values[keep]


def _count_missing(time: Array) -> int:
    """Return the number of samples that a steady publisher lost; 0 if the rate is not steady."""
    if len(time) < 20:
        return 0
    steps = np.diff(time)
    usual = np.median(steps)
    near = np.abs(steps - usual) < 0.5 * usual
    if near.mean() < 0.75:
        return 0
    return int(np.sum(np.rint(steps[~near] / usual) - 1, where=steps[~near] > usual))


def _merge_equal_times(time: Array, values: Array) -> tuple[Array, Array, int, int]:
    """Keep one row of each time; fill its missing columns from the others.

    Returns
    -------
    tuple
        The times, the rows, the number of rows left out, and of times with different rows.
    """
    if len(time) < 2 or np.all(np.diff(time) > 0):
        return time, values, 0, 0
    kept, start, first_of = np.unique(time, return_index=True, return_inverse=True)
    merged = values[start]
    both = np.isfinite(values) & np.isfinite(merged[first_of])
    other = ((values != merged[first_of]) & both).any(axis=1)
    unlike = len(np.unique(first_of[other]))
    filled = 0
    for row, (first, last) in enumerate(zip(start, [*start[1:], len(time)], strict=True)):
        for twin in range(first + 1, last):
            lacking = np.isnan(merged[row]) & np.isfinite(values[twin])
            merged[row, lacking] = values[twin, lacking]
            filled += bool(lacking.any())
    return kept, merged, len(time) - len(kept) - filled, unlike


def _unit_quaternions(time: Array, values: Array) -> tuple[Array, Array, int]:
    """Normalise, drop those near zero, and let the sign follow the sample before."""
    norm = np.linalg.norm(values, axis=1)
    usable = norm > 0.5
    odd = int((np.abs(norm - 1) > 0.01).sum())
    time, unit = time[usable], values[usable] / norm[usable, None]
    if len(unit) > 1:
        flips = np.where((unit[1:] * unit[:-1]).sum(axis=1) < 0, -1.0, 1.0)
        unit = unit * np.concatenate([[1.0], np.cumprod(flips)])[:, None]
    if len(unit) and unit[0, 0] < 0:
        unit = -unit
    return time, unit, odd


@dataclass(frozen=True)
class NoiseLimits:
    """Bounds of noise and motion between neighbouring samples.

    Attributes
    ----------
    floor
        In the signal's unit.
    share
        The floor is at least this share of the column's median: small rotors turn, and change,
        several times faster than large ones.
    curvature
        The largest second derivative of true motion, unit/s^2.
    jump
        The smallest leap between samples that no true motion makes.
    """

    floor: float
    share: float = 0.0
    curvature: float = 0.0
    jump: float = np.inf

    def floor_of(self, values: Array) -> float:
        """Return the floor for (n,) values of one column."""
        level = float(np.median(np.abs(values))) if self.share and len(values) else 0.0
        return max(self.floor, self.share * level)


LIMITS: Mapping[str, NoiseLimits] = {
    "position": NoiseLimits(floor=0.02, curvature=30.0, jump=0.08),
    "attitude": NoiseLimits(floor=0.03, curvature=100.0, jump=0.15),
    "rotor_speed": NoiseLimits(floor=30.0, share=0.05),
}
"""Signals with an outlier test. A quadcopter reaches 3 g; its quaternion bends by half the angular
acceleration; a rotor that turns at some 600 rad/s needs tens of ms for 30 up and back."""


def is_outlier(time: Array, values: Array, limits: NoiseLimits) -> NDArray[np.bool_]:
    """Return which samples of a signal stick out on one side of their surroundings.

    A sample is compared with the medians of the three samples before and the three after it. Ramps
    and steps lie between the two and are kept; one or two samples that leave and come back are not.
    The bound adapts to the signal's roughness.

    Parameters
    ----------
    time
        (n,) s, strictly increasing.
    values
        (n,) one column.
    """
    if len(values) < 7:
        return np.zeros(len(values), dtype=bool)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(values, 3, mode="reflect", reflect_type="odd"), 7
    )
    before = _median_of_three(*windows[:, :3].T)
    after = _median_of_three(*windows[:, 4:].T)
    low, high = np.minimum(before, after), np.maximum(before, after)
    excess = np.maximum(np.maximum(low - values, values - high), 0.0)
    rough = np.lib.stride_tricks.sliding_window_view(np.pad(excess, 12, mode="symmetric"), 25)
    apart = np.pad((time[4:] - time[:-4]) / 4, 2, mode="edge")
    bound = limits.floor_of(values) + 2 * limits.curvature * apart**2
    usual = np.sort(rough, axis=1)[:, 20]  # the fifth largest of 25
    return np.asarray(excess > np.maximum(bound, OUTLIER_THRESHOLD * usual), dtype=np.bool_)


def _median_of_three(a: Array, b: Array, c: Array) -> Array:
    """Return the median of three, element by element."""
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))


def is_held(time: Array, values: Array) -> NDArray[np.bool_]:
    """Return which samples of (n, k) values fill a table of a higher rate than the signal's.

    Joined tables repeat a slower signal until its next sample. Read as measured, it would be late
    by half its period, and leap. Repeats that last longer than two periods are a vehicle at rest.
    """
    if len(values) < 2 * MIN_HELD_CHANGES:
        return np.zeros(len(values), dtype=np.bool_)
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    fresh = np.flatnonzero(~same)
    if same.mean() < MIN_HELD_SHARE or len(fresh) < MIN_HELD_CHANGES:
        return np.zeros(len(values), dtype=np.bool_)
    between, step = np.diff(time[fresh]), float(np.median(np.diff(time)))
    period = float(np.median(between))
    if period < 1.5 * step or np.mean(np.abs(between - period) < 1.1 * step) < MIN_HELD_REGULAR:
        return np.zeros(len(values), dtype=np.bool_)
    since = time - time[np.maximum.accumulate(np.where(same, 0, np.arange(len(time))))]
    return np.asarray(same & (since < 2.0 * period), dtype=np.bool_)


def is_repeated(time: Array, values: Array, limits: NoiseLimits) -> NDArray[np.bool_]:
    """Return which samples of (n, k) values repeat the one before although the vehicle moved.

    Motion capture that loses its markers goes on sending the last pose. A vehicle at rest in a
    simulator repeats itself too, but does not leap when it starts to move.
    """
    stuck = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 4:
        return stuck
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    for first, behind in runs(same):
        if behind - first < 3 or behind >= len(values):
            continue
        leap = np.abs(values[behind] - values[behind - 1]).max()
        usual = limits.floor / 4 + limits.curvature * (time[behind] - time[behind - 1]) ** 2
        stuck[first:behind] = leap > usual
    return stuck


def find_excursions(
    time: Array, values: Array, limits: NoiseLimits
) -> tuple[NDArray[np.bool_], int]:
    """Return which samples of (n, k) values lie between a leap away and the leap back.

    Returns
    -------
    tuple
        (n,) flags, and the number of leaps that did not come back within `MAX_EXCURSION_S`.
    """
    away = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 12:
        return away, 0
    span = np.diff(time)
    speed = np.diff(values, axis=0) / span[:, None]
    if np.abs(np.diff(speed, axis=0) * span[1:, None]).max() < limits.jump / 4:
        return away, 0  # nothing leaps at all, and running medians take their time
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(speed, ((5, 5), (0, 0)), mode="edge"), 11, axis=0
    )
    leap = np.diff(values, axis=0) - np.median(windows, axis=2) * span[:, None]
    size = np.sqrt((leap**2).sum(axis=1))
    at = np.flatnonzero(size > limits.jump + limits.curvature * span**2)
    lasting = 0
    i = 0
    while i < len(at):
        back = next(
            (
                j
                for j in range(i + 1, min(len(at), i + 40))
                if time[at[j]] - time[at[i]] < MAX_EXCURSION_S
                and np.linalg.norm(leap[at[i]] + leap[at[j]]) < 0.3 * size[at[i]] + limits.floor
            ),
            None,
        )
        if back is None:
            lasting += 1
            i += 1
        else:
            away[at[i] + 1 : at[back] + 1] = True
            i = back + 1
    return away, lasting


def without_stale_end(series: Mapping[str, Series]) -> tuple[dict[str, Series], list[Note]]:
    """Return the signals without a stale end, and notes."""
    kept, notes = dict(series), []
    for name in MOTION_SIGNALS:
        if name not in series:
            continue
        time, values = series[name].time, series[name].values
        changes = np.flatnonzero((values[1:] != values[:-1]).any(axis=1))
        last = int(changes[-1]) + 1 if len(changes) else 0
        if time[-1] - time[last] < MIN_STALE_S or not _is_moving(series, name, time[last]):
            continue
        if last:
            kept[name] = Series(time[: last + 1], values[: last + 1])
        elif name == "body_rate":  # nothing was ever measured; an attitude is doubted elsewhere
            del kept[name]
        else:
            continue
        seconds = float(time[-1] - time[last])
        notes.append(NoteCode.STALE.note(name, count=len(time) - last - 1, seconds=seconds))
    return kept, notes


def is_position_frozen(series: Mapping[str, Series]) -> bool:
    """Return whether the position never changes along x and y though the vehicle tilts.

    An estimator without a position sensor repeats its first position.
    """
    if not {"position", "attitude"} <= set(series):
        return False
    still = np.ptp(series["position"].values[:, :2], axis=0).max() == 0.0
    return bool(still and rms(upward(series["attitude"].values)[:, :2]) > MIN_TILT_RAD)


def _is_moving(series: Mapping[str, Series], stuck: str, since: float) -> bool:
    """Return whether position or, if it is not the stuck signal, the gyro shows motion."""
    places = series["position"].between(since, np.inf).complete().values
    if len(places) and np.ptp(places, axis=0).max() >= MIN_MOTION_M:
        return True
    if stuck == "body_rate" or "body_rate" not in series:
        return False
    rates = series["body_rate"].between(since, np.inf).complete().values
    return len(rates) > 0 and bool(np.sqrt(np.mean(rates**2)) >= MIN_TURN_RATE)


def has_stale_attitude(series: Mapping[str, Series], notes: Sequence[Note]) -> bool:
    """Return whether the recorded attitude has a stale end."""
    last = series["attitude"].values[-2:]
    noted = any(n.code is NoteCode.STALE and "attitude" in n.names for n in notes)
    return noted and bool((last[-1] == last[0]).all())
