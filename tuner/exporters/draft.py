"""A file on its way out: its text, what of the vehicle is in it, how it is read back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tuner.config import VehicleFile
from tuner.disk import make_folder, whole_file
from tuner.errors import ConfigError, ExportError
from tuner.files import read_bytes

MAX_BYTES = 10_000_000
#: Numbers are written with twelve digits; mass and inertia may go through sums of links.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Draft:
    """A file before it is written.

    Attributes
    ----------
    text
        All of it.
    vehicle
        The vehicle as whoever reads the file will fly it.
    notes
        What was done, and what the format has no place for.
    faults
        Given the file as it stands on the disk, what is wrong with the numbers in it.
    """

    text: str
    vehicle: VehicleFile
    notes: tuple[str, ...]
    faults: Callable[[Path], Sequence[str]]


def differences(wanted: Mapping[str, float], read: Mapping[str, float]) -> list[str]:
    """Return which of the wanted numbers, by name, a file does not hold, a sentence each."""
    return [
        f"{name} is {read[name]!r}, not {value!r}" if name in read else f"{name} is missing"
        for name, value in wanted.items()
        if name not in read or not math.isclose(read[name], value, rel_tol=TOLERANCE, abs_tol=1e-15)
    ]


def write(draft: Draft, path: Path) -> None:
    """Write a draft if it reads back as what it should hold; otherwise the file stays as it was.

    Raises
    ------
    ExportError
        It does not hold what it should.
    OutputError
        It cannot be written.
    """
    make_folder(path.parent)
    with whole_file(path) as unfinished:
        unfinished.write_text(draft.text, encoding="utf-8")
        wrong = draft.faults(unfinished)
        if wrong:
            raise ExportError(
                path, f"would not read back: {'; '.join(wrong)}", "report this; nothing was written"
            )


def read_file(path: Path) -> str:
    """Read a text file of a simulator.

    Raises
    ------
    ExportError
        It is missing, too large, or no text.
    """
    try:
        return read_bytes(path, most=MAX_BYTES, remedy="give a model file").decode("utf-8")
    except ConfigError as error:
        raise ExportError(path, error.what, error.remedy) from None
    except UnicodeDecodeError:
        raise ExportError(path, "is not UTF-8 text", "give a model file") from None
