"""A folder that fills with recordings: those that have settled become a job."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping
from pathlib import Path

from pydantic import Field

from tuner.client.client import Client
from tuner.core.disk import exists
from tuner.core.errors import InputError
from tuner.core.files import ResultFile
from tuner.options import FitOptions

SUFFIXES = (".bag", ".mcap", ".db3", ".ulg", ".csv", ".parquet")
LOOK_INTERVAL_S = 2.0
"""Between two looks into the folder."""
Marks = tuple[int, int]
"""bytes, and ns of the last change"""


class Submitted(ResultFile):
    """Submitted recordings of a folder: name -> its marks and its job."""

    FILE = ".tune-submitted.json"

    recordings: dict[str, tuple[int, int, str]] = Field(default_factory=dict)


def watch(
    client: Client, folder: Path, *, settle: float, once: bool, say: Callable[[str], None]
) -> None:
    """Submit a job whenever new recordings have settled, until interrupted.

    Parameters
    ----------
    client
        Of the server.
    folder
        To look into.
    settle
        s for which no new recording has changed.
    once
        End after the first submission, or when nothing is new.
    say
        Gets a line for each submission and refusal.

    Raises
    ------
    InputError
        The folder is none or, with ``once``, the job is refused.
    """
    if not (exists(folder) and folder.is_dir()):
        raise InputError(folder, "is no folder", "name the folder that recordings arrive in")
    seen: Mapping[Path, Marks] = {}
    still_since = time.monotonic()
    refused: Mapping[Path, Marks] = {}
    while True:
        new = _new_recordings(folder)
        if new != seen:
            seen, still_since = new, time.monotonic()
        settled = time.monotonic() - still_since >= settle
        if new and settled and new != refused:
            try:
                say(_submit(client, folder, new))
                refused = {}
            except InputError as error:
                if once:
                    raise
                say(f"tune: {error}")
                refused = {} if error.where == "--server" else new
        if once and (not new or settled):
            return
        time.sleep(min(LOOK_INTERVAL_S, settle) if new else LOOK_INTERVAL_S)


def _new_recordings(folder: Path) -> dict[Path, Marks]:
    """Return the recordings that were not submitted as they are now."""
    before = Submitted.read_if_any(folder) or Submitted()
    found = {}
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        what = f"cannot be read any more ({error.strerror})"
        raise InputError(folder, what, "check the folder and the disk") from None
    for path in paths:
        if path.suffix.lower() not in SUFFIXES or path.name.startswith(".") or not path.is_file():
            continue
        try:
            about = path.stat()
        except FileNotFoundError:  # it was moved away just now
            continue
        marks = (about.st_size, about.st_mtime_ns)
        if before.recordings.get(path.name, (0, 0, ""))[:2] != marks:
            found[path] = marks
    return found


def _submit(client: Client, folder: Path, new: Mapping[Path, Marks]) -> str:
    """Submit one job of recordings, note it, and return a line about it."""
    key = hashlib.sha256(repr([(str(path.absolute()), *new[path]) for path in new]).encode())
    job = client.submit(FitOptions([str(path) for path in new]), key=key.hexdigest())
    before = Submitted.read_if_any(folder) or Submitted()
    done = {path.name: (*marks, job) for path, marks in new.items()}
    Submitted(recordings=before.recordings | done).write(folder)
    return f"{', '.join(path.name for path in new)}: job {job}"
