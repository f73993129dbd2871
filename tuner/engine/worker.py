"""The worker's side of the Dask engine: set-up of cores, reports of tasks, shared values."""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from distributed import Event, Status, Worker, WorkerPlugin, get_worker

from tuner.core.content_store import ContentStore
from tuner.core.errors import EngineError
from tuner.core.runtime import configure, use_one_thread_for_algebra
from tuner.engine.engine import HERE, using


class Stopped(Exception):  # noqa: N818 (no error: it was asked for)
    """Whoever asked for a task wants it no longer."""


@dataclass(frozen=True)
class SetUp(WorkerPlugin):  # type: ignore[misc]
    """What a worker does before its first task; a plugin of Dask's.

    Attributes
    ----------
    pool, cores
        Numbers of the processor cores that workers on this machine share out, and how many each
        takes; an empty pool leaves workers where their starter put them.
    gpus
        Of this machine.
    """

    pool: tuple[int, ...] = ()
    cores: int = 1
    gpus: int = 0
    name: str = "tune"

    def setup(self, worker: Worker) -> None:
        """Set a worker up."""
        if self.pool:
            first = self.cores * int(worker.name)
            pin({self.pool[(first + i) % len(self.pool)] for i in range(self.cores)})
        if self.gpus:
            os.environ["CUDA_VISIBLE_DEVICES"] = str(int(worker.name) % self.gpus)
        use_one_thread_for_algebra()
        configure()


def pin(cores: Collection[int]) -> None:
    """Keep all threads of this process, those to come too, on some cores."""
    if not hasattr(os, "sched_setaffinity"):
        return
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it ended meanwhile
            os.sched_setaffinity(int(thread.name), cores)


def run_task(content: bytes, identity: str, topic: str) -> Any:
    """Compute a task in a worker, its reports and log lines sent where it was asked for.

    Parameters
    ----------
    content
        Function and argument, pickled.
    identity, topic
        Of the task and its reports.

    Raises
    ------
    Stopped
        It was cancelled, or the worker is ending: noticed when it reports.
    EngineError
        This worker cannot compute it.
    """
    worker, stop = get_worker(), Event(stop_name(identity))
    try:
        function, task = pickle.loads(content)
    except (ImportError, AttributeError) as error:
        raise EngineError(
            "workers",
            f"do not know this program's task ({error})",
            "install multirotor-tune[cluster] there, the same version as here",
        ) from None

    def report(message: Any) -> None:
        # to ask a cluster that is ending would connect anew, and leave that open
        if worker.status in (Status.closing, Status.closed) or stop.is_set():
            raise Stopped
        worker.log_event(topic, {"task": identity, "report": message})

    def log(name: str, level: int, line: str) -> None:
        worker.log_event(topic, {"task": identity, "log": [name, level, line]})

    with using(HERE), _logging_to(log):
        return function(task, report)


def stop_name(identity: str) -> str:
    """Return the name of the event that ends a task."""
    return f"stop-{identity}"


class _Lines(logging.Handler):
    """Sends log records somewhere."""

    def __init__(self, send: Callable[[str, int, str], None]) -> None:
        super().__init__(logging.INFO)
        self._send = send

    def emit(self, record: logging.LogRecord) -> None:
        self._send(record.name, record.levelno, record.getMessage())


@contextlib.contextmanager
def _logging_to(send: Callable[[str, int, str], None]) -> Iterator[None]:
    logger, handler = logging.getLogger("tuner"), _Lines(send)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


@dataclass(frozen=True)
class Shared:
    """A value that lies in a store, by its content.

    Only this program's own processes write such values, and the digest comes with the task, over
    Dask's channel: what a stranger puts into the store is never unpickled.
    """

    store: str
    sha256: str

    def __call__(self) -> Any:
        """Return the value."""
        return _arrived(self.store, self.sha256)


@lru_cache(maxsize=2)
def _arrived(store: str, sha256: str) -> Any:
    return pickle.loads(ContentStore(store).read(sha256))
