"""One attempt at a job: its folder, its process and messages, its result into the store."""

from __future__ import annotations

import json
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

from pydantic import ValidationError

from tuner.core.content_store import ContentStore
from tuner.core.disk import digest_of, inside
from tuner.core.errors import InputError
from tuner.report.outcome import outcome
from tuner.result import CHECKPOINTS, ExportRecords, RunResult
from tuner.service.errors import full_disk
from tuner.service.queue import Claim, Outcome
from tuner.service.request import FLIGHTS, CheckedRequest
from tuner.service.settings import Limits
from tuner.service.tables import State
from tuner.service.worker import RESULT_FOLDER, Assignment

WORKER = [sys.executable, "-m", "tuner.service.worker"]
POLL_INTERVAL_S = 0.5
"""Between two looks into the job table."""
MAX_LINE_BYTES = 1_000_000

Events = Sequence[tuple[str, Mapping[str, Any]]]
Report = Callable[[Events, Mapping[str, Any]], bool]


class DiedError(Exception):
    """The process of an attempt died; the message says of what."""


class UnwantedError(Exception):
    """The attempt holds its job no more, or its server is ending."""


def prepare(folder: Path, claim: Claim, store: ContentStore) -> CheckedRequest:
    """Lay out the folder of a job, as far as an earlier attempt has not.

    Raises
    ------
    InputError
        The request is of another version of tune, or the disk is full.
    """
    try:
        asked = CheckedRequest.model_validate(claim.request)
    except ValidationError:
        what = "was submitted to another version of tune"
        raise InputError("the job", what, "submit it again") from None
    with full_disk():
        shutil.rmtree(folder / FLIGHTS, ignore_errors=True)
        (folder / FLIGHTS).mkdir(parents=True)
        for name, digest in claim.flights.items():
            store.fetch(digest, inside(folder / FLIGHTS, name))
        asked.lay_out(folder)
    return asked


def attempt(
    folder: Path,
    claim: Claim,
    store: ContentStore,
    *,
    limits: Limits,
    report: Report,
    cores: Sequence[int] = (),
    is_unwanted: Callable[[], bool] = lambda: False,
) -> Outcome:
    """Run the worker's process to its end, store its files, and return the outcome.

    Parameters
    ----------
    folder, claim, store
        Of the job, and where its recordings are and its result goes.
    report
        Called with events and the job's progress, at least every `POLL_INTERVAL_S`; returns whether
        the attempt still holds its job.

    Raises
    ------
    DiedError
        The process died, or took too long.
    UnwantedError
        See there; the process has been stopped.
    NoSpaceError
        The disk is full.
    """
    asked = prepare(folder, claim, store)
    assignment = Assignment(
        job=claim.id,
        folder=folder.absolute(),
        flights=tuple(claim.flights),
        asked=asked,
        cores=tuple(cores),
        limits=limits,
    )
    with (folder / "worker.log").open("ab") as log:
        process = subprocess.Popen(
            WORKER,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=log,
            start_new_session=True,
        )
    assert process.stdin is not None
    assert process.stdout is not None
    lines: queue.Queue[bytes | None] = queue.Queue(maxsize=10_000)
    reader = threading.Thread(target=_read, args=(process.stdout, lines), daemon=True)
    reader.start()
    try:
        with suppress(BrokenPipeError):
            process.stdin.write(assignment.model_dump_json().encode() + b"\n")
            process.stdin.flush()
        last = _follow(lines, report, is_unwanted, time.monotonic() + limits.job_seconds)
        process.wait(timeout=60)
    except subprocess.TimeoutExpired:
        raise DiedError("it did not end") from None
    finally:
        _kill(process)
        with suppress(BrokenPipeError):  # of one that died before it read
            process.stdin.close()
        reader.join(timeout=5)
        process.stdout.close()
    if last is None:
        raise DiedError(_cause_of_death(process.returncode))
    return _outcome(last, folder, store)


def _read(stream: IO[bytes], lines: queue.Queue[bytes | None]) -> None:
    """Pass lines on until the stream ends."""
    while line := stream.readline(MAX_LINE_BYTES):
        lines.put(line)
    lines.put(None)


def _follow(
    lines: queue.Queue[bytes | None],
    report: Report,
    is_unwanted: Callable[[], bool],
    deadline: float,
) -> dict[str, Any] | None:
    """Report a worker's events until it ends, and return its last message."""
    while True:
        events: list[tuple[str, dict[str, Any]]] = []
        last, ended = None, False
        until = time.monotonic() + POLL_INTERVAL_S
        while (rest := until - time.monotonic()) > 0 and not ended:
            try:
                line = lines.get(timeout=rest)
            except queue.Empty:
                break
            ended = line is None
            message = _message(line)
            kind = message.pop("kind", None)
            if kind in ("message", "iteration", "estimates", "folds"):
                events.append((kind, message))
            elif kind in ("done", "refused", "fault"):
                last, ended = {"kind": kind, **message}, True
        if is_unwanted() or not report(events, _progress(events)):
            raise UnwantedError
        if ended:
            return last
        if time.monotonic() > deadline:
            raise DiedError("it took longer than the service allows")


def _message(line: bytes | None) -> dict[str, Any]:
    try:
        content = json.loads(line or b"null")
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


def _progress(events: Events) -> dict[str, Any]:
    """Return where the search stands after these events."""
    iterations = [content for kind, content in events if kind == "iteration"]
    if not iterations:
        return {}
    last = iterations[-1]
    progress = {
        "stage": last["stage"],
        "iteration": last["number"],
        "seconds_left": last["seconds_left"],
    }
    if last["position_rmse"] is not None:
        progress["rmse"] = last["position_rmse"]
    return progress


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Stop a process and those that it has started."""
    with suppress(ProcessLookupError, PermissionError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.wait()


def _cause_of_death(status: int) -> str:
    """Return why a process died, in words."""
    if status >= 0:
        return f"it ended with status {status}"
    try:
        name = signal.Signals(-status).name
    except ValueError:
        name = str(-status)
    hint = ", as when memory runs out" if -status == getattr(signal, "SIGKILL", 9) else ""
    return f"it was ended by {name}{hint}"


def _outcome(last: Mapping[str, Any], folder: Path, store: ContentStore) -> Outcome:
    """Return the outcome of an attempt, after storing the result's files."""
    if last["kind"] == "refused":
        return Outcome(State.FAILED, error=str(last["error"]), exit_status=2)
    if last["kind"] == "fault":
        error = f"internal error ({last['error']}); please report it"
        return Outcome(State.FAILED, error=error, exit_status=1)
    result = RunResult.read(folder / RESULT_FOLDER)
    exports = ExportRecords.read_if_any(folder / RESULT_FOLDER) or ExportRecords()
    return Outcome(
        State.DONE,
        exit_status=0,
        usability=outcome(result, exports=tuple(exports.exports.values())).usability,
        files=_store_files(folder / RESULT_FOLDER, store),
        points=[
            {
                "coefficient": name,
                "unit": found.unit,
                "best": found.best,
                "std_error": found.std_error,
                "lower": None if found.ci95 is None else found.ci95[0],
                "upper": None if found.ci95 is None else found.ci95[1],
                "identifiable": found.identifiable,
            }
            for name, found in result.coefficients.items()
            if found.fitted or name == "mass"  # which others are compared at
        ],
    )


def _store_files(result: Path, store: ContentStore) -> list[dict[str, Any]]:
    """Put copies of a result's files into the store, and return their rows."""
    rows = []
    for file in sorted(result.rglob("*")):
        if file.is_symlink() or not file.is_file() or file.match(CHECKPOINTS):
            continue
        name, size = file.relative_to(result).as_posix(), file.stat().st_size
        rows.append({"name": name, "sha256": put(file, store), "size": size})
    return rows


def put(file: Path, store: ContentStore) -> str:
    """Put a copy of a file into a store, and return its digest.

    Raises
    ------
    NoSpaceError
        The disk is full.
    """
    with full_disk():
        copy = file.with_name(f".{file.name}.copy")
        try:
            shutil.copyfile(file, copy)
            digest = digest_of(copy)
            store.take(copy, digest)
        finally:
            copy.unlink(missing_ok=True)
    return digest
