"""JSON models of the HTTP answers."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Annotated

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field, JsonValue

from tuner.report.outcome import Usability
from tuner.service.database import EventRow, FileRow, JobRow, State
from tuner.service.errors import over_http

API = "/api/v1"


def iso(seconds: float | None) -> str | None:
    """Return s since 1970 as ISO 8601."""
    if seconds is None:
        return None
    moment = datetime.datetime.fromtimestamp(seconds, datetime.UTC)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


Moment = Annotated[
    str, BeforeValidator(lambda value: iso(value) if isinstance(value, float) else value)
]
"""ISO 8601 of s since 1970."""


class Problem(BaseModel):
    """A refusal: where, what is wrong, what to do, and all of it as one sentence."""

    where: str
    what: str
    remedy: str
    detail: str


class RecordingAnswer(BaseModel):
    """A stored recording: its SHA-256, its name, and what `tune inspect` says of it."""

    model_config = ConfigDict(from_attributes=True)

    id: str = Field(validation_alias="sha256")
    name: str
    inspection: dict[str, JsonValue]


class Links(BaseModel):
    """Where more of a job is found."""

    self: str
    events: str
    cancel: str
    retry: str
    page: str
    files: dict[str, str] = Field(default_factory=dict)


class Accepted(BaseModel):
    """A job that was submitted."""

    id: str
    state: State
    links: Links


class JobAnswer(BaseModel):
    """A job; ``rmse`` in m, times as ISO 8601, ``exit_status`` as of the local command.

    ``usability`` says whether the result of a job that is done can be used.
    """

    model_config = ConfigDict(from_attributes=True)

    id: str
    name: str
    vehicle: str
    state: State
    stage: str | None
    iteration: int | None
    rmse: float | None
    seconds_left: float | None
    submitted: Moment
    started: Moment | None
    ended: Moment | None
    error: Annotated[str | None, AfterValidator(lambda text: text and over_http(text))]
    exit_status: int | None
    usability: Usability | None
    files: Annotated[
        list[str],
        BeforeValidator(lambda files: [f.name if isinstance(f, FileRow) else f for f in files]),
    ]


class FlightAnswer(BaseModel):
    """A recording of a job."""

    model_config = ConfigDict(from_attributes=True)

    id: str = Field(validation_alias="sha256")
    name: str
    holdout: bool


class FullJobAnswer(JobAnswer):
    """A job with its flights, what it said, and links."""

    flights: list[FlightAnswer]
    log: list[str]
    links: Links


class JobPage(BaseModel):
    """Jobs, the newest first; ``next`` is the ``after`` of the next page, null on the last."""

    jobs: list[JobAnswer]
    next: str | None


class HistoryPoint(BaseModel):
    """A coefficient as one job found it, with the flights behind it; times as ISO 8601.

    ``mass``, kg, is the job's own; what goes with the mass is at that of `History`.
    """

    job: str
    name: str
    flown: str | None
    ended: str | None
    mass: float | None
    best: float
    std_error: float | None
    ci95: tuple[float, float] | None
    identifiable: bool | None
    flights: list[str]


class CoefficientHistory(BaseModel):
    """A coefficient over the jobs of a vehicle, in the order in which they were flown."""

    unit: str
    points: list[HistoryPoint]


class History(BaseModel):
    """All coefficients of a vehicle; what goes with the mass is at ``mass``, kg, the last job's."""

    vehicle: str
    mass: float | None
    coefficients: dict[str, CoefficientHistory]


class Health(BaseModel):
    """The health of the server's parts."""

    status: str
    database: str
    uploads: str
    workers: str
    version: str


def links(row: JobRow, files: Sequence[str] = ()) -> Links:
    """Return the addresses of a job."""
    at = f"{API}/jobs/{row.id}"
    return Links(
        self=at,
        events=f"{at}/events",
        cancel=f"{at}/cancel",
        retry=f"{at}/retry",
        page=f"/jobs/{row.id}",
        files={name: f"{at}/files/{name}" for name in files},
    )


def accepted(row: JobRow) -> Accepted:
    """Return a job as the answer to its submission."""
    return Accepted(id=row.id, state=State(row.state), links=links(row))


def full_job(row: JobRow, events: Sequence[EventRow]) -> FullJobAnswer:
    """Return a job with its messages."""
    answer = JobAnswer.model_validate(row)
    return FullJobAnswer(
        **dict(answer),
        flights=[FlightAnswer.model_validate(flight) for flight in row.flights],
        log=[over_http(str(e.content["text"])) for e in events if e.kind == "message"],
        links=links(row, answer.files),
    )
