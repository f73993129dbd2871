"""Limits that the system holds a process to: memory, size of files, time."""

from __future__ import annotations

import sys


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
