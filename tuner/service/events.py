"""A job's events as they happen, over server-sent events (WHATWG HTML, 9.2)."""

from __future__ import annotations

import json
from collections.abc import AsyncIterator, Mapping, Sequence
from typing import Any

import anyio
import anyio.to_thread

from tuner.service import jobs
from tuner.service.errors import ServiceError
from tuner.service.service import Service
from tuner.service.shapes import JobAnswer
from tuner.service.tables import EventRow, JobRow
from tuner.service.words import over_http

LOOK = 0.5
"""s between two looks into the table"""
SILENCE = 15.0
"""s after which a comment keeps the connection open"""


async def follow(service: Service, job: str, after: int) -> AsyncIterator[str]:
    """Yield the events of a job after one of them, and the job whenever it changes, to its end.

    ``message``, ``iteration``, ``estimates``, ``folds`` and ``state`` are what happened, with their
    numbers as ids; ``job`` is the job as it stands.
    """
    shown, quiet = "", 0.0
    while not service.stopping.is_set():
        try:
            row, new = await anyio.to_thread.run_sync(_look, service, job, after)
        except ServiceError as error:
            yield _event("problem", {"detail": str(error)})
            return
        for event in new:
            content = dict(event.content)
            if event.kind == "message":
                content["text"] = over_http(str(content["text"]))
            yield _event(event.kind, content, event.number)
            after = event.number
        standing = JobAnswer.model_validate(row).model_dump_json()
        if standing != shown:
            yield f"event: job\ndata: {standing}\n\n"
            shown, quiet = standing, 0.0
        if jobs.is_finished(row) and not new:
            return
        if quiet >= SILENCE:
            yield ": still here\n\n"
            quiet = 0.0
        if not new:
            await anyio.sleep(LOOK)
            quiet += LOOK


def _look(service: Service, job: str, after: int) -> tuple[JobRow, Sequence[EventRow]]:
    row = jobs.job(service.database, job)
    return row, jobs.events(service.database, row, after=after)


def _event(kind: str, content: Mapping[str, Any], number: int | None = None) -> str:
    head = "" if number is None else f"id: {number}\n"
    return f"{head}event: {kind}\ndata: {json.dumps(content)}\n\n"
