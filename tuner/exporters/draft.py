"""A file on its way out: its text, what of the vehicle is in it, how it is read back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tuner.core.disk import make_folder, whole_file
from tuner.core.errors import ConfigError, ExportError
from tuner.core.files import read_bytes
from tuner.vehicle import VehicleFile

MAX_BYTES = 10_000_000
#: Numbers are written with twelve digits; mass and inertia may go through sums of links.
TOLERANCE = 1e-9


@dataclass(frozen=True)
class Gate:
    """One condition: what it is, and what stands against it (nothing if it is met).

    One that could not be looked at has not ``ran``.
    """

    name: str
    objections: tuple[str, ...]
    ran: bool = True

    @property
    def passed(self) -> bool:
        """Whether it was looked at and nothing stands against it."""
        return self.ran and not self.objections


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
        Given the file as it stands on the disk, and others that stand in for theirs, what is wrong
        with the numbers in it.
    gates
        Conditions of the format's own.
    others
        Further files -> their text, where a model is split over several.
    flier
        Flies it in its own simulator, as of `tuner.exporters.flier.flier`; None where that is
        not installed.
    """

    text: str
    vehicle: VehicleFile
    notes: tuple[str, ...]
    faults: Callable[..., Sequence[str]]
    gates: tuple[Gate, ...] = ()
    others: Mapping[Path, str] = field(default_factory=dict)
    flier: Callable[..., Any] | None = None


def differences(wanted: Mapping[str, float], read: Mapping[str, float]) -> list[str]:
    """Return which of the wanted numbers, by name, a file does not hold, a sentence each."""
    return [
        f"{name} is {read[name]!r}, not {value!r}" if name in read else f"{name} is missing"
        for name, value in wanted.items()
        if name not in read or not math.isclose(read[name], value, rel_tol=TOLERANCE, abs_tol=1e-15)
    ]


def write(draft: Draft, path: Path, others: Mapping[Path, Path] | None = None) -> None:
    """Write a draft if it reads back as what it should hold; otherwise all stays as it was.

    Parameters
    ----------
    draft
        What to write.
    path
        Where to; it appears whole.
    others
        Further file of the draft -> where it is written instead; None writes it where it is.

    Raises
    ------
    ExportError
        It does not hold what it should.
    OutputError
        It cannot be written.
    """
    with ExitStack() as stack:

        def written(place: Path, text: str) -> Path:
            make_folder(place.parent)
            unfinished = stack.enter_context(whole_file(place))
            unfinished.write_text(text, encoding="utf-8", newline="")
            return unfinished

        first = written(path, draft.text)
        instead = {
            file: written((others or {}).get(file, file), text)
            for file, text in draft.others.items()
        }
        wrong = draft.faults(first, instead) if instead else draft.faults(first)
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
