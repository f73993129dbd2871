"""Search, flights and what an examination was made of, as files that the page reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic import JsonValue

from tuner.core.disk import file_name, whole_file
from tuner.core.files import FiniteOrNone, Part, ResultFile, read_arrays
from tuner.findings.findings import Finding
from tuner.search.iteration import Iteration

if TYPE_CHECKING:  # a page is drawn without jax
    from tuner.evaluate.rmse import FlightErrors
    from tuner.search.fitted import Fitted

Array = NDArray[np.float64]
TRACES_FILE = "traces.npz"
POINTS = 1200
"""Points of a curve: as many as a wide screen has pixels."""
FORCE_POINTS = 400
"""Points of a force's curve, of which a flight has dozens."""


class Start(Part):
    """Where one start came from and ended; coefficients in their units."""

    origin: str
    loss: FiniteOrNone
    start: dict[str, float]
    end: dict[str, float]


class SearchRecord(ResultFile):
    """The content of ``search.json``."""

    FILE = "search.json"

    iterations: list[Iteration]
    starts: list[Start]


class Recording(Part):
    """A flight that an examination read."""

    name: str
    path: str
    sha256: str
    duration: float


class About(ResultFile):
    """The content of ``about.json``: what an examination without a fit was made of."""

    FILE = "about.json"

    command: str
    vehicle: str
    versions: dict[str, str]
    settings: dict[str, JsonValue]
    findings: list[Finding]
    flights: list[Recording]


def write_search(folder: Path, fitted: Fitted) -> None:
    """Write ``search.json`` of a finished search."""
    numbers = fitted.objective.space.numbers
    SearchRecord(
        iterations=list(fitted.iterations),
        starts=[
            Start(
                origin=outcome.origin,
                loss=outcome.loss,
                start=numbers(outcome.start),
                end=numbers(outcome.vector),
            )
            for outcome in fitted.outcomes
        ],
    ).write(folder)


def write_traces(folder: Path, simulations: Mapping[str, Mapping[str, FlightErrors]]) -> None:
    """Write ``traces.npz`` of simulation -> flight -> errors, thinned to what a screen can show.

    Per flight: times in s, positions in m, roll, pitch and yaw in degrees; first what was
    recorded, then, with its name behind, what each simulation had. Of the last simulation also
    ``acting_time`` and, as ``acting_TERM``, the (n, 6) force and moment of each term.
    """
    arrays: dict[str, Array] = {}
    last: Mapping[str, FlightErrors] = {}
    for suffix, flights in simulations.items():
        last = flights
        for name, errors in flights.items():
            flight = file_name(name)
            for signal, of_signal in (("position", errors.position), ("attitude", errors.attitude)):
                arrays[f"{flight}/{signal}_time"] = _thinned(of_signal.time)
                arrays[f"{flight}/{signal}"] = _thinned(of_signal.recorded)
                arrays[f"{flight}/{signal}_{suffix}"] = _thinned(of_signal.simulated)
    for name, errors in last.items():
        flight = file_name(name)
        if errors.forces is not None:
            arrays[f"{flight}/acting_time"] = _thinned(errors.forces.time, FORCE_POINTS)
            for term, acted in errors.forces.of_term.items():
                arrays[f"{flight}/acting_{term}"] = _thinned(acted, FORCE_POINTS)
    with whole_file(folder / TRACES_FILE) as unfinished, unfinished.open("wb") as file:
        np.savez_compressed(file, **arrays)  # type: ignore[arg-type]


def read_traces(folder: Path) -> dict[str, dict[str, Array]]:
    """Return flight, by its file's name, -> name -> array; empty if there is none."""
    path = folder / TRACES_FILE
    if not path.exists():
        return {}
    traces: dict[str, dict[str, Array]] = {}
    for key, values in read_arrays(path, remedy="run tune again").items():
        flight, _, name = key.rpartition("/")
        traces.setdefault(flight, {})[name] = values
    return traces


def _thinned(values: Array, points: int = POINTS) -> Array:
    step = max(1, int(np.ceil(len(values) / points)))
    return values[::step]
