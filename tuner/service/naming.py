"""What users call their files, made fit to be a file's name here: never a path."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import PurePosixPath

LONGEST = 100
_SIDE_CARS = (".yaml", ".yml")


def last_part(name: str) -> str:
    """Return what stands behind the last slash of either kind."""
    return re.split(r"[/\\]", name)[-1]


def file_name(name: str) -> str:
    """Return a file's name that only has letters, digits, ``_``, ``-`` and dots inside it.

    The stem, by which a flight goes, is kept where it is plain, and so is the suffix.
    """
    plain = re.sub(r"[^A-Za-z0-9_.-]", "_", last_part(name)).strip(".-") or "recording"
    path = PurePosixPath(plain)
    suffix = path.suffix[:10]
    if suffix.lower() in _SIDE_CARS:
        suffix += "_"
    return path.stem[: LONGEST - len(suffix)] + suffix


def stems(names: Iterable[str]) -> list[str]:
    """Return the flights' names."""
    return [PurePosixPath(name).stem for name in names]
