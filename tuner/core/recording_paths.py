"""Which recordings a user means: paths and quoted globs."""

from __future__ import annotations

import glob
from collections.abc import Iterable
from pathlib import Path

from tuner.core.disk import exists
from tuner.core.errors import InputError


def find_flights(patterns: Iterable[str]) -> tuple[Path, ...]:
    """Return the recordings that paths and quoted globs mean, each once, globs sorted.

    Raises
    ------
    InputError
        A path does not exist, a glob matches nothing, or nothing is named at all.
    """
    recordings: dict[Path, Path] = {}
    for pattern in patterns:
        path = Path(pattern).expanduser()
        if exists(path):
            matches = [path]
        elif glob.has_magic(pattern):
            matches = [Path(match) for match in sorted(glob.glob(str(path)))]  # noqa: PTH207
            if not matches:
                raise InputError(pattern, "matches no file", "check the folder and the pattern")
        else:
            raise InputError(path, "does not exist", "check the path")
        for match in matches:
            if match.is_dir() and not (match / "metadata.yaml").exists():
                raise InputError(
                    match, "is a folder", f"give the recordings in it: '{match}/*.bag'"
                )
            recordings.setdefault(match.resolve(), match)
    if not recordings:
        raise InputError("--flights", "names no recording", "give the recordings to use")
    return tuple(recordings.values())
