"""An engine on a Dask cluster, and its workers' side: scheduling, retries, lost workers are Dask's.

A task that a lost worker had is computed again by another, at most as often as Dask's setting
``distributed.scheduler.allowed-failures`` says, three times. What a client's end needs beside that:
reports and log lines come back over Dask's events, and what goes wrong becomes one line.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import signal
import threading
import uuid
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import CancelledError, Future, InvalidStateError
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any, TypeVar

import cloudpickle
import dask.config
from distributed import (
    Client,
    Event,
    KilledWorker,
    LocalCluster,
    Status,
    Worker,
    WorkerPlugin,
    get_worker,
)
from distributed.comm import CommClosedError
from distributed.security import Security

from tuner.core.content_store import ContentStore
from tuner.core.disk import cache_folder, expanded
from tuner.core.errors import EngineError, InputError
from tuner.core.runtime import configure, extra
from tuner.engine.engine import (
    DASK,
    HERE,
    BatchSystem,
    ClusterFile,
    Engine,
    Kubernetes,
    Report,
    Task,
    using,
)


class StopRequested(Exception):  # noqa: N818 (no error: it was asked for)
    """Whoever asked for a task wants it no longer."""


@dataclass(frozen=True)
class WorkerSetup(WorkerPlugin):  # type: ignore[misc]
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
            os.environ["JAX_PLATFORMS"] = ""  # what there is: who started it has the processor's
            os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")  # others share it
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
            raise StopRequested
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
class StoredValue:
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


T = TypeVar("T")
R = TypeVar("R")


class DaskEngine(Engine):
    """Computes tasks in the workers of a Dask cluster."""

    def __init__(self, client: Client, at_once: int, store: ContentStore) -> None:
        self.at_once = self.ahead = at_once
        self._client, self._store = client, store
        self._topic = f"tune-{uuid.uuid4().hex}"
        self._listeners: dict[str, Report] = {}
        client.subscribe_topic(self._topic, self._heard)

    def submit(
        self, function: Task[T, R], task: T, on_report: Report = lambda _: None
    ) -> Future[R]:
        """Have a worker compute a task."""
        identity = uuid.uuid4().hex
        self._listeners[identity] = on_report
        outcome: Future[R] = Future()
        with self._translated():
            # bytes, lest the scheduler, which looks at arguments, import and hold all of it
            content = cloudpickle.dumps((function, task))
            inner = self._client.submit(run_task, content, identity, self._topic, pure=False)

        async def follow() -> None:
            # a worker that is lost with its result, once that was announced, is an error here too
            with contextlib.suppress(InvalidStateError):  # nobody wants it any longer
                try:
                    with self._translated():
                        outcome.set_result(await inner.result())
                except BaseException as error:
                    outcome.set_exception(error)
                finally:
                    self._listeners.pop(identity, None)

        def cancelled(outcome: Future[R]) -> None:
            if outcome.cancelled():
                with contextlib.suppress(OSError, TimeoutError, RuntimeError):
                    Event(stop_name(identity), client=self._client).set()
                inner.cancel()

        self._client.loop.add_callback(follow)
        outcome.add_done_callback(cancelled)
        return outcome

    def share(self, value: T) -> Callable[[], T]:
        """Return what gives workers a value, through the store."""
        return StoredValue(self._store.url, self._store.put(pickle.dumps(value, protocol=5)))

    def _heard(self, event: tuple[float, Any]) -> None:
        _, message = event
        listener = self._listeners.get(message["task"])
        if listener is None:
            return
        if "log" in message:
            name, level, line = message["log"]
            logging.getLogger(name).log(level, "%s", line)
        else:
            listener(message["report"])

    @contextlib.contextmanager
    def _translated(self) -> Iterator[None]:
        """Turn what Dask says of its own failures into one line."""
        try:
            yield
        except KilledWorker as error:
            ends = error.allowed_failures + 1
            raise EngineError(
                "workers",
                f"ended {'once' if ends == 1 else f'{ends} times'} over the same task",
                "give each more memory, as memory: 4GiB in the cluster file, or use fewer",
            ) from None
        except (CancelledError, CommClosedError, TimeoutError, OSError, RuntimeError) as error:
            if "deserialization" in str(error):
                raise EngineError(
                    "scheduler",
                    "does not know this program",
                    "install multirotor-tune[cluster] there, the same version as here",
                ) from None
            if isinstance(error, RuntimeError) and self._client.status == "running":
                raise
            raise EngineError(
                "scheduler",
                "does not answer any more",
                "start it again; a search goes on with --out and --resume",
            ) from None


@contextlib.contextmanager
def on_dask(file: ClusterFile) -> Iterator[Engine]:
    """Start a cluster, or connect to one; end what was started.

    Raises
    ------
    InputError
        No scheduler answers, or what the file names is not there.
    """
    configure()
    base = file.store or str(cache_folder() / "shared")
    store = ContentStore(f"{base.rstrip('/')}/{uuid.uuid4().hex}")  # of this engine alone
    with contextlib.ExitStack() as stack:
        stack.callback(store.clear)
        local = file.address is None and file.jobs is None and file.kubernetes is None
        pool = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
        with interrupts_kept_from_children():
            cluster = stack.enter_context(cluster_of(file))
            client = stack.enter_context(connected(cluster, file))
            client.register_plugin(
                WorkerSetup(tuple(pool) if local else (), cores=file.cores, gpus=file.gpus)
            )
        at_once = file.workers if file.address is None else max(1, len(client.nthreads()))
        yield DaskEngine(client, at_once, store)


@contextlib.contextmanager
def interrupts_kept_from_children() -> Iterator[None]:
    """Start processes, and threads that will, which Ctrl-C does not reach; hear it afterwards.

    Children inherit that a signal is blocked, but not what a handler of their parent's does. Does
    nothing where the caller is not the main thread, whose signals these are, or signals cannot be
    blocked.
    """
    handler = signal.getsignal(signal.SIGINT)
    is_main = threading.current_thread() is threading.main_thread()
    if not is_main or handler is None or not hasattr(signal, "pthread_sigmask"):
        yield
        return
    pressed = threading.Event()
    # which would unblock the signal in the thread that spawns first, and so starts it
    resource_tracker.ensure_running()
    # some other thread, of a library, may hear what is blocked in this one
    signal.signal(signal.SIGINT, lambda *_: pressed.set())
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        signal.signal(signal.SIGINT, handler)
    if pressed.is_set():
        signal.raise_signal(signal.SIGINT)


ANSWER = 10
"""s within which a scheduler answers."""
SPARING = {
    "distributed": {
        "worker": {"profile": {"enabled": False}},
        "admin": {"tick": {"interval": "500ms"}},
    }
}
"""What local workers' cores are spared, unless the user's Dask configuration says otherwise: looks
at the stack a hundred times a second, and at each event loop's delay fifty times."""
dask.config.update_defaults(SPARING)
CLASSES = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "lsf": "LSFCluster",
    "sge": "SGECluster",
}


def cluster_of(file: ClusterFile) -> AbstractContextManager[Any]:
    """Return the cluster that a file asks for: started on entering, ended on leaving.

    Raises
    ------
    InputError
        What it needs is not installed, or does not start.
    """
    if file.address is not None:
        return contextlib.nullcontext(file.address)
    if file.jobs is not None:
        return _jobs(file, file.jobs)
    if file.kubernetes is not None:
        with extra("cluster", *DASK):
            from dask_kubernetes.operator import KubeCluster  # noqa: PLC0415 (few need it)

        pods = KubeCluster(custom_cluster_spec=pod_specification(file, file.kubernetes))
        return contextlib.closing(pods)
    cluster: AbstractContextManager[Any] = LocalCluster(
        n_workers=file.workers,
        threads_per_worker=1,
        memory_limit=file.memory or "auto",
        host="127.0.0.1",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL + 1,
    )
    return cluster


@contextlib.contextmanager
def connected(cluster: Any, file: ClusterFile) -> Iterator[Client]:
    """Yield a client of a cluster.

    Raises
    ------
    InputError
        No scheduler answers.
    """
    security = None
    if file.tls is not None:
        security = Security(
            tls_ca_file=str(file.tls.ca),
            tls_client_cert=str(file.tls.certificate),
            tls_client_key=str(file.tls.key),
            require_encryption=True,
        )
    try:
        client = Client(cluster, timeout=ANSWER, security=security, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise InputError(
            f"--cluster {file.address or ''}".strip(),
            f"no scheduler answers ({' '.join(str(error).split())})",
            "start it, or correct the address",
        ) from None
    try:
        yield client
    finally:
        with contextlib.suppress(OSError, TimeoutError, RuntimeError):
            client.close()


def job_script(file: ClusterFile, jobs: BatchSystem) -> str:
    """Return the job script with which a batch system would start a worker; none is submitted."""
    with _jobs(file, jobs, submit=False) as cluster:
        return str(cluster.job_script())


def _jobs(
    file: ClusterFile, jobs: BatchSystem, *, submit: bool = True
) -> AbstractContextManager[Any]:
    with extra("cluster", *DASK):
        import dask_jobqueue  # noqa: PLC0415 (few need it)

    kind = getattr(dask_jobqueue, CLASSES[jobs.system])
    options = {
        "queue": jobs.queue,
        "account": jobs.account,
        "walltime": jobs.walltime,
        "job_extra_directives": list(jobs.directives),
        "job_script_prologue": list(jobs.prologue),
        "python": jobs.python,
        "interface": jobs.interface,
        "local_directory": jobs.scratch,
        "log_directory": None if jobs.logs is None else str(expanded(jobs.logs)),
    }
    scheduler = dask.config.get(f"jobqueue.{jobs.system}.scheduler-options", {})
    cluster: AbstractContextManager[Any] = kind(
        n_workers=file.workers if submit else 0,
        scheduler_options={"dashboard_address": "127.0.0.1:0", **scheduler},
        cores=file.cores,
        processes=1,
        worker_extra_args=["--nthreads", "1"] if file.cores > 1 else [],
        memory=file.memory,
        job_name="tune",
        silence_logs="error",
        **{key: value for key, value in options.items() if value is not None},
    )
    return cluster


def pod_specification(file: ClusterFile, pods: Kubernetes) -> dict[str, Any]:
    """Return the Dask cluster that dask_kubernetes' operator is asked for."""
    with extra("cluster", *DASK):
        from dask_kubernetes.operator import make_cluster_spec  # noqa: PLC0415 (few need it)

    assert file.memory is not None
    memory = file.memory.replace(" ", "").removesuffix("B")  # as Kubernetes writes it: 2Gi, 500M
    each = {"cpu": str(file.cores), "memory": memory}
    specification: dict[str, Any] = make_cluster_spec(
        name=pods.name,
        image=pods.image,
        n_workers=file.workers,
        resources={"requests": each, "limits": each},
        worker_command="dask worker --nthreads 1",
    )
    if pods.namespace is not None:
        specification["metadata"]["namespace"] = pods.namespace
    return specification
