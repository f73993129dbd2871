"""The process that fits one job: ``python -m tuner.service.worker``.

It reads one line of JSON, an `Assignment`, and writes lines of JSON: what it does, and how it ends.
Its standard input stays open for as long as its server lives; when that ends, so does it. A lock
on the job's folder keeps two attempts apart, for the older may still be ending.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import threading
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any

from pydantic import BaseModel

from tuner.core.errors import InputError
from tuner.core.shipped import configs_folder
from tuner.service.request import CheckedRequest
from tuner.service.settings import ServiceLimits, limit_process, size_in_words

RESULT_FOLDER = Path("result")
LOCK_FILE = ".lock"


class Assignment(BaseModel):
    """The task of a worker.

    Attributes
    ----------
    job
        Its id.
    folder
        With the recordings in ``flights/``; the result goes into ``result/`` there.
    flights
        Names of the recordings.
    asked
        What is to be fitted.
    cores
        Processor cores to stay on; none leaves that to the system.
    limits
        Memory and size of files.
    """

    job: str
    folder: Path
    flights: tuple[str, ...]
    asked: CheckedRequest
    cores: tuple[int, ...] = ()
    limits: ServiceLimits = ServiceLimits()


def main() -> None:
    """Fit the job that standard input names."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8", buffering=1)
    os.dup2(2, 1)  # what libraries print is not taken for a message
    assignment = Assignment.model_validate_json(sys.stdin.readline())
    threading.Thread(target=_end_with_server, daemon=True).start()
    os.chdir(assignment.folder)
    with Path(LOCK_FILE).open("w") as lock:
        _wait_for(lock)
        channel.write(json.dumps(_fit(assignment, channel)) + "\n")


def _end_with_server() -> None:
    """End this process and those that it has started once standard input is closed."""
    sys.stdin.read()
    if hasattr(os, "killpg"):
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


def _wait_for(lock: IO[str]) -> None:
    if sys.platform != "win32":
        import fcntl  # noqa: PLC0415 (not on Windows)

        fcntl.flock(lock, fcntl.LOCK_EX)


def _fit(assignment: Assignment, channel: IO[str]) -> dict[str, Any]:
    """Run the job and return how it ended."""
    limits, asked = assignment.limits, assignment.asked
    limit_process(memory_bytes=limits.memory_bytes, file_bytes=limits.file_bytes)
    from tuner.core.runtime import configure  # noqa: PLC0415 (jax after the limits)

    if assignment.cores and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, assignment.cores)
    try:
        configure()
        from tuner.job.run import run  # noqa: PLC0415

        run(
            asked.options(Path(), assignment.flights),
            out=RESULT_FOLDER,
            resume=(RESULT_FOLDER / "checkpoint.npz").exists(),
            listener=_listener(channel),
            command=f"job {assignment.job} of a tuning service",
        )
    except InputError as error:
        return {"kind": "refused", "error": str(error)}
    except MemoryError:
        what = f"the job needs more than {size_in_words(limits.memory_bytes)} of memory"
        return {"kind": "refused", "error": f"{what}; fit fewer or shorter recordings"}
    except Exception as error:
        traceback.print_exc()
        return {"kind": "fault", "error": f"{type(error).__name__}: {error}"}
    return {"kind": "done"}


def _listener(channel: IO[str]) -> Any:
    """Return a listener that writes the events of a run as lines of JSON."""
    from tuner.search.listener import Listener  # noqa: PLC0415

    def say(kind: str, **content: object) -> None:
        channel.write(json.dumps({"kind": kind, **content}) + "\n")

    def on_settings(settings: Any) -> None:
        for name, origin in settings.origin.items():
            # where this program lies here is nothing to a visitor
            say("message", text=f"{name}: {origin}".replace(f"{configs_folder()}/", ""))

    def rows(parts: Sequence[Any], **how: Any) -> list[dict[str, Any]]:
        return [part.model_dump(mode="json", **how) for part in parts]

    return Listener(
        on_settings=on_settings,
        on_iteration=lambda iteration, left: say(
            "iteration",
            **iteration.model_dump(mode="json"),
            seconds_left=None if math.isnan(left) else left,
        ),
        on_estimates=lambda estimates: say("estimates", estimates=rows(estimates)),
        on_message=lambda text: say("message", text=text),
        on_folds=lambda folds: say("folds", folds=rows(folds, exclude={"coefficients"})),
    )


if __name__ == "__main__":
    main()
