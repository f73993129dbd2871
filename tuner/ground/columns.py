"""A rig's recording: columns by name, in SI units by their names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tuner.core.errors import RecordingError
from tuner.ground.measurement import Array
from tuner.recordings.recording import ROWS, Clock, Request
from tuner.recordings.table import Table

MAX_BYTES = 200_000_000
MOST = 60_000
"""Samples beyond which a recording is thinned: steps of seconds need no more."""
FEWEST = 20
RPM = 2 * math.pi / 60
"""rad/s per revolution a minute."""
FASTEST = 4000.0
"""rad/s that no rotor of a multirotor turns: a column beyond it holds revolutions a minute."""
SLOWEST = 30.0
"""rad/s below which a rotor that is measured at all does not turn: such rpm are rad/s, or Hz."""
FULL_COMMAND = 1.5

#: Quantity -> column name -> factor to SI units.
COLUMNS: Mapping[str, Mapping[str, float]] = {
    "angle": {
        "angle": 1.0,
        "angle_rad": 1.0,
        "angle_deg": math.pi / 180,
        "angle_degrees": math.pi / 180,
    },
    "rotor_speed": {"rotor_speed": 1.0, "rpm": RPM},
    "force": {"force": 1.0},
    "command": {"command": 1.0},
    "voltage": {"voltage": 1.0},
    "qw": {"qw": 1.0},
    "qx": {"qx": 1.0},
    "qy": {"qy": 1.0},
    "qz": {"qz": 1.0},
}
TIMES = ("time", "t")


def open_table(path: Path) -> Table:
    """Open a CSV or Parquet file.

    Raises
    ------
    RecordingError
        It cannot be read, is too large, or is no table.
    """
    try:
        if path.is_dir() or path.stat().st_size > MAX_BYTES:
            raise RecordingError(path, "is a folder or larger than 200 MB", "cut it to the rig's")
        return Table(path)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no valid path"
        raise RecordingError(path, f"cannot be read ({reason})", "check the path") from None


def read_columns(
    path: Path, wanted: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, Array]:
    """Return quantity -> (n,) samples in SI units, NaN where a cell holds no number.

    Parameters
    ----------
    path
        A CSV or Parquet file.
    wanted, optional
        Quantities of `COLUMNS`; those that are optional may lack.

    Returns
    -------
    dict
        ``time`` in s from the first sample, and the quantities; no more than `MOST` samples.

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
    if not any(name in table.columns for name in TIMES):
        raise RecordingError(path, "has no column time", "add it, in s")
    clocks = tuple(Clock(field=name, unit="s") for name in TIMES)
    contents = table.read({ROWS: Request(tuple(chosen.values()), clocks)})
    rows = contents.samples[ROWS]
    if len(rows.receive) < FEWEST:
        what = f"holds {len(rows.receive)} samples with a time"
        raise RecordingError(path, what, "record the whole experiment")
    time = (rows.receive - rows.receive[0]) * 1e-9
    if (np.diff(time) <= 0).any():
        raise RecordingError(path, "has times that do not rise", "sort it, one row a sample")
    samples = {"time": time}
    for quantity, column in chosen.items():
        samples[quantity] = rows.fields[column] * COLUMNS[quantity][column]
        _check_unit(path, quantity, column, samples[quantity])
    stride = -(-len(time) // MOST)
    return {quantity: values[::stride] for quantity, values in samples.items()}


def _check_unit(path: Path, quantity: str, column: str, values: Array) -> None:
    known = np.abs(values[np.isfinite(values)])
    if len(known) < FEWEST:
        raise RecordingError(path, f"column {column} holds hardly a number", "check the file")
    top = float(np.quantile(known, 0.99))
    complaints = {
        "rotor_speed": (
            (top > FASTEST, f"reaches {top:.0f} rad/s, too fast for a rotor",
             "name the column rpm if it holds revolutions a minute"),
            (top < SLOWEST, f"stays below {top:.1f} rad/s, too slow for a rotor",
             "name the column rotor_speed if it holds rad/s"),
        ),
        "angle": (
            (top > math.pi, f"reaches {top:.1f} rad, more than half a turn",
             "name the column angle_deg if it holds degrees"),
        ),
        "command": (
            (top > FULL_COMMAND, f"reaches {top:.0f}, commands lie in 0..1",
             "scale it to 0..1 of full command"),
        ),
    }  # fmt: skip
    for wrong, what, remedy in complaints.get(quantity, ()):
        if wrong:
            raise RecordingError(path, f"column {column} {what}", remedy)
