"""Recordings for ground measurements: columns by name, steady parts, means, pendulum angles.

The names of columns give their units.
"""

from __future__ import annotations

import math
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from sim_jax.constants import RAD_S_PER_RPM
from tuner.core.disk import expanded
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array, robust_sd, student_factor
from tuner.ground.measurement import Curve
from tuner.recordings.content import Content, ReadOptions, read_content
from tuner.recordings.defects import is_held
from tuner.recordings.recording import TABLE_TOPIC, Clock, TabularRecording

OUTLIER_SIGMAS = 3.0
"""A tachometer's sample that is off by more robust standard deviations is dropped (6.3.2)."""
PLATEAU_SHARES = (0.3, 0.95)
"""The part of a step that is its plateau, after the transient and before the next step."""
MIN_TRUSTED_FREEDOM = 4
"""With as many degrees of freedom the residuals' scatter alone measures the error."""
MIN_PLATEAU_SAMPLES = 8
"""A shorter plateau has no mean."""


@dataclass(frozen=True)
class Plateau:
    """One steady part.

    Attributes
    ----------
    samples
        Indices of its samples.
    begin, end
        s.
    """

    samples: NDArray[np.intp]
    begin: float
    end: float


def find_plateaus(signal: Array, time: Array, *, shortest: float, step: float) -> list[Plateau]:
    """Return the steady parts of a signal that moves in steps.

    Parameters
    ----------
    signal
        (n,) a command or a rotor's speed, NaN where not measured.
    time
        (n,) s.
    shortest
        s; a shorter level is a transient.
    step
        Change of the level that counts as a step, in the signal's unit.
    """
    width = max(3, 2 * int(0.5 * shortest / max(float(np.median(np.diff(time))), 1e-9) / 2) + 1)
    filled = np.interp(np.arange(len(signal)), *_known(signal))
    smooth = median_filter(filled, size=width, mode="nearest")
    plateaus, first = [], 0
    level = smooth[0]
    for index in range(1, len(smooth) + 1):
        ended = index == len(smooth) or abs(smooth[index] - level) > step
        if not ended:
            count = index - first + 1
            level += (smooth[index] - level) / min(count, width)
            continue
        plateau = _plateau(time, first, index)
        if plateau is not None and time[index - 1] - time[first] >= shortest:
            plateaus.append(plateau)
        if index < len(smooth):
            first, level = index, smooth[index]
    return plateaus


def _known(signal: Array) -> tuple[Array, Array]:
    known = np.flatnonzero(np.isfinite(signal))
    return known.astype(float), signal[known]


def _plateau(time: Array, first: int, end: int) -> Plateau | None:
    begin, last = time[first], time[end - 1]
    low, high = (begin + share * (last - begin) for share in PLATEAU_SHARES)
    samples = first + np.flatnonzero((time[first:end] >= low) & (time[first:end] <= high))
    return (
        Plateau(samples, float(low), float(high)) if len(samples) >= MIN_PLATEAU_SAMPLES else None
    )


def resolution(values: Array) -> float:
    """Return the step of a sensor's values (n,), in their unit; 0 where all are one."""
    distinct = np.unique(values[np.isfinite(values)])
    steps = np.diff(distinct)
    steps = steps[steps > 1e-9 * np.abs(distinct).max(initial=0.0)]
    return float(steps.min()) if len(steps) else 0.0


def is_inlier(values: Array, step: float = 0.0) -> NDArray[np.bool_]:
    """Return (n,) flags of values within `OUTLIER_SIGMAS` robust deviations of their median.

    Neighbours in a sensor's resolution ``step`` are no outliers.
    """
    finite = np.isfinite(values)
    if not finite.any():
        return finite
    middle = np.median(values[finite])
    spread = max(float(robust_sd(values[finite] - middle)), 0.5 * step, 1e-12 * abs(middle))
    return np.asarray(finite & (np.abs(values - middle) <= OUTLIER_SIGMAS * spread))


def usable_plateaus(
    stepped: Array,
    time: Array,
    speed: Array,
    usable: NDArray[np.bool_],
    *,
    shortest: float,
    step: float,
) -> tuple[list[tuple[Plateau, NDArray[np.intp]]], NDArray[np.bool_], int]:
    """Return the plateaus of a stepped signal, each with its usable samples of the speed.

    Also (n,) flags of these samples, and the number of dropped ones; see `find_plateaus`.
    """
    parts, used, dropped, fine = [], np.zeros(len(time), bool), 0, resolution(speed)
    for plateau in find_plateaus(stepped, time, shortest=shortest, step=step):
        kept = is_inlier(speed[plateau.samples], fine) & usable[plateau.samples]
        dropped += int((~kept).sum())
        inside = plateau.samples[kept]
        if len(inside) >= 4:
            used[inside] = True
            parts.append((plateau, inside))
    return parts, used, dropped


def mean_and_error(values: Array, step: float) -> tuple[float, float]:
    """Return a plateau's mean and standard error, from means of blocks of correlated samples.

    A sensor's resolution ``step`` hides the mean where no noise moves the values across it (the
    bias of a mean of rounded values: Widrow and Kollár, "Quantization noise", 2008).
    """
    count = len(values)
    blocks = min(8, count // 4)
    error = float(values.std(ddof=1)) / np.sqrt(count)
    if blocks >= 4:
        means = np.array([block.mean() for block in np.array_split(values, blocks)])
        error = max(error, float(means.std(ddof=1)) / np.sqrt(blocks))
    if step:
        noise = max(float(values.var()) / step**2 - 1 / 12, 0.0)
        error = math.hypot(error, step / math.sqrt(12) * math.exp(-2 * math.pi**2 * noise))
    return float(values.mean()), error


def widen(covariance: Array, chi_square: float, freedom: int) -> Array:
    """Return a covariance with the scatter of the residuals: Birge's ratio and Student's t.

    Few small residuals do not narrow it.

    Parameters
    ----------
    covariance
        Of weighted least squares.
    chi_square, freedom
        Sum of the squared weighted residuals, and their degrees of freedom.
    """
    ratio = chi_square / max(freedom, 1)
    ratio = max(ratio, 1.0) if freedom < MIN_TRUSTED_FREEDOM else ratio
    return np.asarray(covariance * ratio * student_factor(freedom) ** 2)


MAX_BYTES = 200_000_000
MAX_SAMPLES = 60_000
"""A longer recording is thinned: steps of seconds need no more."""
MIN_SAMPLES = 20
MAX_ROTOR_SPEED = 4000.0
"""rad/s. No rotor turns faster: such a column is in revolutions a minute."""
MIN_TIP_SPEED = 40.0
"""m/s at the length of an arm. The fastest test of a propeller exceeds it: such rpm are rad/s."""
MAX_COMMAND = 1.5
VOLTAGE_RANGE = (1.0, 100.0)
"""V of a battery."""

ATTITUDE = ("qw", "qx", "qy", "qz")
COLUMNS: Mapping[str, Mapping[str, float]] = {
    "angle": {"angle": 1.0, "angle_rad": 1.0}
    | dict.fromkeys(("angle_deg", "angle_degrees"), math.pi / 180),
    "rotor_speed": {"rotor_speed": 1.0, "rpm": RAD_S_PER_RPM},
    **{name: {name: 1.0} for name in ("force", "command", "voltage", *ATTITUDE)},
}
"""Quantity -> column name -> factor to SI units."""
MEASURED = ("angle", "rotor_speed", "force")
"""Quantities of sensors that may be slower than the log: what repeats is not measured."""
MAX_SINGLE_SHARE = 0.2
"""A held signal changes less often from one sample to the next."""
TIME_COLUMNS = ("time", "t")
"""Columns that may hold the time, in s."""
MIN_STEADY_S = 3.0
"""A shorter steady part of a flight has no mean."""
STEADY_TOLERANCE = 0.05
"""Larger changes of the mean rotor speed, relative to its median, end a steady part."""
TABLES = (".csv", ".tsv", ".txt", ".parquet")
AXES = ("x", "y", "z")
MIN_VERTICAL_COSINE = 0.9
"""Between the hanging body axis and the vertical."""


def recording_path(folder: Path, recording: str | None) -> Path:
    """Return the path of a recording, or of a table, that ``bench.yaml`` names."""
    return folder / expanded(recording or "")


def open_table(path: Path) -> TabularRecording:
    """Open a CSV or Parquet file.

    Raises
    ------
    RecordingError
        It cannot be read, is too large, or is no table.
    """
    from tuner.recordings.table import TableRecording  # noqa: PLC0415 (pyarrow takes a third of a second)

    try:
        about = path.stat()
        if not stat.S_ISREG(about.st_mode) or about.st_size > MAX_BYTES:
            raise RecordingError(path, "is no file, or larger than 200 MB", "cut it to the rig's")
        return TableRecording(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no valid path"
        raise RecordingError(path, f"cannot be read ({reason})", "check the path") from None


def read_columns(
    path: Path, wanted: tuple[str, ...], optional: tuple[str, ...] = (), *, arm: float = math.inf
) -> dict[str, Array]:
    """Return quantity -> (n,) samples in SI units, NaN where a cell holds no number.

    Parameters
    ----------
    path
        A CSV or Parquet file.
    wanted, optional
        Quantities of `COLUMNS`; those that are optional may lack.
    arm
        m from the vehicle's centre to a rotor, which bounds its propeller.

    Returns
    -------
    dict
        ``time`` in s from the first sample, and the quantities; at most `MAX_SAMPLES`.

    Raises
    ------
    RecordingError
        The file cannot be read, a column is missing, times do not rise, or a unit is implausible.
    """
    table = open_table(path)
    chosen = {}
    for quantity in (*wanted, *optional):
        column = next((name for name in COLUMNS[quantity] if name in table.columns), None)
        if column is not None:
            chosen[quantity] = column
        elif quantity in wanted:
            names = " or ".join(COLUMNS[quantity])
            needed = ", ".join(("time", *wanted))
            raise RecordingError(path, f"has no column {names}", f"it needs {needed}")
    if not any(name in table.columns for name in TIME_COLUMNS):
        raise RecordingError(path, "has no column time", "add it, in s")
    clocks = tuple(Clock(field=name, unit="s") for name in TIME_COLUMNS)
    contents = table.read({TABLE_TOPIC: tuple(chosen.values())}, clocks)
    rows = contents.samples[TABLE_TOPIC]
    if len(rows.receive) < MIN_SAMPLES:
        what = f"holds {len(rows.receive)} samples with a time"
        raise RecordingError(path, what, "record the whole experiment")
    time = (rows.receive - rows.receive[0]) * 1e-9
    if (np.diff(time) <= 0).any():
        raise RecordingError(path, "has times that do not rise", "sort it, one row a sample")
    samples = {"time": time}
    for quantity, column in chosen.items():
        samples[quantity] = rows.fields[column] * COLUMNS[quantity][column]
        _check_unit(path, quantity, column, samples[quantity], arm)
        if quantity in MEASURED:
            samples[quantity] = np.where(
                _is_held(time, samples[quantity]), np.nan, samples[quantity]
            )
    stride = -(-len(time) // MAX_SAMPLES)
    return {quantity: values[::stride] for quantity, values in samples.items()}


def _is_held(time: Array, values: Array) -> NDArray[np.bool_]:
    """Return which samples (n,) repeat a slower sensor's last one; see `is_held`.

    A coarse sensor repeats itself, too, but changes as often from one sample to the next.
    """
    held = is_held(time, values[:, None])
    between = np.diff(np.flatnonzero(np.diff(values)))
    return np.asarray(held & (np.sum(between == 1) < MAX_SINGLE_SHARE * len(between)))


def _check_unit(path: Path, quantity: str, column: str, values: Array, arm: float) -> None:
    known = np.abs(values[np.isfinite(values)])
    if len(known) < MIN_SAMPLES:
        raise RecordingError(path, f"column {column} holds almost no numbers", "check the file")
    top, low = float(np.quantile(known, 0.99)), float(np.nanquantile(values, 0.01))
    complaints = {
        "rotor_speed": (
            (top > MAX_ROTOR_SPEED, f"reaches {top:.0f} rad/s, too fast for a rotor",
             "name the column rpm if it holds revolutions a minute"),
            (top * arm < MIN_TIP_SPEED,
             f"stays below {top:.1f} rad/s, too slow for a rotor on an arm of {arm:.3g} m",
             "name the column rotor_speed if it holds rad/s, and check the vehicle's rotors"),
        ),
        "angle": (
            (top > math.pi, f"reaches {top:.1f} rad, more than half a turn",
             "name the column angle_deg if it holds degrees"),
        ),
        "command": (
            (top > MAX_COMMAND, f"reaches {top:.0f}, commands lie in 0..1",
             "scale it to 0..1 of full command"),
        ),
        "voltage": (
            (not VOLTAGE_RANGE[0] <= low <= top <= VOLTAGE_RANGE[1],
             f"goes from {low:.3g} to {top:.3g} V",
             f"write a battery's volts, {VOLTAGE_RANGE[0]:g} to {VOLTAGE_RANGE[1]:g}"),
        ),
    }  # fmt: skip
    for wrong, what, remedy in complaints.get(quantity, ()):
        if wrong:
            raise RecordingError(path, f"column {column} {what}", remedy)


def read_swing(path: Path, axis: str) -> dict[str, Array]:
    """Return ``time`` s and ``angle`` rad about the vertical from a table or any recording.

    Parameters
    ----------
    axis
        The body axis that should hang vertical, for a recorded attitude.

    Raises
    ------
    RecordingError
        It cannot be read, holds neither angle nor attitude, or hangs by another axis.
    """
    if path.suffix.lower() not in TABLES:
        series = _content(path).series["attitude"]
        angle = angle_of_attitude(str(path), series.values, axis)
        return {"time": series.time - series.time[0], "angle": angle}
    if "qw" not in open_table(path).columns:
        return read_columns(path, ("angle",))
    samples = read_columns(path, ATTITUDE)
    quaternion = np.column_stack([samples.pop(part) for part in ATTITUDE])
    return samples | {"angle": angle_of_attitude(str(path), quaternion, axis)}


def steady_flight(path: Path) -> tuple[Array, float, Curve]:
    """Return the means over the longest steady part of a flight.

    Returns
    -------
    tuple
        Rotor speeds (4,) in rad/s, PX4's motor order; yaw rate in rad/s, NaN if not recorded; and
        the curve.

    Raises
    ------
    RecordingError
        It cannot be read, lacks rotor speeds, or is never steady.
    """
    series = _content(path).series
    if "rotor_speed" not in series:
        raise RecordingError(path, "has no rotor speeds", "give the point by its numbers")
    time, speeds = series["rotor_speed"].time, series["rotor_speed"].values
    measured = np.isfinite(speeds).any(axis=1)
    time, speeds = time[measured], speeds[measured]
    if len(time) < 20:
        raise RecordingError(path, "has almost no rotor speeds", "give the point by its numbers")
    mean = np.nanmean(speeds, axis=1)
    parts = find_plateaus(
        mean, time, shortest=MIN_STEADY_S, step=STEADY_TOLERANCE * float(np.median(mean))
    )
    turning = [part for part in parts if np.median(mean[part.samples]) > 0.5 * mean.max()]
    if not turning:
        what = f"is nowhere steady for {MIN_STEADY_S:g} s"
        raise RecordingError(path, what, "hold the hover or the spin longer")
    longest = max(turning, key=lambda part: part.end - part.begin)
    inside = longest.samples
    used = np.zeros(len(time), bool)
    used[inside] = True
    rotors = []
    for column in speeds[inside].T:
        if not np.isfinite(column).any():
            raise RecordingError(path, "lacks a rotor's speed", "give the point by its numbers")
        rotors.append(float(column[is_inlier(column, resolution(column))].mean()))
    yaw_rate = np.nan
    if "body_rate" in series:
        rates = series["body_rate"]
        within = (rates.time >= longest.begin) & (rates.time <= longest.end)
        yaw_rate = float(np.nanmean(rates.values[within, 2])) if within.any() else np.nan
    level = np.array([mean[inside].mean()])
    titles = (f"Steady part of {path.name}", "time, s", "mean rotor speed, rad/s")
    middle = np.array([0.5 * (longest.begin + longest.end)])
    curve = Curve.of(titles, (time, mean), (middle, level), used=used, law=False)
    return np.array(rotors), yaw_rate, curve


def _content(path: Path) -> Content:
    if not path.exists():
        raise RecordingError(path, "does not exist", "check the path")
    return read_content(ReadOptions.of(path))


def angle_of_attitude(path: str, quaternion: Array, axis: str) -> Array:
    """Return the angle (n,), rad, about the vertical of a body that hangs by one of its axes.

    Parameters
    ----------
    quaternion
        (n, 4) w, x, y, z: body to world, world z up; rows that are not finite give NaN.
    axis
        The body axis that should hang vertical.

    Raises
    ------
    RecordingError
        Another body axis, or none, hangs vertical.
    """
    known = np.linalg.norm(quaternion, axis=1) > 0.1
    turned = Rotation.from_quat(quaternion[known], scalar_first=True).as_matrix()
    mean = turned[:, 2].mean(axis=0) if known.any() else np.zeros(3)
    hanging = int(np.argmax(np.abs(mean)))
    if abs(mean[hanging]) < MIN_VERTICAL_COSINE:
        raise RecordingError(path, "hangs by no body axis", "hang it by the axis to be measured")
    if AXES[hanging] != axis:
        what = f"hangs by its body axis {AXES[hanging]}, and axis says {axis}"
        raise RecordingError(path, what, "correct the axis, or hang it by the other one")
    # the angle is the heading of a level body axis
    level = turned[:, :, (hanging + 1) % 3]
    angle = np.full(len(known), np.nan)
    angle[known] = np.unwrap(np.arctan2(level[:, 1], level[:, 0]))
    return np.asarray(angle - np.nanmean(angle))
