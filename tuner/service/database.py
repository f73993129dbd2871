"""The database: SQLite beside the data or PostgreSQL by URL, migrated when it is opened."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from threading import Lock
from typing import Any

from alembic import command
from alembic.config import Config
from alembic.util.exc import CommandError
from sqlalchemy import (
    JSON,
    BigInteger,
    Connection,
    Engine,
    ForeignKey,
    Index,
    Integer,
    MetaData,
    String,
    Text,
    create_engine,
    event,
    inspect,
    make_url,
)
from sqlalchemy.exc import (
    ArgumentError,
    DBAPIError,
    InterfaceError,
    NoSuchModuleError,
    OperationalError,
)
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import DeclarativeBase, Mapped, Session, mapped_column, relationship

from tuner.core.errors import InputError
from tuner.core.runtime import extra
from tuner.service.errors import UnavailableError

#: An identity that SQLite counts by itself.
Number = BigInteger().with_variant(Integer(), "sqlite")


class State(StrEnum):
    """The state of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    CANCELLED = "cancelled"


UNFINISHED = (State.QUEUED, State.RUNNING)
FINISHED = (State.DONE, State.FAILED, State.CANCELLED)


class Base(DeclarativeBase):
    """All tables."""

    metadata = MetaData(
        naming_convention={
            "ix": "ix_%(table_name)s_%(column_0_N_name)s",
            "uq": "uq_%(table_name)s_%(column_0_N_name)s",
            "fk": "fk_%(table_name)s_%(column_0_name)s",
            "pk": "pk_%(table_name)s",
        }
    )


class RecordingRow(Base):
    """A stored recording, once however often it is uploaded.

    ``sha256`` is its address in the store; ``name`` is what the first upload called it.
    """

    __tablename__ = "recordings"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    name: Mapped[str] = mapped_column(String(255))
    size: Mapped[int] = mapped_column(BigInteger)
    uploaded: Mapped[float] = mapped_column(index=True)
    inspection: Mapped[dict[str, Any]] = mapped_column(JSON)


class JobRow(Base):
    """A job.

    Attributes
    ----------
    number, id
        The order of submission, and what users call it by.
    vehicle
        Name of the vehicle whose history it belongs to.
    request
        What is to be fitted: settings, vehicle, controller, topics, flights, see `request`.
    stage, iteration, rmse, seconds_left
        Of the search; m, s.
    error, exit_status
        Why it failed, and the exit status of the local command; 0 where it is done.
    usability
        Of its result, a word of `tuner.report.outcome.Usability`; None before it is done.
    deaths
        Attempts whose process died.
    checkpoint
        Name -> digest of a file in the store from which a worker elsewhere goes on.
    claim, owner, lease
        Who works on it: the attempt, its server, and until when that holds.
    submission
        A key of the one who submitted it, so that a repeated request makes no second job.
    events
        Number of the last event.
    """

    __tablename__ = "jobs"
    __table_args__ = (
        Index("ix_jobs_state_number", "state", "number"),
        Index("ix_jobs_vehicle_number", "vehicle", "number"),
    )

    number: Mapped[int] = mapped_column(Number, primary_key=True, autoincrement=True)
    id: Mapped[str] = mapped_column(String(32), unique=True)
    name: Mapped[str] = mapped_column(String(200))
    vehicle: Mapped[str] = mapped_column(String(200))
    state: Mapped[str] = mapped_column(String(16), default=State.QUEUED)
    request: Mapped[dict[str, Any]] = mapped_column(JSON, deferred=True)
    stage: Mapped[str | None] = mapped_column(String(200))
    iteration: Mapped[int | None]
    rmse: Mapped[float | None]
    seconds_left: Mapped[float | None]
    submitted: Mapped[float]
    started: Mapped[float | None]
    ended: Mapped[float | None]
    flown: Mapped[float | None]
    error: Mapped[str | None] = mapped_column(Text)
    exit_status: Mapped[int | None]
    usability: Mapped[str | None] = mapped_column(String(20))
    deaths: Mapped[int] = mapped_column(default=0)
    checkpoint: Mapped[dict[str, str] | None] = mapped_column(JSON, deferred=True)
    claim: Mapped[str | None] = mapped_column(String(32))
    owner: Mapped[str | None] = mapped_column(String(64))
    lease: Mapped[float | None]
    submission: Mapped[str | None] = mapped_column(String(200), unique=True)
    events: Mapped[int] = mapped_column(default=0)

    flights: Mapped[list[FlightRow]] = relationship(order_by="FlightRow.position")
    files: Mapped[list[FileRow]] = relationship(order_by="FileRow.name")


class FlightRow(Base):
    """A recording of a job: the ``name`` of its file there, and whether it is held out."""

    __tablename__ = "flights"

    job: Mapped[int] = mapped_column(ForeignKey("jobs.number"), primary_key=True)
    position: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    sha256: Mapped[str] = mapped_column(ForeignKey("recordings.sha256"), index=True)
    name: Mapped[str] = mapped_column(String(255))
    holdout: Mapped[bool]


class EventRow(Base):
    """An event of a job: a message, an iteration of the search, a change of state."""

    __tablename__ = "events"

    job: Mapped[int] = mapped_column(ForeignKey("jobs.number"), primary_key=True)
    number: Mapped[int] = mapped_column(primary_key=True, autoincrement=False)
    kind: Mapped[str] = mapped_column(String(16))
    content: Mapped[dict[str, Any]] = mapped_column(JSON)


class FileRow(Base):
    """A file of a result, and its address in the store."""

    __tablename__ = "files"

    job: Mapped[int] = mapped_column(ForeignKey("jobs.number"), primary_key=True)
    name: Mapped[str] = mapped_column(String(255), primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64))
    size: Mapped[int] = mapped_column(BigInteger)


class PointRow(Base):
    """A coefficient as one job found it, for the history of its vehicle."""

    __tablename__ = "points"

    job: Mapped[int] = mapped_column(ForeignKey("jobs.number"), primary_key=True)
    coefficient: Mapped[str] = mapped_column(String(64), primary_key=True)
    unit: Mapped[str] = mapped_column(String(32))
    best: Mapped[float]
    std_error: Mapped[float | None]
    lower: Mapped[float | None]
    upper: Mapped[float | None]
    identifiable: Mapped[bool | None]


class TokenRow(Base):
    """A visitor's token, of which only the SHA-256 is kept."""

    __tablename__ = "tokens"

    name: Mapped[str] = mapped_column(String(100), primary_key=True)
    sha256: Mapped[str] = mapped_column(String(64))
    added: Mapped[float]


class SessionRow(Base):
    """A browser that showed a token, by the SHA-256 of a word that only it has."""

    __tablename__ = "sessions"

    sha256: Mapped[str] = mapped_column(String(64), primary_key=True)
    token: Mapped[str] = mapped_column(ForeignKey("tokens.name", ondelete="CASCADE"))
    expires: Mapped[float]


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
        """Make the tables, or bring those that are there to this version of the program.

        Raises
        ------
        InputError
            The database cannot be reached, or is of a version that this one does not know.
        """
        config = Config()
        config.set_main_option("script_location", "tuner.service:migrations")
        try:
            with _outages(), self._writer.begin() as connection:
                config.attributes["connection"] = connection
                if inspect(connection).has_table(JobRow.__tablename__):
                    command.upgrade(config, "head")
                else:
                    Base.metadata.create_all(connection)
                    command.stamp(config, "head")
        except CommandError:
            what = "was made by another version of tune"
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
        with extra("postgresql", "--database"):
            engine = create_engine(url, pool_pre_ping=True, pool_size=20, max_overflow=40)
    except (ArgumentError, NoSuchModuleError, ValueError):
        raise InputError(
            "--database", "is no URL of SQLite or PostgreSQL", "write postgresql://user@host/name"
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
