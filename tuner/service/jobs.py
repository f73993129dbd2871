"""Operations on jobs: submit, list, read, cancel, retry; the history of a vehicle."""

from __future__ import annotations

import datetime
import hashlib
import re
import secrets
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import ColumnElement, func, insert, select, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session, selectinload, undefer

from tuner.core.errors import InputError
from tuner.service.database import (
    UNFINISHED,
    Database,
    EventRow,
    FileRow,
    FlightRow,
    JobRow,
    PointRow,
    RecordingRow,
    State,
)
from tuner.service.errors import NotKnownError, NotNowError, TooManyError, shown, unknown_job
from tuner.service.request import JobRequest, check_request, recording_name, stems
from tuner.service.settings import ServiceLimits
from tuner.service.shapes import CoefficientHistory, History, HistoryPoint, iso
from tuner.vehicle.registry import mass_factor

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
class AttemptOutcome:
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


class JobQueue:
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
    ) -> bool:
        """Enter an attempt's events, and renew its lease; False if it holds the job no more."""
        with self._database.writing() as session:
            lease = time.time() + self._lease
            if _change(session, {**_progress(dict(events)), "lease": lease}, *_held(claim)) is None:
                return False
            for kind, content in events:
                if kind != "checkpoint":
                    add_event(session, claim.number, kind, content)
            return True

    def finish(self, claim: Claim, outcome: AttemptOutcome) -> bool:
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
            if _change(session, ending, *_held(claim)) is None:
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
            if _change(session, waiting, *_held(claim)) is None:
                return False
            _say_queued(session, claim.number, message)
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
                _say_queued(session, row.number, text)
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


def _progress(latest: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the columns of a job that follow from the latest event of each kind."""
    columns: dict[str, Any] = {}
    if (last := latest.get("iteration")) is not None:
        columns = {"stage": last["stage"], "iteration": last["number"]}
        columns["seconds_left"] = last["seconds_left"]
        if last["position_rmse"] is not None:
            columns["rmse"] = last["position_rmse"]
    return columns | {kind: latest[kind] for kind in ("checkpoint",) if kind in latest}


UNCLAIMED = {"claim": None, "owner": None, "lease": None}


def _held(claim: Claim) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions that an attempt still holds its job."""
    return (
        JobRow.number == claim.number,
        JobRow.claim == claim.word,
        JobRow.state == State.RUNNING,
    )


def _change(
    session: Session, values: Mapping[str, Any], *conditions: ColumnElement[bool]
) -> int | None:
    """Change the row of the job that fulfils conditions; return its events, None without one."""
    statement = update(JobRow).where(*conditions).values(**values).returning(JobRow.events)
    return session.scalar(statement.execution_options(synchronize_session=False))


def _say_queued(session: Session, job: int, message: str) -> None:
    """Add to a job that it waits again, and why."""
    add_event(session, job, "message", {"text": message})
    add_event(session, job, "state", {"state": State.QUEUED})


def add_event(session: Session, job: int, kind: str, content: Mapping[str, Any]) -> None:
    """Add an event to a job; the row of the job orders those who add at the same time."""
    session.flush()
    number = _change(session, {"events": JobRow.events + 1}, JobRow.number == job)
    assert number is not None
    if number <= MAX_EVENTS * (2 if kind in ("message", "state") else 1):
        row = {"job": job, "number": number, "kind": kind, "content": dict(content)}
        session.execute(insert(EventRow), [row])


PAGE_SIZE = 50
"""Jobs of one page."""
_ID = re.compile("[0-9a-f]{16}")


def submit(
    database: Database, request: JobRequest, limits: ServiceLimits, *, submission: str | None = None
) -> tuple[JobRow, bool]:
    """Enter a job, and return it and whether it is new.

    Parameters
    ----------
    limits
        On recordings of one job and on unfinished jobs.
    submission
        A key of this request; the same one with the same key is answered with the same job.

    Raises
    ------
    InputError
        The request cannot be met; one line says what to do.
    """
    if submission is not None:
        submission = hashlib.sha256(
            f"{submission}\n{request.model_dump_json()}".encode()
        ).hexdigest()
        if (before := _submitted(database, submission)) is not None:
            return before, False
    with database.reading() as session:
        recordings = _recordings(session, request.recordings, limits)
        unfinished = session.scalar(
            select(func.count()).select_from(JobRow).where(JobRow.state.in_(UNFINISHED))
        )
        earlier = _earlier_vehicle(session, request)
    if unfinished is not None and unfinished >= limits.unfinished_jobs:
        raise TooManyError("the service", f"has {unfinished} unfinished jobs", "try again later")
    flights = [recording_name(request.names.get(r.sha256) or r.name) for r in recordings]
    asked, vehicle, holdout = check_request(request, flights, earlier)
    flown = [t for r in recordings if (t := _seconds(r.inspection.get("started"))) is not None]
    row = JobRow(
        id=secrets.token_hex(8),
        name=request.name or _name(flights, vehicle),
        vehicle=vehicle,
        state=State.QUEUED,
        request=asked.model_dump(mode="json", exclude_none=True),
        submitted=time.time(),
        flown=min(flown, default=None),
        submission=submission,
        deaths=0,
        events=0,
    )
    row.flights = [
        FlightRow(
            position=position,
            sha256=recording.sha256,
            name=name,
            holdout=name.rpartition(".")[0] in holdout or name in holdout,
        )
        for position, (recording, name) in enumerate(zip(recordings, flights, strict=True))
    ]
    try:
        with database.writing() as session:
            session.add(row)
            session.flush()
            add_event(session, row.number, "state", {"state": State.QUEUED})
    except IntegrityError:  # the same request arrived twice at the same time
        before = _submitted(database, submission or "")
        if before is None:
            raise
        return before, False
    return row, True


def _recordings(
    session: Session, digests: Sequence[str], limits: ServiceLimits
) -> list[RecordingRow]:
    """Return the recordings of a request."""
    if len(digests) > limits.recordings_of_job:
        raise TooManyError(
            "recordings", f"are {len(digests)}", f"give up to {limits.recordings_of_job} a job"
        )
    rows = {
        row.sha256: row
        for row in session.scalars(select(RecordingRow).where(RecordingRow.sha256.in_(digests)))
    }
    chosen = dict.fromkeys(digests)
    for digest in chosen:
        if digest not in rows:
            what = f"{digest[:12]}… was not uploaded here"
            raise InputError("recordings", what, "upload the recording first")
    return [rows[digest] for digest in chosen]


def _earlier_vehicle(session: Session, request: JobRequest) -> dict[str, Mapping[str, Any]]:
    """Return the vehicle of the last job of the name that a request gives, if there is one."""
    name = request.vehicle or request.settings.get("vehicle")
    if not isinstance(name, str) or not name.isprintable():
        return {}
    statement = (
        select(JobRow)
        .where(JobRow.vehicle == name)
        .order_by(JobRow.number.desc())
        .limit(1)
        .options(undefer(JobRow.request))
    )
    row = session.scalars(statement).first()
    vehicle = None if row is None else row.request.get("vehicle")
    return {name: vehicle} if isinstance(vehicle, dict) else {}


def _name(flights: Sequence[str], vehicle: str) -> str:
    more = f" and {len(flights) - 1} more" if len(flights) > 1 else ""
    return f"{vehicle}: {flights[0].rpartition('.')[0] or flights[0]}{more}"[:200]


def _seconds(started: object) -> float | None:
    """Return s since 1970 of an inspection's start."""
    if not isinstance(started, str):
        return None
    try:
        return datetime.datetime.fromisoformat(started).timestamp()
    except (ValueError, OverflowError, OSError):
        return None


def _submitted(database: Database, submission: str) -> JobRow | None:
    with database.reading() as session:
        return session.scalars(select(JobRow).where(JobRow.submission == submission)).first()


def page(
    database: Database,
    *,
    vehicle: str | None = None,
    state: State | None = None,
    after: str | None = None,
    limit: int = PAGE_SIZE,
) -> tuple[Sequence[JobRow], str | None]:
    """Return jobs with their files, the newest first, and after which the next page begins.

    Parameters
    ----------
    vehicle, state
        Which jobs; None takes all.
    after
        Id of the last job of the page before.

    Raises
    ------
    NotKnownError
        There is no job ``after``.
    """
    statement = select(JobRow).order_by(JobRow.number.desc()).limit(limit + 1)
    if vehicle is not None and not vehicle.isprintable():
        return [], None
    if vehicle is not None:
        statement = statement.where(JobRow.vehicle == vehicle)
    if state is not None:
        statement = statement.where(JobRow.state == state)
    with database.reading() as session:
        if after is not None:
            statement = statement.where(JobRow.number < _row(session, after).number)
        rows = session.scalars(statement.options(selectinload(JobRow.files))).all()
    return rows[:limit], rows[limit - 1].id if len(rows) > limit else None


def job(database: Database, name: str) -> JobRow:
    """Return a job with its flights and files.

    Raises
    ------
    NotKnownError
        There is none of this id.
    """
    with database.reading() as session:
        row = _row(session, name)
        _ = row.flights, row.files
        return row


def events(
    database: Database, row: JobRow, *, after: int = 0, most: int = 5_000, kind: str | None = None
) -> list[EventRow]:
    """Return the events of a job after one of them, of one kind or all."""
    with database.reading() as session:
        statement = (
            select(EventRow)
            .where(EventRow.job == row.number, EventRow.number > after)
            .order_by(EventRow.number)
            .limit(most)
        )
        if kind is not None:
            statement = statement.where(EventRow.kind == kind)
        return list(session.scalars(statement))


def cancel(database: Database, name: str) -> JobRow:
    """Let a job end without a result; its worker stops within a second.

    Raises
    ------
    NotKnownError, NotNowError
        There is no such job, or it has ended.
    """
    ending = {"state": State.CANCELLED, "ended": time.time(), "exit_status": 130}
    changes = {**ending, **UNCLAIMED, "seconds_left": None}
    return _move(database, name, UNFINISHED, changes, "there is nothing left to cancel")


def retry(database: Database, name: str) -> JobRow:
    """Put a job that failed or was cancelled back into the queue, with its checkpoint.

    Raises
    ------
    NotKnownError, NotNowError
        There is no such job, or it has not failed.
    """
    changes = {
        "state": State.QUEUED,
        "ended": None,
        "error": None,
        "exit_status": None,
        "deaths": 0,
    }
    remedy = "only a job that failed or was cancelled is tried again; submit a new one"
    return _move(database, name, (State.FAILED, State.CANCELLED), changes, remedy)


def _move(
    database: Database, name: str, allowed: Sequence[State], changes: Mapping[str, Any], remedy: str
) -> JobRow:
    """Change a job that is in one of some states."""
    with database.writing() as session:
        row = _row(session, name)
        if (
            _change(session, changes, JobRow.number == row.number, JobRow.state.in_(allowed))
            is None
        ):
            session.refresh(row)
            raise NotNowError(f"job {row.id}", f"is {row.state}", remedy)
        add_event(session, row.number, "state", {"state": changes["state"]})
        session.refresh(row)
        _ = row.flights, row.files
        return row


def _row(session: Session, name: str) -> JobRow:
    row = None
    if _ID.fullmatch(name):
        row = session.scalars(select(JobRow).where(JobRow.id == name)).first()
    if row is None:
        raise unknown_job(name)
    return row


def counts(database: Database) -> dict[str, int]:
    """Return the number of jobs in each state."""
    with database.reading() as session:
        rows = session.execute(select(JobRow.state, func.count()).group_by(JobRow.state)).all()
    found = {state: count for state, count in rows}  # noqa: C416 (rows are no pairs to mypy)
    return {state.value: found.get(state, 0) for state in State}


MAX_HISTORY_JOBS = 500
"""A history has at most so many jobs, the latest."""


def history(database: Database, vehicle: str) -> History:
    """Return every fitted coefficient over the jobs of a vehicle that are done.

    They stand in the order in which their recordings were flown, as far as that is known, and else
    in which they were submitted. What goes with the mass is that at the last job's mass: flights
    show only its ratio to the mass.

    Raises
    ------
    NotKnownError
        No job was of this vehicle.
    """
    with database.reading() as session:
        any_job = select(JobRow.number).where(JobRow.vehicle == vehicle).limit(1)
        if not vehicle.isprintable() or session.scalar(any_job) is None:
            raise NotKnownError(f"vehicle {shown(vehicle)}", "has no jobs here", "submit one")
        jobs = session.scalars(
            select(JobRow)
            .where(JobRow.vehicle == vehicle, JobRow.state == State.DONE)
            .order_by(JobRow.number.desc())
            .limit(MAX_HISTORY_JOBS)
            .options(selectinload(JobRow.flights))
        ).all()
        by_number = {job.number: job for job in jobs}
        rows = session.scalars(select(PointRow).where(PointRow.job.in_(by_number))).all()
    moments = {job.number: job.submitted if job.flown is None else job.flown for job in jobs}
    rows = sorted(rows, key=lambda row: (moments[row.job], row.job))
    masses = {row.job: row.best for row in rows if row.coefficient == "mass"}
    mass = next((masses[row.job] for row in reversed(rows) if row.job in masses), None)
    coefficients: dict[str, CoefficientHistory] = {}
    for row in rows:
        if row.coefficient == "mass" and row.identifiable is None:
            continue  # not fitted
        job = by_number[row.job]
        factor, ci95 = mass_factor(row.coefficient, masses.get(row.job), mass), None
        if row.lower is not None and row.upper is not None:
            ci95 = (factor * row.lower, factor * row.upper)
        point = HistoryPoint(
            job=job.id,
            name=job.name,
            flown=iso(job.flown),
            ended=iso(job.ended),
            mass=masses.get(row.job),
            best=factor * row.best,
            std_error=None if row.std_error is None else factor * row.std_error,
            ci95=ci95,
            identifiable=row.identifiable,
            flights=stems(flight.name for flight in job.flights if not flight.holdout),
        )
        empty = CoefficientHistory(unit=row.unit, points=[])
        coefficients.setdefault(row.coefficient, empty).points.append(point)
    return History(vehicle=vehicle, mass=mass, coefficients=coefficients)


def vehicles(database: Database) -> dict[str, int]:
    """Return each vehicle and how many jobs it has."""
    with database.reading() as session:
        statement = select(JobRow.vehicle, func.count()).group_by(JobRow.vehicle)
        rows = session.execute(statement.order_by(JobRow.vehicle)).all()
    return {vehicle: count for vehicle, count in rows}  # noqa: C416 (rows are no pairs to mypy)
