"""Words of users, safe as file names and for display; messages as pages and HTTP word them.

What the command line has as options are fields of a page and keys of a request.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import PurePosixPath

from tuner.core.disk import file_name
from tuner.options import Options

FIELD_PHRASES: Mapping[str, str] = {
    "config": "the settings",
    "controller": "the setting 'controller'",
    "fit": "the setting 'free'",
    "fix": "the setting 'fixed'",
    "holdout": "what checks the fit",
    "mass": "the weighed mass",
    "method": "the setting 'search.method'",
    "namespace": "the setting 'namespace'",
    "seed": "the setting 'search.seed'",
    "topics": "the setting 'topics'",
    "vehicle": "the vehicle",
}
"""Option of `tune` that a job has, too -> the same on the page where a job begins."""
KEYS: Mapping[str, str] = {"config": "settings"}
"""Option of `tune` -> key of a request, where that is not its name."""
_OPTION = re.compile(rf"--({'|'.join(FIELD_PHRASES)})\b(?!-)( [A-Z]+\b)?")
_ANY_OPTION = re.compile(r"--([a-z]+(?:-[a-z]+)*)\b")
_REQUEST_FIELDS = {field.name for field in fields(Options)}
_COMMAND = re.compile(r",? which tune inspect FILE --suggest begins")


def over_http(text: str) -> str:
    """Return a message with keys of a request in place of options of the command line."""

    def key(found: re.Match[str]) -> str:
        name = found[1].replace("-", "_")
        return KEYS.get(name, name) if name in _REQUEST_FIELDS else found[0]

    return _ANY_OPTION.sub(key, _COMMAND.sub("", text))


def on_the_web(text: str) -> str:
    """Return a message with fields of the page in place of options of the command line."""
    return _OPTION.sub(lambda found: FIELD_PHRASES[found[1]], _COMMAND.sub("", text))


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
