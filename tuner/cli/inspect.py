"""``tune inspect``: what recordings hold."""

from __future__ import annotations

import sys
from typing import Annotated

from cyclopts import Parameter

from tuner.cli.options import Namespace, Topics


def inspect(
    *flights: Annotated[str, Parameter(help="Recordings, or a quoted glob.")],
    topics: Topics = None,
    namespace: Namespace = None,
    json: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Say what recordings hold and what they are good for, without simulating anything.

    Parameters
    ----------
    json
        Print JSON instead of tables.
    """
    from tuner.flights.inspection import as_json, inspect_recordings
    from tuner.recording_paths import find_flights

    found, errors = inspect_recordings(
        find_flights(flights), topics=topics, namespace=namespace or ""
    )
    if json:
        print(as_json(found, errors))
    else:
        from tuner.cli.tables import print_inspections

        print_inspections(found)
    if errors:
        for error in errors[:-1]:
            sys.stderr.write(f"tune: {error}\n")
        raise errors[-1]
