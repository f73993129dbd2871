"""Recordings in, `Flight` out: nothing downstream of this room knows what a bag is.

Names are imported when they are first used, so that `tune inspect` answers from its cache before
numpy is loaded.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tuner.recordings.flight import SIGNALS, Flight, InitialState, Series
    from tuner.recordings.inspection import Inspection, inspect_recordings
    from tuner.recordings.loader import load_flight, load_flights
    from tuner.recordings.notes import Note

__all__ = [
    "SIGNALS",
    "Flight",
    "InitialState",
    "Inspection",
    "Note",
    "Series",
    "inspect_recordings",
    "load_flight",
    "load_flights",
]

_HOMES = {
    "Inspection": "inspection",
    "inspect_recordings": "inspection",
    "load_flight": "loader",
    "load_flights": "loader",
    "Note": "notes",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES.get(name, 'flight')}"), name)
