"""A server as a process of its own, and what spares one the work that tests do not ask for."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from tuner.service import dispatcher, recordings
from tuner.service.app import serve
from tuner.service.settings import ServiceLimits, ServiceSettings

ROOT = Path(__file__).parents[3]
FAKE_WORKER = [sys.executable, "-S", str(Path(__file__).with_name("fake_worker.py"))]


def found_in_a_table(*_: object) -> dict[str, object]:
    """Return what an inspection might, without one."""
    return {
        "started": None,
        "duration": 3.0,
        "problem": None,
        "topic_map": "table",
        "topics": [],
        "missions": [],
        "coefficients": [],
        "notes": [],
    }


def serve_at(port: int, data: Path, database: str, *, real: bool) -> None:
    """Serve until the process ends; unless it is to be real, nothing is inspected nor fitted."""
    os.chdir(ROOT)
    if not real:
        dispatcher.WORKER, recordings.inspect = FAKE_WORKER, found_in_a_table
    settings = ServiceSettings(
        data, database=database, limits=ServiceLimits(free_bytes=0), lease_seconds=3.0
    )
    serve(settings, host="127.0.0.1", port=port, say=lambda _: None)
