"""The parts of one server, made once and handed to whoever answers; its metrics."""

from __future__ import annotations

import shutil
import threading
import uuid
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from anyio import CapacityLimiter
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from tuner.core.content_store import ContentStore
from tuner.core.disk import make_folder, write_text
from tuner.core.errors import InputError
from tuner.engine.engine import Engine
from tuner.service import jobs
from tuner.service.database import Database
from tuner.service.dispatcher import Dispatcher
from tuner.service.errors import UnavailableError
from tuner.service.jobs import JobQueue
from tuner.service.settings import ServiceSettings

MAX_INSPECTIONS = 2
"""Recordings that are inspected at the same time."""


@dataclass
class Service:
    """The parts of one server.

    Attributes
    ----------
    stopping
        Set once the server ends, so that answers which last for long end too.
    metrics, uploads, inspections
        Its counters, and turns of requests that send recordings.
    """

    settings: ServiceSettings
    database: Database
    store: ContentStore
    dispatcher: Dispatcher
    stopping: threading.Event = field(default_factory=threading.Event)
    _lock: IO[str] | None = None

    def __post_init__(self) -> None:
        self.metrics = Metrics(self)
        self.uploads = CapacityLimiter(self.settings.limits.uploads_at_once)
        self.inspections = CapacityLimiter(MAX_INSPECTIONS)

    @classmethod
    def open(cls, settings: ServiceSettings, engine: Engine | None = None) -> Service:
        """Open the store and the database, and make the folders.

        Parameters
        ----------
        engine
            A cluster that does the work; None for this machine.

        Raises
        ------
        InputError
            A folder, a URL or a database cannot be used, or another server uses the folder.
        """
        make_folder(settings.work)
        lock = _lock_data_folder(settings.data)
        shutil.rmtree(settings.incoming, ignore_errors=True)
        make_folder(settings.incoming)
        store = ContentStore(settings.store_url)
        database = Database(settings.database_url)
        database.migrate()
        jobs = JobQueue(database, _identity(settings.data), settings.lease_seconds)
        return cls(settings, database, store, Dispatcher(settings, jobs, store, engine), _lock=lock)

    def close(self) -> None:
        """Stop working; jobs under way go back into the queue."""
        self.stopping.set()
        self.dispatcher.stop()
        self.database.close()
        if self._lock is not None:
            self._lock.close()


def _identity(data: Path) -> str:
    """Return the name that the server of a data folder keeps when it is started again."""
    file = data / "server.id"
    if not file.exists():
        write_text(file, uuid.uuid4().hex)
    return file.read_text(encoding="utf-8").strip()


def _lock_data_folder(data: Path) -> IO[str]:
    """Take the lock of a data folder, which the system lets go when the process ends."""
    file = (data / "server.lock").open("w")
    try:
        import fcntl  # noqa: PLC0415 (not on Windows)
    except ImportError:
        return file
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        file.close()
        raise InputError(
            data, "is used by another server", "stop that one, or name another folder with --data"
        ) from None
    return file


class Metrics:
    """The counters of one server."""

    def __init__(self, service: Service) -> None:
        self.registry = CollectorRegistry()
        self.registry.register(_Table(service))
        self.seconds = Histogram(
            "tune_request_seconds",
            "Time to answer, by route.",
            ("method", "route", "status"),
            registry=self.registry,
        )
        self.uploaded = Counter(
            "tune_uploaded_bytes", "Bytes of recordings that were received.", registry=self.registry
        )

    def text(self) -> bytes:
        """Return all of them in Prometheus' format."""
        return generate_latest(self.registry)


class _Table(Collector):
    """Metrics of the job table and the dispatcher."""

    def __init__(self, service: Service) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        deaths = CounterMetricFamily("tune_worker_deaths", "Workers that died.")
        deaths.add_metric([], self._service.dispatcher.deaths)
        yield deaths
        up = GaugeMetricFamily("tune_database_up", "Whether the database answers.")
        try:
            found = jobs.counts(self._service.database)
        except UnavailableError:
            found = {}
        up.add_metric([], float(bool(found)))
        yield up
        gauge = GaugeMetricFamily("tune_jobs", "Jobs by state.", labels=["state"])
        for state, count in found.items():
            gauge.add_metric([state], count)
        yield gauge

    def describe(self) -> Iterator[Metric]:
        return iter(())
