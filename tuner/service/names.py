"""Names that users give, made safe as file names, never paths, and for display."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePosixPath

from tuner.core.disk import file_name

_SIDE_CARS = (".yaml", ".yml")


def last_part(name: str) -> str:
    """Return the part after the last slash of either kind."""
    return re.split(r"[/\\]", name)[-1]


def recording_name(name: str) -> str:
    """Return a recording's file name; what would be read as a file beside it gets another suffix.

    The stem, by which a flight goes, is kept where it is plain, and so is the suffix.
    """
    stem, _, ending = last_part(name).rpartition(".")
    if not stem or not re.fullmatch(r"\w{1,9}", ending, re.ASCII):
        stem, ending = last_part(name), ""
    suffix = f".{ending}" if ending else ""
    return file_name(stem, f"{suffix}_" if suffix.lower() in _SIDE_CARS else suffix)


def stems(names: Iterable[str]) -> list[str]:
    """Return the flights' names."""
    return [PurePosixPath(name).stem for name in names]


def shown_name(name: str) -> str:
    """Return a sender's file name for display: one short line without folders."""
    plain = "".join(c if c.isprintable() else "_" for c in last_part(name)).strip()
    return plain[:200] or "recording"


def shown(name: str) -> str:
    """Return a user's word for a message: short, in one line."""
    plain = "".join(c if c.isprintable() else "?" for c in name)
    return plain if len(plain) <= 60 else plain[:57] + "..."
