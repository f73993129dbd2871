"""What the plots show of each flight: recorded, and simulated with both sets of coefficients."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tuner.comparison.errors import FlightErrors
from tuner.flights.flight import Flight
from tuner.simulation.table import roll_pitch_yaw

Array = NDArray[np.float64]

TRACES_FILE = "traces.npz"
POINTS = 1200
"""Points of a curve: as many as a wide screen has pixels."""


def write_traces(
    folder: Path,
    flights: Sequence[Flight],
    initial: Mapping[str, FlightErrors],
    best: Mapping[str, FlightErrors],
) -> None:
    """Write ``traces.npz``: per flight times in s, positions in m, roll, pitch, yaw in degrees."""
    found: dict[str, dict[str, Array]] = {}
    for flight in flights:
        before, after = initial[flight.name], best[flight.name]
        place = _at(flight, "position", after.position_time)
        turn = roll_pitch_yaw(_at(flight, "attitude", after.attitude_time))
        found[flight.name] = {
            "position_time": after.position_time,
            "position": place,
            "position_initial": place + before.position,
            "position_best": place + after.position,
            "attitude_time": after.attitude_time,
            "attitude": turn,
            "attitude_initial": turn + before.attitude,
            "attitude_best": turn + after.attitude,
        }
    save_traces(folder, found)


def write_simulated(
    folder: Path, flights: Sequence[Flight], flown: Mapping[str, FlightErrors]
) -> None:
    """Write ``traces.npz`` of flights simulated with one vehicle."""
    found: dict[str, dict[str, Array]] = {}
    for flight in flights:
        if flight.name in flown:
            errors = flown[flight.name]
            place = _at(flight, "position", errors.position_time)
            turn = roll_pitch_yaw(_at(flight, "attitude", errors.attitude_time))
            found[flight.name] = {
                "position_time": errors.position_time,
                "position": place,
                "position_simulated": place + errors.position,
                "attitude_time": errors.attitude_time,
                "attitude": turn,
                "attitude_simulated": turn + errors.attitude,
            }
    save_traces(folder, found)


def save_traces(folder: Path, flights: Mapping[str, Mapping[str, Array]]) -> None:
    """Write ``traces.npz`` of flight -> name -> array, thinned to what a screen can show."""
    arrays = {
        f"{flight}/{name}": _thinned(values)
        for flight, parts in flights.items()
        for name, values in parts.items()
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    temporary = folder / f"{TRACES_FILE}.tmp"
    temporary.write_bytes(buffer.getvalue())
    temporary.replace(folder / TRACES_FILE)


def read_traces(folder: Path) -> dict[str, dict[str, Array]]:
    """Return flight -> name -> array of what `write_traces` wrote; empty if there is none."""
    path = folder / TRACES_FILE
    if not path.exists():
        return {}
    found: dict[str, dict[str, Array]] = {}
    with np.load(path, allow_pickle=False) as data:
        for key in data.files:
            flight, _, name = key.rpartition("/")
            found.setdefault(flight, {})[name] = data[key]
    return found


def _at(flight: Flight, signal: str, time: Array) -> Array:
    series = flight.series[signal]
    return series.values[np.isin(series.time, time)]


def _thinned(values: Array) -> Array:
    step = max(1, int(np.ceil(len(values) / POINTS)))
    return values[::step]
