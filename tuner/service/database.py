"""The database: SQLite beside the data or PostgreSQL by URL, migrated when it is opened."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

from alembic import command
from alembic.config import Config
from alembic.util.exc import CommandError
from sqlalchemy import Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    InterfaceError,
    NoSuchModuleError,
    OperationalError,
)
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session

from tuner.core.errors import InputError
from tuner.service.errors import UnavailableError

MAX_LOCK_WAIT_S = 5.0
"""A writer waits so long for another process,"""
MAX_TURN_WAIT_S = 30.0
"""and so long for other threads of this one."""


class Database:
    """Sessions of one database.

    Parameters
    ----------
    url
        SQLAlchemy's; ``postgresql://`` is taken through psycopg 3.

    Raises
    ------
    InputError
        The URL is of no database that is supported, or its driver is not installed.
    """

    def __init__(self, url: str) -> None:
        self._reader = _engine(url)
        self._writer = self._reader.execution_options(writes=True)
        one_writer = self._reader.dialect.name == "sqlite"
        self._turn = Lock() if one_writer else None

    def migrate(self) -> None:
        """Bring the tables to this version of the program.

        Raises
        ------
        InputError
            The database cannot be reached, or is of a newer version.
        """
        config = Config()
        config.set_main_option("script_location", "tuner.service:migrations")
        try:
            with _outages(), self._writer.begin() as connection:
                config.attributes["connection"] = connection
                command.upgrade(config, "head")
        except CommandError:
            what = "was made by a newer version of tune"
            raise InputError("the database", what, "use that version, or another --data") from None

    @contextmanager
    def reading(self) -> Iterator[Session]:
        """Yield a session that sees one moment.

        Raises
        ------
        UnavailableError
            The database cannot be reached, or is locked.
        """
        with _outages(), Session(self._reader) as session:
            yield session

    @contextmanager
    def writing(self) -> Iterator[Session]:
        """Yield a session that is committed at the end, or leaves nothing.

        SQLite has one writer at a time, and those who wait for another process's take no turns:
        our own threads do.

        Raises
        ------
        UnavailableError
            The database cannot be reached, or is locked.
        """
        session = Session(self._writer, expire_on_commit=False)
        with _outages(), self._in_turn(), session, session.begin():
            yield session

    @contextmanager
    def _in_turn(self) -> Iterator[None]:
        """Wait until no other thread of ours writes, where there may be only one."""
        if self._turn is None:
            yield
            return
        if not self._turn.acquire(timeout=MAX_TURN_WAIT_S):
            raise UnavailableError("the database", "is busy", "try again in a minute")
        try:
            yield
        finally:
            self._turn.release()

    def close(self) -> None:
        """Let go of all connections."""
        self._reader.dispose()


@contextmanager
def _outages() -> Iterator[None]:
    """Turn a database that does not answer into a sentence for the user."""
    try:
        yield
    except PoolTimeout:
        raise UnavailableError("the database", "is busy", "try again in a minute") from None
    except DBAPIError as error:
        said = str(error.orig)
        for words, what, remedy in _OUTAGES:
            if any(word in said for word in words):
                raise UnavailableError("the database", what, remedy) from error
        if error.connection_invalidated or isinstance(error, OperationalError | InterfaceError):
            what, remedy = "cannot be reached", "check that it runs, and try again"
            raise UnavailableError("the database", what, remedy) from error
        raise


_OUTAGES = (
    (("locked",), "is locked by another program", "close that, or try again in a minute"),
    (
        ("disk is full", "No space left"),
        "cannot be written: the disk is full",
        "free some space and try again",
    ),
    (("not a database", "malformed"), "is damaged, or no database", "restore it from a copy"),
)
"""Words of a driver -> what is wrong, and what to do."""


def _engine(given: str) -> Engine:
    try:
        url = make_url(given)
        if url.drivername == "postgresql":
            url = url.set(drivername="postgresql+psycopg")
        if url.get_backend_name() not in ("sqlite", "postgresql"):
            raise ArgumentError
        engine = create_engine(url, pool_pre_ping=True, pool_size=20, max_overflow=40)
    except (ArgumentError, NoSuchModuleError, ValueError):
        raise InputError(
            "--database", "is no URL of SQLite or PostgreSQL", "write postgresql://user@host/name"
        ) from None
    except ModuleNotFoundError as error:
        raise InputError(
            "--database", f"needs {error.name}", "pip install 'multirotor-tune[postgresql]'"
        ) from None
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _set_up_sqlite)
        event.listen(engine, "begin", _begin)
    return engine


def _set_up_sqlite(connection: Any, _: object) -> None:
    """Let readers and one writer go side by side, and let us begin transactions ourselves."""
    connection.isolation_level = None
    cursor = connection.cursor()
    cursor.execute(f"PRAGMA busy_timeout={int(1000 * MAX_LOCK_WAIT_S)}")
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA synchronous=FULL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _begin(connection: Connection) -> None:
    """Begin as a writer where one is to write: a reader that turns writer may not wait its turn."""
    writes = connection.get_execution_options().get("writes")
    connection.exec_driver_sql("BEGIN IMMEDIATE" if writes else "BEGIN")
