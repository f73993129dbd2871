"""The dispatcher: it claims jobs and starts an attempt at each, here or on a machine of a cluster.

Such a machine gets a job's files from the store and puts what comes of it there, checkpoints too,
so that any other machine can go on; its folder lasts for as long as it works.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import suppress
from pathlib import Path
from queue import Queue, SimpleQueue
from typing import IO, Any, TypeVar

from pydantic import ValidationError

from tuner.core.content_store import ContentStore
from tuner.core.disk import digest_of, inside
from tuner.core.errors import EngineError, InputError
from tuner.core.runtime import cores
from tuner.engine.engine import Engine
from tuner.engine.engine import Report as Channel
from tuner.report.outcome import outcome
from tuner.result import CHECKPOINTS, ExportRecords, RunResult
from tuner.service.database import State
from tuner.service.errors import NoSpaceError, UnavailableError, full_disk
from tuner.service.jobs import AttemptOutcome, Claim, JobQueue
from tuner.service.request import FLIGHTS, CheckedRequest
from tuner.service.settings import ServiceLimits, ServiceSettings
from tuner.service.worker import RESULT_FOLDER, Assignment

logger = logging.getLogger(__name__)
SAID_AGAIN_AFTER_S = 600.0


class _OnceInAWhile(logging.Filter):
    """Lets no line through that was written a while ago: a full disk is met every second."""

    def __init__(self) -> None:
        super().__init__()
        self._written: dict[str, float] = {}

    def filter(self, record: logging.LogRecord) -> bool:
        now, line = time.monotonic(), record.getMessage()
        self._written = {
            other: then for other, then in self._written.items() if now - then < SAID_AGAIN_AFTER_S
        }
        return self._written.setdefault(line, now) == now


logger.addFilter(_OnceInAWhile())
T = TypeVar("T")

WORKER = [sys.executable, "-m", "tuner.service.worker"]
POLL_INTERVAL_S = 0.5
"""Between two looks into the job table."""
MAX_LINE_BYTES = 1_000_000

EVENT_KINDS = ("message", "iteration", "estimates", "folds")
"""What a worker says while it fits;"""
END_KINDS = ("done", "refused", "fault")
"""and at its end."""

Events = Sequence[tuple[str, Mapping[str, Any]]]
EventReport = Callable[[Events], bool]


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
    limits: ServiceLimits,
    report: EventReport,
    cores: Sequence[int] = (),
    is_unwanted: Callable[[], bool] = lambda: False,
) -> AttemptOutcome:
    """Run the worker's process to its end, store its files, and return the outcome.

    Parameters
    ----------
    folder, claim, store
        Of the job, and where its recordings are and its result goes.
    report
        Called with new events, at least every `POLL_INTERVAL_S`; returns whether the attempt still
        holds its job.

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
    last: Future[dict[str, Any] | None] = Future()
    heard: Queue[Events] = Queue(maxsize=10_000)
    stream, deadline = process.stdout, time.monotonic() + limits.job_seconds
    reader = threading.Thread(target=lambda: last.set_result(_listen(stream, heard)), daemon=True)
    reader.start()

    def report_in_time(events: Events) -> bool:
        if time.monotonic() > deadline and not last.done():
            raise DiedError("it took longer than the service allows")
        return report(events)

    try:
        with suppress(BrokenPipeError):
            process.stdin.write(assignment.model_dump_json().encode() + b"\n")
            process.stdin.flush()
        end = _follow(last, heard, report_in_time, is_unwanted)
        process.wait(timeout=60)
    except subprocess.TimeoutExpired:
        raise DiedError("it did not end") from None
    finally:
        _kill(process)
        with suppress(BrokenPipeError):  # of one that died before it read
            process.stdin.close()
        reader.join(timeout=5)
        process.stdout.close()
    if end is None:
        raise DiedError(_cause_of_death(process.returncode))
    return _outcome(end, folder, store)


def _listen(stream: IO[bytes], heard: Queue[Events]) -> dict[str, Any] | None:
    """Pass a worker's events on, and return its last message; None where it has said none."""
    while line := stream.readline(MAX_LINE_BYTES):
        message = _message(line)
        kind = message.get("kind")
        if kind in END_KINDS:
            return message
        if kind in EVENT_KINDS:
            heard.put([(kind, {key: value for key, value in message.items() if key != "kind"})])
    return None


def _follow(
    ended: Future[T], heard: Queue[Events], report: EventReport, is_unwanted: Callable[[], bool]
) -> T:
    """Report events as they are heard until an attempt has ended, and return how."""
    while True:
        has_ended = wait([ended], timeout=POLL_INTERVAL_S).done
        events = [event for _ in range(heard.qsize()) for event in heard.get()]
        if is_unwanted() or not report(events):
            raise UnwantedError
        if has_ended:
            return ended.result()


def _message(line: bytes) -> dict[str, Any]:
    try:
        content = json.loads(line)
    except ValueError:
        return {}
    return content if isinstance(content, dict) else {}


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


def _outcome(last: Mapping[str, Any], folder: Path, store: ContentStore) -> AttemptOutcome:
    """Return the outcome of an attempt, after storing the result's files."""
    if last["kind"] == "refused":
        return AttemptOutcome(State.FAILED, error=str(last["error"]), exit_status=2)
    if last["kind"] == "fault":
        error = f"internal error ({last['error']}); please report it"
        return AttemptOutcome(State.FAILED, error=error, exit_status=1)
    result = RunResult.read(folder / RESULT_FOLDER)
    exports = ExportRecords.read_if_any(folder / RESULT_FOLDER) or ExportRecords()
    return AttemptOutcome(
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


RemoteTask = tuple[Claim, str, ServiceLimits]
"""The task of a machine of the cluster: the claim on a job, the store's URL, and its limits."""


def fit_remotely(task: RemoteTask, report: Channel) -> AttemptOutcome:
    """Work on a job, on the machine that an engine has chosen for it.

    Raises
    ------
    DiedError
        Its process died.
    """
    claim, url, limits = task
    store = ContentStore(url)
    kept = dict(claim.checkpoint)
    with tempfile.TemporaryDirectory(prefix="tune-job-") as name:
        folder = Path(name)
        (folder / RESULT_FOLDER).mkdir()
        for file, digest in kept.items():
            store.fetch(digest, inside(folder / RESULT_FOLDER, file))

        def relay(events: Events) -> bool:
            before = dict(kept)
            for file in (folder / RESULT_FOLDER).glob(CHECKPOINTS):
                kept[file.name] = put(file, store)
            report([*events, *([] if kept == before else [("checkpoint", dict(kept))])])
            return True

        return attempt(folder, claim, store, limits=limits, report=relay)


def run_remotely(
    task: RemoteTask, engine: Engine, report: EventReport, is_unwanted: Callable[[], bool]
) -> AttemptOutcome:
    """Fit a job on a machine of a cluster, and return its outcome.

    Raises
    ------
    UnwantedError
        The attempt holds its job no more, or the server is ending; the machine stops working.
    DiedError
        The process of the job died, or the machine did.
    """
    heard: Queue[Events] = Queue()
    future = engine.submit(fit_remotely, task, heard.put)
    try:
        return _follow(future, heard, report, is_unwanted)
    except EngineError as error:
        raise DiedError(f"{error.where} {error.what}") from None
    finally:
        future.cancel()


class Dispatcher:
    """Claims jobs, fits each in a process of its own, and commits the outcome.

    Parameters
    ----------
    engine
        What machines of a cluster do the work; None for processes of this machine.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        jobs: JobQueue,
        store: ContentStore,
        engine: Engine | None = None,
    ) -> None:
        self._engine = engine
        self._settings = settings
        self._jobs = jobs
        self._store = store
        self._stopping = threading.Event()
        self._called = threading.Event()
        self._slots: SimpleQueue[int] = SimpleQueue()
        for slot in range(settings.workers):
            self._slots.put(slot)
        self._threads = ThreadPoolExecutor(max(1, settings.workers), "attempt")
        self._loop = threading.Thread(target=self._run, name="dispatcher", daemon=True)
        self._held: dict[str, Claim] = {}
        self.deaths = 0

    def start(self) -> None:
        """Begin to work off the table; jobs that this server held before a restart come first."""
        self._jobs.recover(own=True)
        self._loop.start()

    def call(self) -> None:
        """Say that there may be something to do."""
        self._called.set()

    def stop(self) -> None:
        """Stop all attempts, and put their jobs back into the queue."""
        self._stopping.set()
        self._called.set()
        if self._loop.is_alive():
            self._loop.join()
        self._threads.shutdown()

    @property
    def is_alive(self) -> bool:
        """Whether the dispatcher runs."""
        return self._loop.is_alive()

    def _run(self) -> None:
        looked_for_lost = 0.0
        while not self._stopping.is_set():
            try:
                if time.monotonic() - looked_for_lost > self._settings.lease_seconds / 3:
                    looked_for_lost = time.monotonic()
                    self._keep()
                    self._jobs.recover(own=False)
                while not self._slots.empty() and not self._stopping.is_set():
                    claim = self._jobs.claim()
                    if claim is None:
                        break
                    self._held[claim.word] = claim
                    self._threads.submit(self._work, claim, self._slots.get())
            except UnavailableError as error:
                logger.warning("%s", error)
                self._stopping.wait(1.0)
            except Exception:
                logger.exception("jobs cannot be taken from the table")
                self._stopping.wait(5.0)
            self._called.wait(POLL_INTERVAL_S)
            self._called.clear()

    def _keep(self) -> None:
        """Renew the leases of jobs under way: a result may take long to be stored."""
        for claim in tuple(self._held.values()):
            self._jobs.report(claim, ())

    def _work(self, claim: Claim, slot: int) -> None:
        try:
            self._attempt(claim, slot)
        except Exception as error:
            logger.exception("job %s", claim.id)
            what = f"internal error ({type(error).__name__}); please report it"
            self._commit(claim, AttemptOutcome(State.FAILED, what, exit_status=1))
        finally:
            del self._held[claim.word]
            self._slots.put(slot)
            self._called.set()

    def _attempt(self, claim: Claim, slot: int) -> None:
        """Work on a job until it ends, dies, or is wanted no more."""
        folder = self._settings.work / claim.id
        try:
            outcome = self._worked_on(claim, slot, folder)
        except UnwantedError:
            if self._stopping.is_set():
                self._put_back(claim, "The server was stopped; the job waits for it.")
            return
        except DiedError as death:
            self._on_worker_death(claim, death)
            return
        except NoSpaceError as error:
            outcome = AttemptOutcome(State.FAILED, f"{error}; then retry the job", exit_status=2)
        except (InputError, OSError) as error:
            outcome = AttemptOutcome(State.FAILED, str(error), exit_status=2)
        if self._commit(claim, outcome) and outcome.state == State.DONE:
            shutil.rmtree(folder, ignore_errors=True)

    def _worked_on(self, claim: Claim, slot: int, folder: Path) -> AttemptOutcome:
        """Return the outcome of an attempt, on this machine or another."""
        limits, lease = self._settings.limits, self._settings.lease_seconds
        report = AttemptReporter(self._jobs, claim, lease)
        is_unwanted = self._stopping.is_set
        if self._engine is not None:
            task = claim, self._settings.store_url, limits
            return run_remotely(task, self._engine, report, is_unwanted)
        return attempt(
            folder,
            claim,
            self._store,
            limits=limits,
            cores=self._cores(slot),
            report=report,
            is_unwanted=is_unwanted,
        )

    def _on_worker_death(self, claim: Claim, death: DiedError) -> None:
        """Put the job of a worker that died back, or give it up after too many deaths."""
        self.deaths += 1
        deaths = claim.deaths + 1
        logger.warning("job %s: its worker died: %s", claim.id, death)
        if deaths < self._settings.limits.deaths:
            text = f"The worker died ({death}); the job goes on from its checkpoint."
            self._put_back(claim, text, died=True)
            return
        what = f"its worker died {deaths} times; the last time {death}"
        remedy = "look for memory and disk of the machine, then retry the job"
        self._commit(claim, AttemptOutcome(State.FAILED, f"{what}; {remedy}", exit_status=1))

    def _put_back(self, claim: Claim, message: str, *, died: bool = False) -> None:
        """Put a job back; where the table cannot be reached, its lease will run out instead."""
        try:
            self._jobs.give_back(claim, message=message, died=died)
        except UnavailableError as error:
            logger.warning("job %s: %s", claim.id, error)

    def _commit(self, claim: Claim, outcome: AttemptOutcome) -> bool:
        """Enter an outcome, however long the table cannot be reached."""
        while True:
            try:
                return self._jobs.finish(claim, outcome)
            except UnavailableError as error:
                logger.warning("job %s: %s", claim.id, error)
                if self._stopping.wait(1.0):
                    return False

    def _cores(self, slot: int) -> list[int]:
        """Return the processor cores of a slot: each has its own where there are enough."""
        if not hasattr(os, "sched_getaffinity") or self._settings.workers > cores():
            return []
        return sorted(os.sched_getaffinity(0))[slot :: self._settings.workers]


class AttemptReporter:
    """Enters the messages of a worker, and renews the lease now and then without any.

    Events are kept for the next time while the database does not answer. Messages of earlier
    attempts before their search began are not repeated before this one's.
    """

    def __init__(self, jobs: JobQueue, claim: Claim, lease: float) -> None:
        self._jobs = jobs
        self._claim = claim
        self._pause = min(1.0, lease / 4)
        self._last = 0.0
        self._events: list[tuple[str, Mapping[str, Any]]] = []
        self._repeated = Counter(claim.preamble)

    def __call__(self, events: Events) -> bool:
        """Enter events, and return whether the attempt still holds its job."""
        self._events.extend(event for event in events if self._is_new(*event))
        now = time.monotonic()
        if not self._events and now - self._last < self._pause:
            return True
        try:
            held = self._jobs.report(self._claim, self._events)
        except UnavailableError as error:
            logger.warning("job %s: %s", self._claim.id, error)
            return True
        self._last, self._events = now, []
        return held

    def _is_new(self, kind: str, content: Mapping[str, Any]) -> bool:
        """Return whether an event is none that repeats the preamble of an earlier attempt."""
        if kind == "iteration":
            self._repeated.clear()
        if kind != "message" or not self._repeated[content["text"]]:
            return True
        self._repeated[content["text"]] -= 1
        return False
