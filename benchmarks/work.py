"""The tasks of `benchmarks.workers`, which workers import by name."""

from __future__ import annotations

import os
import time
from pathlib import Path

from tuner.engine import Report


def nothing(_: int, _report: Report) -> None:
    """Do nothing, so that only the way there and back takes time."""


def wait(seconds: float, _report: Report) -> None:
    """Take so many s and no processor, so that more workers than cores can be compared."""
    time.sleep(seconds)


def process(_: int, _report: Report) -> dict[str, float]:
    """Return this process, its threads, s of processor and the most memory it had, in bytes."""
    time.sleep(0.2)  # so that no worker takes them all
    status = dict(
        line.split(":", 1)
        for line in Path("/proc/self/status").read_text().splitlines()
        if ":" in line
    )
    return {
        "pid": os.getpid(),
        "threads": float(status["Threads"]),
        "memory": 1024.0 * float(status["VmHWM"].split()[0]),
        "processor": time.process_time(),
    }
