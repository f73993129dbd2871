"""The errors that a user can cause: each is one line, and says where, what is wrong, what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path


class InputError(Exception):
    """The user's input is wrong; the command line turns it into one line and exit status 2.

    Parameters
    ----------
    where
        The file or option at fault.
    what
        What is wrong with it.
    remedy
        What to do about it.
    """

    def __init__(self, where: str | Path, what: str, remedy: str) -> None:
        self.where = str(where)
        self.what = what
        self.remedy = remedy
        super().__init__(" ".join(f"{where}: {what}; {remedy}".split()))

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Survive the way from another process."""
        return type(self), (self.where, self.what, self.remedy)


class ConfigError(InputError):
    """A vehicle, controller or job file cannot be used."""


class RecordingError(InputError):
    """A recording cannot be read, or lacks what is asked of it."""


class OutputError(InputError):
    """A file or folder cannot be written where it was asked for."""


class ServerFaultError(Exception):
    """A server that was asked has a fault; the command line gives one line and exit status 1."""


class ExportError(InputError):
    """An export was refused or could not be written."""


class EngineError(InputError):
    """A remote or local engine is gone, or cannot go on."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return ``did you mean 'x'?`` for the nearest known word, or the list of known words."""
    names = sorted(known)
    close = difflib.get_close_matches(str(word), names, n=1, cutoff=0.55)
    return f"did you mean '{close[0]}'?" if close else f"known are {', '.join(names)}"


def short_reason(err: Exception) -> str:
    """Return a library's error in one line, short enough for a message."""
    return " ".join(str(err).split())[:120]
