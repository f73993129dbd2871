"""A rig's recording: columns by name, in SI units by their names."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from tuner.bench.measurement import Array
from tuner.errors import RecordingError

MAX_BYTES = 200_000_000
RPM = 2 * math.pi / 60
"""rad/s per revolution a minute."""
FASTEST = 4000.0
"""rad/s that no rotor of a multirotor turns: a column beyond it holds revolutions a minute."""
SLOWEST = 30.0
"""rad/s below which a rotor that is measured at all does not turn: such rpm are rad/s, or Hz."""

#: Quantity -> column name -> factor to SI units.
COLUMNS: Mapping[str, Mapping[str, float]] = {
    "time": {"time": 1.0, "t": 1.0},
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
}


def read_columns(
    path: Path, wanted: tuple[str, ...], optional: tuple[str, ...] = ()
) -> dict[str, Array]:
    """Return quantity -> (n,) samples in SI units, rows without a finite time left out.

    Raises
    ------
    RecordingError
        The file cannot be read, a column is missing, times do not rise, or a unit is implausible.
    """
    try:
        if path.stat().st_size > MAX_BYTES:
            raise RecordingError(path, "is larger than 200 MB", "cut it to the experiment")
        table = pd.read_csv(path, comment="#", skipinitialspace=True, encoding_errors="replace")
    except OSError as error:
        raise RecordingError(path, f"cannot be read ({error.strerror})", "check the path") from None
    except (ValueError, pd.errors.ParserError) as error:
        reason = " ".join(str(error).split())[:80]
        raise RecordingError(path, f"is no table of numbers ({reason})", "write CSV") from None
    table.columns = [str(name).strip().lower() for name in table.columns]
    samples = {}
    for quantity in (*wanted, *optional):
        column = next((name for name in COLUMNS[quantity] if name in table.columns), None)
        if column is None:
            if quantity in optional:
                continue
            names = " or ".join(COLUMNS[quantity])
            raise RecordingError(path, f"has no column {names}", f"it needs {', '.join(wanted)}")
        numbers = pd.to_numeric(table[column], errors="coerce").to_numpy(float)
        samples[quantity] = numbers * COLUMNS[quantity][column]
        _check_unit(path, quantity, column, samples[quantity])
    complete = np.isfinite(samples["time"])
    samples = {quantity: values[complete] for quantity, values in samples.items()}
    if len(samples["time"]) < 20:
        raise RecordingError(path, "holds fewer than 20 samples", "record the whole experiment")
    if (np.diff(samples["time"]) <= 0).any():
        raise RecordingError(path, "has times that do not rise", "sort it, one row a sample")
    return samples


def _check_unit(path: Path, quantity: str, column: str, values: Array) -> None:
    known = np.abs(values[np.isfinite(values)])
    if len(known) == 0:
        raise RecordingError(path, f"column {column} holds no number", "check the file")
    top = float(np.quantile(known, 0.99))
    if quantity == "rotor_speed" and top > FASTEST:
        remedy = "name the column rpm if it holds revolutions a minute"
        raise RecordingError(
            path, f"column {column} reaches {top:.0f} rad/s, too fast for a rotor", remedy
        )
    if quantity == "rotor_speed" and top < SLOWEST:
        remedy = "name the column rotor_speed if it holds rad/s"
        raise RecordingError(
            path, f"column {column} stays below {top:.1f} rad/s, too slow for a rotor", remedy
        )
    if quantity == "angle" and top > math.pi:
        remedy = "name the column angle_deg if it holds degrees"
        raise RecordingError(
            path, f"column {column} reaches {top:.1f} rad, more than half a turn", remedy
        )
    if quantity == "command" and top > 1.5:
        remedy = "scale it to 0..1 of full command"
        raise RecordingError(
            path, f"column {column} reaches {top:.0f}, commands lie in 0..1", remedy
        )
