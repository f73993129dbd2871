"""Messages as pages and HTTP word them: what the command line has as options are fields there."""

from __future__ import annotations

import re
from collections.abc import Mapping

FIELDS: Mapping[str, str] = {
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
_OPTION = re.compile(rf"--({'|'.join(FIELDS)})\b(?!-)( [A-Z]+\b)?")
_ANY = re.compile(r"--([a-z]+(?:-[a-z]+)*)\b")
_COMMAND = re.compile(r",? which tune inspect FILE --suggest begins")


def over_http(text: str) -> str:
    """Return a message with keys of a request in place of options of the command line."""
    text = _COMMAND.sub("", text)
    return _ANY.sub(lambda found: KEYS.get(found[1], found[1].replace("-", "_")), text)


def on_the_web(text: str) -> str:
    """Return a message with fields of the page in place of options of the command line."""
    return _OPTION.sub(lambda found: FIELDS[found[1]], _COMMAND.sub("", text))
