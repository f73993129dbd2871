"""The job table as a queue: who works on what. Each step is one conditional UPDATE.

An attempt at a job holds a claim, a word that nobody else has. All that it reports, its result
too, counts only while the table still names that claim: whoever was given up for dead, or whose
job was cancelled, changes nothing any more. So nothing runs twice to two results.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import CursorResult, insert, select, update
from sqlalchemy.orm import Session, undefer

from tuner.service.database import Database
from tuner.service.tables import EventRow, FileRow, JobRow, PointRow, State

MAX_EVENTS = 20_000
"""A job keeps so many events, and afterwards as many messages and states."""


@dataclass(frozen=True)
class Claim:
    """An attempt at a job.

    Attributes
    ----------
    word
        What the table names the attempt by.
    deaths
        Earlier attempts whose process died.
    flights
        Name of each recording in the job -> its digest.
    checkpoint
        Name -> digest of a file in the store from which the search goes on.
    preamble
        What earlier attempts said before their search began, which this one may say again.
    """

    number: int
    id: str
    word: str
    deaths: int
    request: Mapping[str, Any]
    flights: Mapping[str, str]
    checkpoint: Mapping[str, str]
    preamble: tuple[str, ...] = ()


@dataclass(frozen=True)
class Outcome:
    """The outcome of an attempt.

    Attributes
    ----------
    usability
        Whether the result can be used.
    files, points
        Rows of a result, without their job.
    """

    state: State
    error: str | None = None
    exit_status: int | None = None
    usability: str | None = None
    files: Sequence[Mapping[str, Any]] = field(default_factory=tuple)
    points: Sequence[Mapping[str, Any]] = field(default_factory=tuple)


class Queue:
    """The jobs that one server, the owner, takes from a table that others may take from as well.

    Parameters
    ----------
    owner
        A name that the server keeps when it is started again.
    lease
        s for which a claim holds unless it is renewed.
    """

    def __init__(self, database: Database, owner: str, lease: float) -> None:
        self._database = database
        self._owner = owner
        self._lease = lease

    def claim(self) -> Claim | None:
        """Take the job that has waited longest; None if none waits."""
        word = secrets.token_hex(16)
        with self._database.writing() as session:
            waiting = (
                select(JobRow)
                .options(undefer(JobRow.request), undefer(JobRow.checkpoint))
                .where(JobRow.state == State.QUEUED)
                .order_by(JobRow.number)
                .limit(1)
                .with_for_update(skip_locked=True)
            )
            row = session.scalars(waiting).first()
            if row is None:
                return None
            now = time.time()
            row.state, row.claim, row.owner = State.RUNNING, word, self._owner
            row.lease = now + self._lease
            row.started = row.started or now
            flights = {flight.name: flight.sha256 for flight in row.flights}
            add_event(session, row.number, "state", {"state": State.RUNNING})
            checkpoint, preamble = row.checkpoint or {}, _preamble(session, row.number)
            return Claim(
                row.number, row.id, word, row.deaths, row.request, flights, checkpoint, preamble
            )

    def report(
        self,
        claim: Claim,
        events: Sequence[tuple[str, Mapping[str, Any]]],
        progress: Mapping[str, Any],
    ) -> bool:
        """Enter an attempt's events, and renew its lease; False if it holds the job no more."""
        with self._database.writing() as session:
            lease = time.time() + self._lease
            if not _update(session, claim, {**progress, "lease": lease}):
                return False
            for kind, content in events:
                add_event(session, claim.number, kind, content)
            return True

    def finish(self, claim: Claim, outcome: Outcome) -> bool:
        """Let the job end with an outcome; False if the attempt holds it no more."""
        with self._database.writing() as session:
            ending = {
                "state": outcome.state,
                "error": outcome.error,
                "exit_status": outcome.exit_status,
                "usability": outcome.usability,
                "ended": time.time(),
                "seconds_left": 0.0 if outcome.state == State.DONE else None,
                **UNCLAIMED,
            }
            if not _update(session, claim, ending):
                return False
            for table, rows in ((FileRow, outcome.files), (PointRow, outcome.points)):
                if rows:
                    session.execute(insert(table), [{"job": claim.number, **row} for row in rows])
            content = {"state": outcome.state, "error": outcome.error}
            add_event(session, claim.number, "state", content)
            return True

    def give_back(self, claim: Claim, *, message: str, died: bool = False) -> bool:
        """Put the job back into the queue, its checkpoint kept; False if it is held no more."""
        with self._database.writing() as session:
            waiting = {
                "state": State.QUEUED,
                "deaths": JobRow.deaths + int(died),
                "seconds_left": None,
                **UNCLAIMED,
            }
            if not _update(session, claim, waiting):
                return False
            add_event(session, claim.number, "message", {"text": message})
            add_event(session, claim.number, "state", {"state": State.QUEUED})
            return True

    def recover(self, *, own: bool) -> int:
        """Put jobs back into the queue whose server has gone, and return how many.

        Parameters
        ----------
        own
            Whether they are those of this server, which has just been started again; otherwise
            those whose lease has run out.
        """
        lost = JobRow.owner == self._owner if own else JobRow.lease < time.time()
        text = "The server that worked on this job has gone; it goes on from its checkpoint."
        with self._database.writing() as session:
            rows = session.scalars(
                select(JobRow)
                .where(JobRow.state == State.RUNNING, lost)
                .with_for_update(skip_locked=True)
            ).all()
            for row in rows:
                row.state, row.seconds_left = State.QUEUED, None
                row.claim = row.owner = row.lease = None
                add_event(session, row.number, "message", {"text": text})
                add_event(session, row.number, "state", {"state": State.QUEUED})
            return len(rows)


def _preamble(session: Session, job: int) -> tuple[str, ...]:
    """Return the messages of a job's attempts before their first iterations."""
    begins = {"state": True, "iteration": False}
    events = select(EventRow.kind, EventRow.content).where(
        EventRow.job == job, EventRow.kind.in_((*begins, "message"))
    )
    texts, is_before = [], True
    for kind, content in session.execute(events.order_by(EventRow.number)):
        if kind == "message" and is_before:
            texts.append(str(content["text"]))
        is_before = begins.get(kind, is_before)
    return tuple(texts)


UNCLAIMED = {"claim": None, "owner": None, "lease": None}


def _update(session: Session, claim: Claim, values: Mapping[str, Any]) -> bool:
    """Change the row of a job if the claim still holds it."""
    statement = (
        update(JobRow)
        .where(
            JobRow.number == claim.number, JobRow.claim == claim.word, JobRow.state == State.RUNNING
        )
        .values(**values)
        .execution_options(synchronize_session=False)
    )
    done = session.execute(statement)
    assert isinstance(done, CursorResult)
    return done.rowcount == 1


def add_event(session: Session, job: int, kind: str, content: Mapping[str, Any]) -> None:
    """Add an event to a job; the row of the job orders those who add at the same time."""
    session.flush()
    number = session.scalar(
        update(JobRow)
        .where(JobRow.number == job)
        .values(events=JobRow.events + 1)
        .returning(JobRow.events)
        .execution_options(synchronize_session=False)
    )
    assert number is not None
    if number <= MAX_EVENTS * (2 if kind in ("message", "state") else 1):
        row = {"job": job, "number": number, "kind": kind, "content": dict(content)}
        session.execute(insert(EventRow), [row])
