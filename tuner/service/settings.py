"""Settings of a server: folders, database, workers, and limits on visitors and processes."""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass, field
from pathlib import Path

from tuner.core.disk import home_folder

MIB = 2**20
GIB = 2**30


@dataclass(frozen=True)
class ServiceLimits:
    """Limits of one visitor, one recording and one job.

    Attributes
    ----------
    upload_bytes
        Of one recording.
    body_bytes
        Of any other request.
    uploads_at_once
        Recordings that are received at the same time, of all visitors together.
    stall_seconds, bytes_per_second
        After which a request of which nothing arrives is cut off, and how fast it must arrive.
    recordings
        Stored recordings, of all visitors together.
    recordings_of_job
        Recordings of one job.
    unfinished_jobs
        Jobs that are queued or running.
    requests_per_second, requests_in_a_burst
        Of one visitor, by token or address.
    free_bytes
        Left on the disk of the store, below which nothing more is taken.
    memory_bytes
        Of a process that fits a job.
    inspection_memory_bytes, inspection_seconds
        Of a process that inspects a recording.
    file_bytes
        Of a file that such a process writes.
    job_seconds
        Of one attempt at a job.
    deaths
        Attempts that end with the death of their process before the job is given up.
    """

    upload_bytes: int = 4 * GIB
    body_bytes: int = 1 * MIB
    uploads_at_once: int = 16
    stall_seconds: float = 60.0
    bytes_per_second: float = 16e3
    recordings: int = 100_000
    recordings_of_job: int = 64
    unfinished_jobs: int = 20_000
    requests_per_second: float = 200.0
    requests_in_a_burst: int = 2_000
    free_bytes: int = 256 * MIB
    memory_bytes: int = 8 * GIB
    inspection_memory_bytes: int = 2 * GIB
    inspection_seconds: float = 120.0
    file_bytes: int = 2 * GIB
    job_seconds: float = 6 * 3600.0
    deaths: int = 3


@dataclass(frozen=True)
class ServiceSettings:
    """One server.

    Attributes
    ----------
    data
        Folder for everything that is not said to lie elsewhere.
    database
        SQLAlchemy URL; empty for SQLite in ``data``.
    store
        fsspec URL of recordings and results; empty for a folder in ``data``.
    workers
        Jobs that are worked on at the same time.
    lease_seconds
        For which a claim on a job holds unless it is renewed.
    demands_tokens
        Whether a visitor must show a token.
    hosts
        Names under which visitors may address the server; none means any.
    """

    data: Path
    database: str = ""
    store: str = ""
    workers: int = 2
    lease_seconds: float = 30.0
    demands_tokens: bool = False
    hosts: tuple[str, ...] = ()
    limits: ServiceLimits = field(default_factory=ServiceLimits)

    @property
    def database_url(self) -> str:
        """SQLAlchemy URL of the database."""
        return self.database or f"sqlite:///{self.data.absolute() / 'tune.sqlite'}"

    @property
    def store_url(self) -> str:
        """URL, or folder, of the store."""
        return self.store or str(self.data.absolute() / "store")

    @property
    def incoming(self) -> Path:
        """Folder of uploads that are not complete."""
        return self.data / "incoming"

    @property
    def work(self) -> Path:
        """Folder of jobs under way, by their ids."""
        return self.data / "work"


def size_in_words(size: int) -> str:
    """Return bytes in the unit that suits them."""
    return f"{size / GIB:g} GiB" if size >= GIB else f"{size / MIB:g} MiB"


def default_data() -> Path:
    """Return the folder of a server whose user names none."""
    base = os.environ.get("XDG_DATA_HOME")
    return (Path(base) if base else home_folder() / ".local" / "share") / "multirotor-tune"


def limit_process(*, memory_bytes: int, file_bytes: int, cpu_seconds: int | None = None) -> None:
    """Limit this process and those that it starts, where the system can.

    Parameters
    ----------
    memory_bytes
        Of data, whether used yet or not; beyond it there is a ``MemoryError``.
    file_bytes
        Of a file that is written.
    cpu_seconds
        After which the process is killed.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415 (not on Windows)

    limits = {
        resource.RLIMIT_DATA: memory_bytes,
        resource.RLIMIT_FSIZE: file_bytes,
        resource.RLIMIT_CORE: 0,
    }
    if cpu_seconds is not None:
        limits[resource.RLIMIT_CPU] = cpu_seconds
    for kind, most in limits.items():
        _, hard = resource.getrlimit(kind)
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (allowed, allowed))
