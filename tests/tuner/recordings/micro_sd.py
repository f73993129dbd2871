"""Micro-SD logs written as the Crazyflie's firmware writes them."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

Rows = Sequence[tuple[int, Sequence[float]]]
"""(time in the unit of the version, values) of each record."""


def write_micro_sd(
    path: Path,
    events: Mapping[str, tuple[Mapping[str, str], Rows]],
    *,
    version: int = 2,
    order: Sequence[str] | None = None,
) -> Path:
    """Write events: name -> (variable -> code of its type, records).

    ``order`` names the event of each record in the file; None writes one event after the other.
    """
    numbers = {name: 65_535 - place for place, name in enumerate(events)}
    out = [struct.pack("<BHH", 0xBC, version, len(events))]
    for name, (variables, _) in events.items():
        out.append(struct.pack("<H", numbers[name]) + name.encode() + b"\0")
        out.append(struct.pack("<H", len(variables)))
        out.extend(f"{variable}({code})".encode() + b"\0" for variable, code in variables.items())
    waiting = {name: iter(rows) for name, (_, rows) in events.items()}
    names = [name for name, (_, rows) in events.items() for _ in rows] if order is None else order
    for name in names:
        time, values = next(waiting[name])
        layout = "<H" + ("I" if version == 1 else "Q") + "".join(events[name][0].values())
        out.append(struct.pack(layout, numbers[name], time, *values))
    content = b"".join(out)
    path.write_bytes(content + struct.pack("<I", zlib.crc32(content)))
    return path


def log_of(time: np.ndarray, columns: Mapping[str, tuple[str, np.ndarray]], path: Path) -> Path:
    """Write one event, as the firmware's configurations have it: times in s, name -> code, values.

    Whole-number types are rounded.
    """
    kinds = {name: code for name, (code, _) in columns.items()}
    table = np.column_stack([values for _, values in columns.values()])
    whole = [code not in "efd" for code in kinds.values()]
    rows = [
        (round(1e6 * t), [round(v) if w else v for v, w in zip(row, whole, strict=True)])
        for t, row in zip(time.tolist(), table.tolist(), strict=True)
    ]
    return write_micro_sd(path, {"fixedFrequency": (kinds, rows)})
