"""Refusals of the service: a sentence for the user and an HTTP status each."""

from __future__ import annotations

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from typing import ClassVar

from tuner.core.errors import InputError
from tuner.service.words import shown


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
        raise NoSpaceError(
            "the server", "has no space left", "free some space and try again"
        ) from None
