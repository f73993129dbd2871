"""Refusals of the service: a sentence for the user and an HTTP status each.

What the command line has as options are keys of a request, and fields of a page: messages are
worded so.
"""

from __future__ import annotations

import errno
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields
from typing import ClassVar

from tuner.core.errors import InputError
from tuner.options import Options


class ServiceError(InputError):
    """A request that cannot be met; ``STATUS`` is what HTTP answers."""

    STATUS: ClassVar[int] = 422


class NotKnownError(ServiceError):
    """There is no such thing."""

    STATUS = 404


class NotNowError(ServiceError):
    """The state of the job does not allow it."""

    STATUS = 409


class TooLargeError(ServiceError):
    """More bytes than the service takes."""

    STATUS = 413


class TooManyError(ServiceError):
    """More requests, uploads or jobs than the service takes."""

    STATUS = 429


class NotAllowedError(ServiceError):
    """A request from another page, or under a name that is not this server's."""

    STATUS = 403


class NoTokenError(ServiceError):
    """No token, or none of this server."""

    STATUS = 401


class UnavailableError(ServiceError):
    """The database cannot be reached, or the server is ending."""

    STATUS = 503


class NoSpaceError(ServiceError):
    """The disk is full."""

    STATUS = 507


def unknown_job(name: str) -> NotKnownError:
    """Return the refusal of a job that does not exist."""
    return NotKnownError(f"job {shown(name)}", "is not known here", "list the jobs with tune jobs")


@contextmanager
def full_disk() -> Iterator[None]:
    """Turn a full disk into a sentence for the user.

    Raises
    ------
    NoSpaceError
        The disk is full.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise
        raise no_space() from None


def no_space() -> NoSpaceError:
    """Return the refusal of what would fill the disk."""
    return NoSpaceError("the server", "has no space left", "free some space and try again")


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
_COMMAND_OF_TERMINAL = re.compile(r" with tune jobs$")


def over_http(text: str) -> str:
    """Return a message with keys of a request in place of options of the command line."""

    def key(found: re.Match[str]) -> str:
        name = found[1].replace("-", "_")
        return KEYS.get(name, name) if name in _REQUEST_FIELDS else found[0]

    return _ANY_OPTION.sub(key, _COMMAND.sub("", text))


def on_the_web(text: str) -> str:
    """Return a message with fields of the page in place of options of the command line."""
    text = _COMMAND_OF_TERMINAL.sub("", _COMMAND.sub("", text))
    return _OPTION.sub(lambda found: FIELD_PHRASES[found[1]], text)


def is_plain_name(name: str) -> bool:
    """Return whether a visitor's name for something is printable, and not long."""
    return bool(name.strip()) and name.isprintable() and len(name) <= 100


def shown(name: str) -> str:
    """Return a user's word for a message: short, in one line."""
    plain = "".join(c if c.isprintable() else "?" for c in name)
    return plain if len(plain) <= 60 else plain[:57] + "..."
