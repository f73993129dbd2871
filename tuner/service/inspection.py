"""A recording inspected in a process of its own, with limits on memory, time and written bytes.

``python -m tuner.service.inspection FILE MEMORY BYTES SECONDS`` prints what `tune inspect --json`
prints.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from tuner.core.errors import RecordingError
from tuner.core.runtime import THREAD_VARIABLES
from tuner.service.settings import ServiceLimits, limit_process, size_in_words

SPLIT_REMEDY = "split the recording, or leave topics out that are not needed (images, point clouds)"
MAX_JSON_LETTERS = 1_000_000
"""letters of an inspection, which pages show"""


def inspect(file: Path, limits: ServiceLimits) -> dict[str, Any]:
    """Return the JSON content of `tune inspect` on a recording.

    Raises
    ------
    RecordingError
        It cannot be read, or takes more memory or time than is allowed.
    """
    numbers = (
        limits.inspection_memory_bytes,
        limits.file_bytes,
        int(limits.inspection_seconds) + 1,
    )
    command = [sys.executable, "-m", "tuner.service.inspection", str(file), *map(str, numbers)]
    single = dict.fromkeys(THREAD_VARIABLES, "1")
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=limits.inspection_seconds,
            env={**os.environ, **single},
            check=False,
        )
    except subprocess.TimeoutExpired:
        what = f"takes more than {limits.inspection_seconds:g} s to read"
        raise RecordingError(file.name, what, SPLIT_REMEDY) from None
    if done.returncode == 3:
        what = f"needs more than {size_in_words(limits.inspection_memory_bytes)} of memory to read"
        raise RecordingError(file.name, what, SPLIT_REMEDY)
    if done.returncode != 0:
        raise RecordingError(
            file.name, "cannot be read: its reader was stopped", "is it a recording of a flight?"
        )
    content = json.loads(done.stdout)
    if "refused" in content:
        raise RecordingError(file.name, content["refused"]["what"], content["refused"]["remedy"])
    recording: dict[str, Any] = content["recordings"][0]
    return recording | {"path": file.name}


def main() -> None:
    """Inspect the file that the command line names."""
    file, memory, size, seconds = sys.argv[1], *map(int, sys.argv[2:])
    limit_process(memory_bytes=memory, file_bytes=size, cpu_seconds=seconds)
    from tuner.recordings.inspection import as_json, inspect_recordings  # noqa: PLC0415 (after limits)

    try:
        inspections, errors = inspect_recordings([Path(file)], cache=False)
    except MemoryError:
        sys.exit(3)
    text = as_json(inspections)
    if len(text) > MAX_JSON_LETTERS:
        errors = (RecordingError(file, "holds too many topics to list", SPLIT_REMEDY),)
    if errors:
        text = json.dumps({"refused": {"what": errors[0].what, "remedy": errors[0].remedy}})
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
