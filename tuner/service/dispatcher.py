"""The dispatcher: it claims jobs and starts an attempt at each, here or on a machine of a cluster.

Such a machine gets a job's files from the store and puts what comes of it there, checkpoints too,
so that any other machine can go on; its folder lasts for as long as it works.
"""

from __future__ import annotations

import logging
import os
import queue
import shutil
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from tuner.core.content_store import ContentStore
from tuner.core.disk import inside
from tuner.core.errors import EngineError, InputError
from tuner.core.runtime import cores
from tuner.engine.engine import Engine
from tuner.engine.engine import Report as Channel
from tuner.result import CHECKPOINTS
from tuner.service.attempt import (
    POLL_INTERVAL_S,
    DiedError,
    Events,
    Report,
    UnwantedError,
    attempt,
    put,
)
from tuner.service.errors import NoSpaceError, UnavailableError
from tuner.service.queue import Claim, Outcome, Queue
from tuner.service.settings import Limits, ServiceSettings
from tuner.service.tables import State
from tuner.service.worker import RESULT_FOLDER

RemoteTask = tuple[Claim, str, Limits]
"""The task of a machine of the cluster: the claim on a job, the store's URL, and its limits."""


def fit_remotely(task: RemoteTask, report: Channel) -> Outcome:
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

        def relay(events: Events, progress: Mapping[str, Any]) -> bool:
            for file in (folder / RESULT_FOLDER).glob(CHECKPOINTS):
                kept[file.name] = put(file, store)
            report({"events": list(events), "progress": dict(progress), "checkpoint": dict(kept)})
            return True

        return attempt(folder, claim, store, limits=limits, report=relay)


def run_remotely(
    task: RemoteTask, engine: Engine, report: Report, is_unwanted: Callable[[], bool]
) -> Outcome:
    """Fit a job on a machine of a cluster, and return its outcome.

    Raises
    ------
    UnwantedError
        The attempt holds its job no more, or the server is ending; the machine stops working.
    DiedError
        The process of the job died, or the machine did.
    """
    heard: SimpleQueue[dict[str, Any]] = SimpleQueue()
    future = engine.submit(fit_remotely, task, heard.put)
    try:
        while True:
            has_ended = wait([future], timeout=POLL_INTERVAL_S).done
            events, progress = _all(heard)
            if is_unwanted() or not report(events, progress):
                raise UnwantedError
            if has_ended:
                return future.result()
    except EngineError as error:
        raise DiedError(f"{error.where} {error.what}") from None
    finally:
        future.cancel()


def _all(heard: SimpleQueue[dict[str, Any]]) -> tuple[Events, dict[str, Any]]:
    """Return the messages since the last call."""
    events: list[tuple[str, Mapping[str, Any]]] = []
    progress: dict[str, Any] = {}
    while True:
        try:
            message = heard.get_nowait()
        except Empty:
            return events, progress
        events += [(kind, content) for kind, content in message["events"]]
        progress |= {**message["progress"], "checkpoint": message["checkpoint"]}


logger = logging.getLogger(__name__)


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
        jobs: Queue,
        store: ContentStore,
        engine: Engine | None = None,
    ) -> None:
        self._engine = engine
        self._settings = settings
        self._jobs = jobs
        self._store = store
        self._stopping = threading.Event()
        self._called = threading.Event()
        self._slots: queue.SimpleQueue[int] = queue.SimpleQueue()
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
            self._jobs.report(claim, (), {})

    def _work(self, claim: Claim, slot: int) -> None:
        try:
            self._attempt(claim, slot)
        except Exception as error:
            logger.exception("job %s", claim.id)
            what = f"internal error ({type(error).__name__}); please report it"
            self._commit(claim, Outcome(State.FAILED, what, exit_status=1))
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
            outcome = Outcome(State.FAILED, f"{error}; then retry the job", exit_status=2)
        except (InputError, OSError) as error:
            outcome = Outcome(State.FAILED, str(error), exit_status=2)
        if self._commit(claim, outcome) and outcome.state == State.DONE:
            shutil.rmtree(folder, ignore_errors=True)

    def _worked_on(self, claim: Claim, slot: int, folder: Path) -> Outcome:
        """Return the outcome of an attempt, on this machine or another."""
        limits, lease = self._settings.limits, self._settings.lease_seconds
        report = Reporter(self._jobs, claim, lease)
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
        self._commit(claim, Outcome(State.FAILED, f"{what}; {remedy}", exit_status=1))

    def _put_back(self, claim: Claim, message: str, *, died: bool = False) -> None:
        """Put a job back; where the table cannot be reached, its lease will run out instead."""
        try:
            self._jobs.give_back(claim, message=message, died=died)
        except UnavailableError as error:
            logger.warning("job %s: %s", claim.id, error)

    def _commit(self, claim: Claim, outcome: Outcome) -> bool:
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


class Reporter:
    """Enters the messages of a worker, and renews the lease now and then without any.

    Events are kept for the next time while the database does not answer. Messages of earlier
    attempts before their search began are not repeated before this one's.
    """

    def __init__(self, jobs: Queue, claim: Claim, lease: float) -> None:
        self._jobs = jobs
        self._claim = claim
        self._pause = min(1.0, lease / 4)
        self._last = 0.0
        self._events: list[tuple[str, Mapping[str, Any]]] = []
        self._progress: dict[str, Any] = {}
        self._repeated = Counter(claim.preamble)

    def __call__(self, events: Events, progress: Mapping[str, Any]) -> bool:
        """Enter events and progress, and return whether the attempt still holds its job."""
        self._events.extend(event for event in events if self._is_new(*event))
        self._progress.update(progress)
        now = time.monotonic()
        if not self._events and now - self._last < self._pause:
            return True
        try:
            held = self._jobs.report(self._claim, self._events, self._progress)
        except UnavailableError as error:
            logger.warning("job %s: %s", self._claim.id, error)
            return True
        self._last, self._events, self._progress = now, [], {}
        return held

    def _is_new(self, kind: str, content: Mapping[str, Any]) -> bool:
        """Return whether an event is none that repeats the preamble of an earlier attempt."""
        if kind == "iteration":
            self._repeated.clear()
        if kind != "message" or not self._repeated[content["text"]]:
            return True
        self._repeated[content["text"]] -= 1
        return False
