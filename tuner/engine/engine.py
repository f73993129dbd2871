"""The interface of an engine: tasks in, results out, in order, wherever they are computed.

A task is a module's function and one argument that can be pickled; it gives the same result
wherever and however often it is computed, so that an engine may compute it again after losing a
worker. While it works it may report, see `Report`. ``--workers`` and ``--cluster``, a cluster file,
name the engine.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, Literal, Self, TypeVar

from annotated_types import Interval
from pydantic import StringConstraints, model_validator

from tuner.core.disk import expanded
from tuner.core.errors import ConfigError
from tuner.core.runtime import extra
from tuner.core.yaml_section import Section, Whole, build, build_options, read_model, refuse

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


class InProcessEngine(Engine):
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


HERE = InProcessEngine()
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


Memory = Annotated[str, StringConstraints(pattern=r"^[0-9]+(\.[0-9]+)? ?[KMGT]i?B$")]
Address = Annotated[
    str, StringConstraints(pattern=r"^(tcp|tls|ws|wss|ucx)://[^\s/]+:[0-9]{1,5}/?$")
]
System = Literal["slurm", "pbs", "lsf", "sge"]
SCHEMES = ("tcp://", "tls://", "ws://", "wss://", "ucx://")


class Tls(Section):
    """Certificates by which workers, scheduler and client know each other; paths of PEM files."""

    ca: Path
    certificate: Path
    key: Path


class BatchSystem(Section):
    """A batch system from which `dask_jobqueue` gets workers, one a job.

    Attributes
    ----------
    system
        The batch system.
    queue, account, walltime
        As the batch system names them.
    directives
        Further lines of the job script's head, without the comment sign that begins them.
    prologue
        Commands before the worker, as ``module load python``.
    python
        The Python of the nodes that has tune installed; None takes this one.
    interface
        The network interface by which the nodes reach each other, as ``ib0``.
    scratch
        A folder of the nodes for the workers' files.
    logs
        A folder for the jobs' output.
    """

    system: System
    queue: str | None = None
    account: str | None = None
    walltime: str | None = None
    directives: tuple[str, ...] = ()
    prologue: tuple[str, ...] = ()
    python: str | None = None
    interface: str | None = None
    scratch: str | None = None
    logs: str | None = None


class Kubernetes(Section):
    """Workers that `dask_kubernetes` starts as pods; its operator runs in the cluster.

    Attributes
    ----------
    image
        Has tune with its extra ``cluster`` installed, the same versions as here.
    namespace, name
        Of the Dask cluster that is made.
    """

    image: str
    namespace: str | None = None
    name: str = "tune"


class ClusterFile(Section):
    """Where workers come from; without ``address``, ``queue`` and ``kubernetes``, this machine.

    Attributes
    ----------
    workers
        Their number.
    cores
        Processor cores of each.
    memory
        Of each, as ``2GiB``: a worker that takes more is ended and its task computed again. None
        shares the machine's out, and is possible on this machine alone.
    gpus
        Of this machine, which its workers take in turn, each one alone: for what runs through XLA,
        as a force of one's own without a kernel. Fits fly on the processor.
    address, tls
        A running scheduler; its workers bring their own cores and memory.
    jobs, kubernetes
        What starts workers.
    store
        Folder or URL that all workers reach, from which they get data by content; None takes the
        folder of what this program keeps, which must then be on a disk that all share.
    """

    workers: Annotated[Whole, Interval(ge=1, le=10_000)] = 1
    cores: Annotated[Whole, Interval(ge=1, le=1024)] = 1
    memory: Memory | None = None
    gpus: Annotated[Whole, Interval(ge=0, le=64)] = 0
    address: Address | None = None
    tls: Tls | None = None
    jobs: BatchSystem | None = None
    kubernetes: Kubernetes | None = None
    store: str | None = None

    @model_validator(mode="after")
    def _contradict_nothing(self) -> Self:
        given = [key for key in ("address", "jobs", "kubernetes") if getattr(self, key) is not None]
        if len(given) > 1:
            raise refuse(f"both '{given[0]}' and '{given[1]}' are given", "keep one of them")
        if given and given != ["address"] and self.memory is None:
            raise refuse(f"'{given[0]}' needs the memory of a worker", "add memory: 2GiB")
        if given and self.gpus:
            raise refuse("'gpus' counts those of this machine", "leave it out")
        if self.tls is not None and given != ["address"]:
            raise refuse("'tls' belongs to an address", "give address: tls://HOST:8786")
        return self


def read_cluster(reference: str) -> ClusterFile:
    """Read a cluster file; the address of a scheduler stands for a file that names it alone.

    Raises
    ------
    ConfigError
        In one line: the file, the key, its value, what it should be.
    """
    if reference.startswith(SCHEMES):
        return build(ClusterFile, {"address": reference}, "--cluster")
    path = expanded(reference)
    file = read_model(ClusterFile, path)
    if file.tls is None:
        return file
    folder = path.parent
    found = {name: folder / getattr(file.tls, name) for name in Tls.model_fields}
    return file.replace(tls=Tls(**found))


DASK = ("--workers and --cluster", "need")
"""What needs Dask, in a message."""


def cluster_for(workers: int | None, cluster: str | None) -> ClusterFile | None:
    """Return the cluster that the options name; None for this process.

    Raises
    ------
    ConfigError
        They contradict each other, or the cluster file cannot be used.
    """
    if cluster is None:
        return None if workers is None else build_options(ClusterFile, {"workers": workers})
    if workers is not None:
        raise ConfigError("--workers", "cannot stand beside --cluster", "give one of them")
    return read_cluster(cluster)


@contextmanager
def engine_for(workers: int | None = None, cluster: str | None = None) -> Iterator[Engine]:
    """Start the engine that the options name, put it in force, and end it.

    Parameters
    ----------
    workers
        Local processes; None and no cluster is this process.
    cluster
        A cluster file, or the address of a scheduler.

    Raises
    ------
    InputError
        An option cannot be used, or no scheduler answers.
    """
    chosen = cluster_for(workers, cluster)
    if chosen is None:
        with using(HERE) as engine:
            yield engine
        return
    with _dask_engine().on_dask(chosen) as engine, using(engine):
        yield engine


def job_script_for(cluster: str | None) -> str:
    """Return the job script that a cluster file's batch system would be given.

    Raises
    ------
    ConfigError
        There is no cluster file, or it names no batch system.
    """
    file = cluster_for(None, cluster)
    if file is None or file.jobs is None:
        raise ConfigError(
            "--dry-run", "prints the job script of a batch system", "name one with --cluster FILE"
        )
    script: str = _dask_engine().job_script(file, file.jobs)
    return script


def _dask_engine() -> ModuleType:
    """Import the engine on Dask, which logs nothing unless the user has set that otherwise."""
    with extra("cluster", *DASK):
        import dask.config  # noqa: PLC0415 (an extra)

        dask.config.update_defaults({"logging": {"distributed": logging.CRITICAL + 1}})
        from tuner.engine import dask_engine  # noqa: PLC0415 (slow to import)
    return dask_engine
