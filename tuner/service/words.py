"""Messages as pages and HTTP word them: what the command line has as options are fields there."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import fields

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
