"""The interface of an engine: tasks in, results out, in order, wherever they are computed.

A task is a module's function and one argument that can be pickled; it gives the same result
wherever and however often it is computed, so that an engine may compute it again after losing a
worker. While it works it may report, see `Report`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")

Report = Callable[[Any], None]
"""Takes what a task has to say while it works: dicts, lists, strings and numbers, as in JSON."""
Task = Callable[[T, Report], R]


def _ignore(*_: object) -> None:
    pass


class Engine(ABC):
    """Computes tasks.

    Attributes
    ----------
    at_once
        How many tasks are computed side by side.
    ahead
        How many results `stream` has computed before they are asked for.
    """

    at_once: int
    ahead: int

    @abstractmethod
    def submit(self, function: Task[T, R], task: T, on_report: Report = _ignore) -> Future[R]:
        """Have a task computed.

        Parameters
        ----------
        function
            Of a module, so that other processes find it by its name.
        task
            Its first argument; the second is where it reports.
        on_report
            Called with every report, possibly from another thread.

        Returns
        -------
        Future
            Its result or its error; to cancel it ends the task at its next report.
        """

    @abstractmethod
    def share(self, value: T) -> Callable[[], T]:
        """Return what gives tasks a value that many of them need: it travels once a process."""

    def map(
        self,
        function: Task[T, R],
        tasks: Sequence[T],
        on_report: Callable[[int, Any], None] = _ignore,
    ) -> list[R]:
        """Return the results of tasks in their order; whatever goes wrong ends the others.

        Parameters
        ----------
        on_report
            Called with the number of a task and its report.
        """
        futures: list[Future[R]] = []
        try:
            for number, task in enumerate(tasks):
                futures.append(self.submit(function, task, partial(on_report, number)))
            return [future.result() for future in futures]
        except BaseException:
            for future in futures:
                future.cancel()
            raise

    def stream(self, function: Task[T, R], tasks: Iterable[T]) -> Iterator[R]:
        """Yield the results of tasks in their order, no more of them at a time than needed."""
        waiting: deque[Future[R]] = deque()
        try:
            for task in tasks:
                waiting.append(self.submit(function, task))
                if len(waiting) > self.ahead:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


class Here(Engine):
    """Computes each task when it is submitted, in this process."""

    at_once = 1
    ahead = 0

    def submit(self, function: Task[T, R], task: T, on_report: Report = _ignore) -> Future[R]:
        """Compute a task; its error is raised at once."""
        future: Future[R] = Future()
        future.set_result(function(task, on_report))
        return future

    def share(self, value: T) -> Callable[[], T]:
        """Return what returns the value itself."""
        return lambda: value


HERE = Here()
_CURRENT: ContextVar[Engine] = ContextVar("ENGINE", default=HERE)


def current() -> Engine:
    """Return the engine in force: this process, unless `using` says otherwise."""
    return _CURRENT.get()


@contextmanager
def using(engine: Engine) -> Iterator[Engine]:
    """Have an engine compute what is asked for inside."""
    token = _CURRENT.set(engine)
    try:
        yield engine
    finally:
        _CURRENT.reset(token)
