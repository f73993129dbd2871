"""``tune inspect``: what recordings hold."""

from __future__ import annotations

import sys
from typing import Annotated

from cyclopts import Parameter

from tuner.cli.options import EACH
from tuner.options import ReadingOptions


def inspect(
    *flights: Annotated[str, Parameter(help="Inspect these recordings, or a quoted glob.")],
    reading: Annotated[ReadingOptions, EACH] = ReadingOptions(),
    vehicle: str | None = None,
    json: bool = False,
    suggest: bool = False,
) -> None:
    """Report whether recordings can be fitted, how, and what they hold; nothing is simulated.

    Parameters
    ----------
    vehicle
        Start from this vehicle file or shipped vehicle. Default: the job file's, else hovergames.
    json
        Print JSON instead of tables.
    suggest
        Print a topic map to begin with: the best guess for every column, its unit, and why.
    """
    if suggest:
        from pathlib import Path

        from tuner.core.recording_paths import find_flights
        from tuner.recordings.suggestion import suggested_map

        for path in find_flights(flights):
            sys.stdout.write(suggested_map(Path(path)))
        return
    from dataclasses import asdict

    from tuner.core.recording_paths import find_flights
    from tuner.job.recording_verdict import in_words, verdict_of
    from tuner.recordings.inspection import as_json, inspect_recordings

    inspections, errors = inspect_recordings(
        find_flights(flights), topics=reading.topics, namespace=reading.namespace or ""
    )
    verdicts = {
        seen.path: verdict_of(seen, **vars(reading), vehicle=vehicle) for seen in inspections
    }
    if json:
        print(as_json(inspections, errors, {path: asdict(of) for path, of in verdicts.items()}))
    else:
        from tuner.cli.tables import console
        from tuner.recordings.inspection import render

        words = {path: in_words(verdict) for path, verdict in verdicts.items()}
        console().print(render(inspections, words))
    if errors:
        for error in errors[:-1]:
            sys.stderr.write(f"tune: {error}\n")
        raise errors[-1]
