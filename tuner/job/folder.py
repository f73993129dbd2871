"""The folder that a job writes its results into, settled before anything is computed."""

from __future__ import annotations

import datetime
from pathlib import Path

from tuner.core.disk import check_folder, exists
from tuner.core.errors import InputError


def folder_for(out: Path | None, *, resume: bool = False) -> Path:
    """Return the folder to write into: the one named, or a new one under ``runs/``.

    Parameters
    ----------
    out
        What the user named.
    resume
        Whether a search that was interrupted there is gone on with.

    Raises
    ------
    InputError
        The folder cannot be made or written to, or there is none to go on in.
    """
    if resume and out is None:
        raise InputError("--resume", "needs the folder to go on in", "name it with --out")
    if out is None:
        out = Path("runs") / datetime.datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    check_folder(out)
    if resume and not exists(out):
        raise InputError(out, "does not exist, so there is nothing to resume", "leave --resume out")
    return out
