"""The tables: recordings, jobs with their states, events, files and points, tokens and sessions.

Times are s since 1970, UTC.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Any

from sqlalchemy import JSON, BigInteger, ForeignKey, Index, Integer, MetaData, String, Text
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship

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
