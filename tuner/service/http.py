"""The calls under ``/api/v1``, ``/healthz`` and ``/metrics``, a job's events and its files."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import Annotated, Any

import anyio
import anyio.to_thread
from fastapi import APIRouter, Depends, Header, Query, Request, Response
from fastapi.responses import JSONResponse, StreamingResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent
from starlette.requests import ClientDisconnect

from tuner.core.content_store import ContentStore
from tuner.core.disk import file_name
from tuner.core.errors import InputError
from tuner.core.runtime import installed
from tuner.service import jobs, recordings
from tuner.service.database import FINISHED, EventRow, FileRow, JobRow, RecordingRow, State
from tuner.service.dispatcher import POLL_INTERVAL_S
from tuner.service.errors import (
    NotKnownError,
    ServiceError,
    TooManyError,
    UnavailableError,
    over_http,
)
from tuner.service.jobs import history
from tuner.service.recordings import FORM_FIELD, Upload, receive
from tuner.service.request import JobRequest
from tuner.service.safety import REPORT_POLICY
from tuner.service.service import Service
from tuner.service.shapes import (
    API,
    Accepted,
    FullJobAnswer,
    Health,
    History,
    JobAnswer,
    JobPage,
    Problem,
    RecordingAnswer,
    accepted,
    full_job,
)


def _poll(service: Service, job: str, after: int) -> tuple[JobRow, Sequence[EventRow]]:
    row = jobs.job(service.database, job)
    return row, jobs.events(service.database, row, after=after)


BLOCK_BYTES = 1 << 20
"""bytes that are read at a time"""
_KINDS = {".json": "application/json", ".csv": "text/csv", ".svg": "image/svg+xml"}


def zip_stream(store: ContentStore, files: Sequence[FileRow], folder: str) -> Iterator[bytes]:
    """Yield an archive of stored files, in a folder of a name, under plain names.

    Parameters
    ----------
    folder
        What the archive unpacks to: a plain name.
    """
    with tempfile.TemporaryFile() as whole:
        with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
            for file in files:
                parts = [file_name(part) for part in PurePosixPath(file.name).parts]
                entry = zipfile.ZipInfo("/".join([folder, *parts]))
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.external_attr = 0o644 << 16
                with (
                    store.reading(file.sha256) as stream,
                    archive.open(entry, "w", force_zip64=file.size > 2**31 - 1) as target,
                ):
                    shutil.copyfileobj(stream, target, BLOCK_BYTES)
        whole.seek(0)
        while block := whole.read(BLOCK_BYTES):
            yield block


def _require_stored(store: ContentStore, *files: FileRow) -> None:
    for file in files:
        if not store.has(file.sha256):
            raise NotKnownError(file.name, "is gone from the store", "submit the job again")


def file_response(store: ContentStore, row: FileRow) -> StreamingResponse:
    """Return a stored file; a report as a page that reaches nothing, the rest to be saved."""
    suffix, base = row.name[row.name.rfind(".") :], row.name.rpartition("/")[2]
    headers = {
        "content-length": str(row.size),
        "content-security-policy": REPORT_POLICY,
        "etag": f'"{row.sha256}"',
    }
    if suffix == ".html":
        kind = "text/html; charset=utf-8"
    else:
        kind = _KINDS.get(suffix, "application/octet-stream")
        headers["content-disposition"] = f'attachment; filename="{file_name(base)}"'
    _require_stored(store, row)

    async def blocks() -> AsyncIterator[bytes]:
        with store.reading(row.sha256) as file:
            read: Callable[[int], bytes] = file.read
            while block := await anyio.to_thread.run_sync(read, BLOCK_BYTES):
                yield block

    return StreamingResponse(blocks(), media_type=kind, headers=headers)


#: What any call may answer beside what it is for.
PROBLEMS: Mapping[int | str, dict[str, Any]] = {
    status: {"model": Problem, "description": what}
    for status, what in {
        400: "The request cannot be understood.",
        401: "The request shows no token of this server.",
        403: "The request comes from another site, or names another host.",
        413: "The request is too large.",
        422: "The input is wrong; the answer says where, what, and what to do.",
        429: "Too many requests, uploads or jobs.",
        503: "The database cannot be reached, or is locked.",
        507: "The disk is full.",
    }.items()
}
NOT_FOUND: dict[int | str, dict[str, Any]] = {
    404: {"model": Problem, "description": "There is no such thing."}
}
CONFLICT: dict[int | str, dict[str, Any]] = {
    409: {"model": Problem, "description": "The state of the job does not allow it."}
}
_FORM = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": [FORM_FIELD],
                    "properties": {FORM_FIELD: {"type": "string", "format": "binary"}},
                }
            }
        },
    }
}

api = APIRouter(prefix=API, responses=dict(PROBLEMS), tags=["tuning"])
watching = APIRouter(tags=["watching"])


def service_of(request: Request) -> Service:
    """Return the service that a request is for."""
    service: Service = request.app.state.service
    return service


ServiceOfApp = Annotated[Service, Depends(service_of)]


def job_of(service: ServiceOfApp, job: str) -> JobRow:
    """Return the job that a request is about, with its flights and files."""
    return jobs.job(service.database, job)


JobOfPath = Annotated[JobRow, Depends(job_of)]


async def upload(request: Request) -> tuple[RecordingRow, bool]:
    """Take in the recording of a request, and return its row and whether it is new.

    Raises
    ------
    InputError
        It cannot be taken; one line says why.
    """
    service = service_of(request)
    try:
        service.uploads.acquire_nowait()
    except anyio.WouldBlock:
        raise TooManyError(
            "the server", "is receiving too many recordings", "try again in a minute"
        ) from None
    try:
        parts = (service.database, service.store, service.settings)
        await anyio.to_thread.run_sync(recordings.check_space, *parts)
        whole = await _received(request)
        service.metrics.uploaded.inc(whole.size)
        async with service.inspections:
            return await anyio.to_thread.run_sync(recordings.store_recording, *parts, whole)
    finally:
        service.uploads.release()


async def _received(request: Request) -> Upload:
    settings = service_of(request).settings
    kind = request.headers.get("content-type", "")
    try:
        return await receive(request.stream(), kind, settings.incoming, settings.limits.free_bytes)
    except ClientDisconnect:
        raise InputError("upload", "was cut off", "upload the recording again") from None


@api.post(
    "/recordings",
    status_code=201,
    openapi_extra=_FORM,
    responses={200: {"model": RecordingAnswer, "description": "It is stored already."}},
)
async def post_recording(request: Request, response: Response) -> RecordingAnswer:
    """Store a recording and say what it holds; the same content is stored once."""
    row, is_new = await upload(request)
    response.status_code = 201 if is_new else 200
    return RecordingAnswer.model_validate(row)


@api.get("/recordings/{recording}", responses=NOT_FOUND)
def get_recording(service: ServiceOfApp, recording: str) -> RecordingAnswer:
    """Return a stored recording, so that it need not be sent again."""
    return RecordingAnswer.model_validate(recordings.recording(service.database, recording))


@api.post("/jobs", status_code=202)
def post_job(
    service: ServiceOfApp,
    request: JobRequest,
    response: Response,
    idempotency_key: Annotated[str | None, Header(max_length=200, pattern="^[!-~]+$")] = None,
) -> Accepted:
    """Submit a job; the same request with the same ``Idempotency-Key`` is the same job."""
    row, is_new = jobs.submit(
        service.database, request, service.settings.limits, submission=idempotency_key
    )
    if not is_new:
        response.headers["idempotent-replayed"] = "true"
    service.dispatcher.call()
    return accepted(row)


@api.get("/jobs", responses=NOT_FOUND)
def get_jobs(
    service: ServiceOfApp,
    vehicle: Annotated[str | None, Query(max_length=200)] = None,
    state: State | None = None,
    after: Annotated[str | None, Query(max_length=64)] = None,
) -> JobPage:
    """Return a page of jobs, the newest first."""
    rows, following = jobs.page(service.database, vehicle=vehicle, state=state, after=after)
    return JobPage(jobs=[JobAnswer.model_validate(row) for row in rows], next=following)


@api.get("/jobs/{job}", responses=NOT_FOUND)
def get_job(service: ServiceOfApp, row: JobOfPath) -> FullJobAnswer:
    """Return a job, with what it said."""
    return full_job(row, jobs.events(service.database, row, kind="message"))


class _EventStream(EventSourceResponse):
    """Events in a description whose refusals are JSON, as everywhere."""

    media_type = None  # type: ignore[assignment]  # JSON then


@api.get("/jobs/{job}/events", response_class=_EventStream, responses=NOT_FOUND)
async def get_events(
    service: ServiceOfApp,
    row: JobOfPath,
    after: Annotated[int, Query(ge=0, le=2**31 - 1)] = 0,
    last_event_id: Annotated[str | None, Header(max_length=20)] = None,
) -> AsyncIterator[ServerSentEvent]:
    """Send a job's events after one of them as they happen, and the job whenever it changes.

    ``message``, ``iteration``, ``estimates``, ``folds`` and ``state`` are what happened, with their
    numbers as ids; ``job`` is the job as it stands. They end with the job.
    """
    if last_event_id is not None and last_event_id.isdecimal():
        after = min(int(last_event_id), 2**31 - 1)
    shown = None
    while not service.stopping.is_set():
        try:
            row, new = await anyio.to_thread.run_sync(_poll, service, row.id, after)
        except ServiceError as error:
            yield ServerSentEvent(event="problem", data={"detail": str(error)})
            return
        for event in new:
            content = dict(event.content)
            if event.kind == "message":
                content["text"] = over_http(str(content["text"]))
            yield ServerSentEvent(event=event.kind, data=content, id=str(event.number))
            after = event.number
        answer = JobAnswer.model_validate(row)
        if answer != shown:
            yield ServerSentEvent(event="job", data=answer)
            shown = answer
        if row.state in FINISHED and not new:
            return
        if not new:
            await anyio.sleep(POLL_INTERVAL_S)


@api.post("/jobs/{job}/cancel", responses={**NOT_FOUND, **CONFLICT})
def cancel_job(service: ServiceOfApp, job: str) -> FullJobAnswer:
    """Let a job end without a result; what its search has found so far is kept for a retry."""
    return _after(service, jobs.cancel(service.database, job))


@api.post("/jobs/{job}/retry", responses={**NOT_FOUND, **CONFLICT})
def retry_job(service: ServiceOfApp, job: str) -> FullJobAnswer:
    """Put a job that failed or was cancelled back into the queue; its search goes on."""
    return _after(service, jobs.retry(service.database, job))


def _after(service: Service, row: JobRow) -> FullJobAnswer:
    service.dispatcher.call()
    return get_job(service, row)


@api.get(
    "/jobs/{job}/files/{name:path}",
    response_class=StreamingResponse,
    responses={
        200: {"content": {"application/octet-stream": {"schema": {"type": "string"}}}},
        **NOT_FOUND,
    },
)
def get_file(service: ServiceOfApp, row: JobOfPath, name: str) -> StreamingResponse:
    """Return a file of a job's result."""
    file = next((file for file in row.files if file.name == name), None)
    if file is None:
        remedy = "wait until the job is done, and see its list of files"
        raise NotKnownError(f"job {row.id}", "has no such file", remedy)
    return file_response(service.store, file)


@api.get(
    "/jobs/{job}/files.zip",
    response_class=StreamingResponse,
    responses={200: {"content": {"application/zip": {"schema": {"type": "string"}}}}, **NOT_FOUND},
)
def get_files(service: ServiceOfApp, row: JobOfPath) -> StreamingResponse:
    """Return all files of a job's result as one archive."""
    if not row.files:
        raise NotKnownError(f"job {row.id}", "has no files", "wait until the job is done")
    _require_stored(service.store, *row.files)
    headers = {"content-disposition": f'attachment; filename="{row.id}.zip"'}
    blocks = zip_stream(service.store, row.files, row.id)
    return StreamingResponse(blocks, media_type="application/zip", headers=headers)


@api.get("/vehicles/{name:path}/history", responses=NOT_FOUND)
def get_history(service: ServiceOfApp, name: str) -> History:
    """Return each coefficient over a vehicle's jobs, with intervals."""
    return history(service.database, name)


@watching.get("/healthz", responses={503: {"model": Health}})
def healthz(service: ServiceOfApp) -> Response:
    """Say whether the server does its work."""
    database = uploads = "ok"
    try:
        recordings.check_space(service.database, service.store, service.settings)
    except UnavailableError as error:
        database = uploads = error.what
    except ServiceError as error:
        uploads = error.what
    workers = "ok" if service.dispatcher.is_alive else "stopped"
    is_well = database == uploads == workers == "ok"
    answer = Health(
        status="ok" if is_well else "failing",
        database=database,
        uploads=uploads,
        workers=workers,
        version=installed(),
    )
    return JSONResponse(answer.model_dump(), status_code=200 if is_well else 503)


@watching.get(
    "/metrics",
    response_class=Response,
    responses={
        200: {"content": {"text/plain": {"schema": {"type": "string"}}}},
        **{status: PROBLEMS[status] for status in (401, 403, 429)},
    },
)
def metrics(service: ServiceOfApp) -> Response:
    """Return counters for Prometheus."""
    return Response(service.metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")
