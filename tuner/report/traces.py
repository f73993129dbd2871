"""What the plots show of each flight: recorded, and simulated with both sets of coefficients."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tuner.comparison.errors import FlightErrors
from tuner.disk import whole_file
from tuner.files import read_arrays

Array = NDArray[np.float64]

TRACES_FILE = "traces.npz"
POINTS = 1200
"""Points of a curve: as many as a wide screen has pixels."""


def write_traces(
    folder: Path, initial: Mapping[str, FlightErrors], best: Mapping[str, FlightErrors]
) -> None:
    """Write ``traces.npz``: per flight times in s, positions in m, roll, pitch, yaw in degrees."""
    save_traces(
        folder,
        {name: _traces({"initial": initial[name], "best": best[name]}) for name in initial},
    )


def write_simulated(folder: Path, flown: Mapping[str, FlightErrors]) -> None:
    """Write ``traces.npz`` of flights simulated with one vehicle."""
    save_traces(folder, {name: _traces({"simulated": errors}) for name, errors in flown.items()})


def _traces(simulations: Mapping[str, FlightErrors]) -> dict[str, Array]:
    """Return what was recorded of one flight, and what each simulation of it had."""
    traces: dict[str, Array] = {}
    for suffix, errors in simulations.items():
        for signal, of_signal in (("position", errors.position), ("attitude", errors.attitude)):
            traces[f"{signal}_time"] = of_signal.time
            traces[signal] = of_signal.recorded
            traces[f"{signal}_{suffix}"] = of_signal.simulated
    return traces


def save_traces(folder: Path, flights: Mapping[str, Mapping[str, Array]]) -> None:
    """Write ``traces.npz`` of flight -> name -> array, thinned to what a screen can show."""
    arrays = {
        f"{flight}/{name}": _thinned(values)
        for flight, parts in flights.items()
        for name, values in parts.items()
    }
    with whole_file(folder / TRACES_FILE) as unfinished, unfinished.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_traces(folder: Path) -> dict[str, dict[str, Array]]:
    """Return flight -> name -> array of what `write_traces` wrote; empty if there is none."""
    path = folder / TRACES_FILE
    if not path.exists():
        return {}
    traces: dict[str, dict[str, Array]] = {}
    for key, values in read_arrays(path, remedy="run tune again").items():
        flight, _, name = key.rpartition("/")
        traces.setdefault(flight, {})[name] = values
    return traces


def _thinned(values: Array) -> Array:
    step = max(1, int(np.ceil(len(values) / POINTS)))
    return values[::step]
