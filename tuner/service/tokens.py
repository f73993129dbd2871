"""Visitors' tokens, shown once, and the sessions of browsers that showed one: kept as hashes."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time

from sqlalchemy import delete, select

from tuner.core.errors import InputError
from tuner.service.database import Database, SessionRow, TokenRow
from tuner.service.errors import is_plain_name

TOKEN_PREFIX = "tune_"
"""The prefix of tokens, by which a leaked one is recognised."""
SESSION_S = 7 * 86400
"""The duration of a browser's session."""


def add(database: Database, name: str) -> str:
    """Make a token for a visitor and return it; only its hash is kept.

    Raises
    ------
    InputError
        The name is taken, or no name.
    """
    if not is_plain_name(name):
        raise InputError("token", "needs a plain name of up to 100 letters", "say whose it is")
    token = TOKEN_PREFIX + secrets.token_urlsafe(32)
    with database.writing() as session:
        if session.get(TokenRow, name) is not None:
            raise InputError(
                "token", f"'{name}' has one already", f"tune serve token remove {name}"
            )
        session.add(TokenRow(name=name, sha256=_digest(token), added=time.time()))
    return token


def remove(database: Database, name: str) -> None:
    """Let a visitor's token, and the sessions that it opened, hold no more.

    Raises
    ------
    InputError
        Nobody of this name has one.
    """
    with database.writing() as session:
        gone = session.scalar(
            delete(TokenRow).where(TokenRow.name == name).returning(TokenRow.name)
        )
    if gone is None:
        raise InputError("token", f"'{name}' has none", "see tune serve token list")


def names(database: Database) -> list[str]:
    """Return who has a token."""
    with database.reading() as session:
        return list(session.scalars(select(TokenRow.name).order_by(TokenRow.name)))


def owner(database: Database, token: str) -> str | None:
    """Return whose token it is, None if nobody's; all are compared, each in constant time."""
    given, found = _digest(token), None
    with database.reading() as session:
        for row in session.scalars(select(TokenRow)):
            if hmac.compare_digest(row.sha256, given):
                found = row.name
    return found


def log_in(database: Database, token: str) -> str | None:
    """Open a session, and return the word that it goes by; None if it is nobody's token."""
    if (name := owner(database, token)) is None:
        return None
    word, now = secrets.token_urlsafe(32), time.time()
    with database.writing() as session:
        session.execute(delete(SessionRow).where(SessionRow.expires < now))
        session.add(SessionRow(sha256=_digest(word), token=name, expires=now + SESSION_S))
    return word


def logged_in(database: Database, word: str) -> str | None:
    """Return whose session goes by a word, None if there is none."""
    with database.reading() as session:
        row = session.get(SessionRow, _digest(word))
    return None if row is None or row.expires < time.time() else row.token


def log_out(database: Database, word: str) -> None:
    """End the session that goes by a word."""
    with database.writing() as session:
        session.execute(delete(SessionRow).where(SessionRow.sha256 == _digest(word)))


def _digest(token: str) -> str:
    """Return the SHA-256 of a secret: it has 256 random bits, so that no salt is needed."""
    return hashlib.sha256(token.encode("utf-8", "surrogatepass")).hexdigest()
