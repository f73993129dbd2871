"""A server as a process of its own: ``python -m ... DATA PORT URL [real]``.

Its workers fit nothing, unless they are to be real ones.
"""

from __future__ import annotations

import sys
from pathlib import Path

from tuner.service import attempt
from tuner.service.serve import serve
from tuner.service.settings import Limits, ServiceSettings


def main() -> None:
    data, port, database, *real = sys.argv[1:]
    if not real:
        attempt.WORKER = [sys.executable, str(Path(__file__).with_name("fake_worker.py"))]
    settings = ServiceSettings(
        Path(data), database=database, limits=Limits(free_bytes=0), lease_seconds=3.0
    )
    serve(settings, host="127.0.0.1", port=int(port), say=sys.stdout.write)


if __name__ == "__main__":
    main()
