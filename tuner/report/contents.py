"""The contents of a result folder for the page, and the files that only the page reads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from pydantic import JsonValue

from tuner.core.disk import file_name, whole_file
from tuner.core.files import Part, ResultFile, read_arrays
from tuner.core.numerics import Array
from tuner.design.proposals import Proposals
from tuner.evaluate.records import RmseTable
from tuner.findings.findings import Finding
from tuner.ground.measurement import BenchRecord
from tuner.result import (
    ExportRecord,
    ExportRecords,
    Run,
    RunResult,
    finished_folder,
    read_run,
)
from tuner.search.listener import Iteration, Outcome
from tuner.uncertainty.records import GlobalSensitivity, Knowledge, Profiles

if TYPE_CHECKING:
    from tuner.evaluate.comparison import FlightErrors
    from tuner.search.progress import Fit


@dataclass(frozen=True)
class Contents:
    """A result folder, read; None for what it does not hold.

    Attributes
    ----------
    about
        What it was made of: of a run, too.
    global_sensitivity, profiles
        Indices between the bounds, and profiles of the likelihood.
    traces
        Flight -> name -> array, see `write_traces`.
    """

    folder: Path
    about: About
    run: Run | None
    knowledge: Knowledge | None
    proposals: Proposals | None
    global_sensitivity: GlobalSensitivity | None
    profiles: Profiles | None
    bench: BenchRecord | None
    search: SearchRecord | None
    laps: RmseTable | None
    exports: Sequence[ExportRecord]
    traces: Mapping[str, Mapping[str, Array]]

    @property
    def result(self) -> RunResult | None:
        """The result of the run."""
        return None if self.run is None else self.run.result


def read_contents(folder: str | Path) -> Contents:
    """Read the folder of a run, or of an examination without one.

    Raises
    ------
    InputError
        It is neither, or one of its files cannot be used.
    """
    folder = finished_folder(folder)
    run, about = None, About.read_if_any(folder)
    if about is None or (folder / RunResult.FILE).exists():
        run = read_run(folder)
        about = _about_run(run)
    exported = ExportRecords.read_if_any(folder)
    names = {file_name(flight.name): flight.name for flight in about.flights}
    return Contents(
        folder=folder,
        about=about,
        run=run,
        knowledge=Knowledge.read_if_any(folder),
        proposals=Proposals.read_if_any(folder),
        global_sensitivity=GlobalSensitivity.read_if_any(folder),
        profiles=Profiles.read_if_any(folder),
        bench=BenchRecord.read_if_any(folder),
        search=SearchRecord.read_if_any(folder),
        laps=RmseTable.read_if_any(folder),
        exports=() if exported is None else tuple(exported.exports.values()),
        traces={names.get(key, key): arrays for key, arrays in read_traces(folder).items()},
    )


def _about_run(run: Run) -> About:
    result = run.result
    return About(
        command=str(result.settings.get("command", "")),
        vehicle=run.vehicle.name,
        versions=result.versions,
        settings=result.settings,
        findings=list(result.findings),
        flights=[
            ExaminedFlight(name=f.name, path=f.path, sha256=f.sha256, duration=f.duration)
            for f in result.flights
        ],
    )


TRACES_FILE = "traces.npz"
MAX_POINTS = 1200
"""Points of a curve: as many as a wide screen has pixels."""
MAX_FORCE_POINTS = 400
"""Points of a force's curve, of which a flight has dozens."""


class SearchRecord(ResultFile):
    """The content of ``search.json``."""

    FILE = "search.json"

    iterations: list[Iteration]
    starts: list[Outcome]


class ExaminedFlight(Part):
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
    flights: list[ExaminedFlight]


def write_search(folder: Path, fitted: Fit) -> None:
    """Write ``search.json`` of a finished search."""
    iterations, starts = list(fitted.iterations), list(fitted.outcomes)
    SearchRecord(iterations=iterations, starts=starts).write(folder)


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
                arrays[f"{flight}/{signal}_time"] = _thin(of_signal.time)
                arrays[f"{flight}/{signal}"] = _thin(of_signal.recorded)
                arrays[f"{flight}/{signal}_{suffix}"] = _thin(of_signal.simulated)
    for name, errors in last.items():
        flight = file_name(name)
        if errors.forces is not None:
            arrays[f"{flight}/acting_time"] = _thin(errors.forces.time, MAX_FORCE_POINTS)
            for term, acted in errors.forces.of_term.items():
                arrays[f"{flight}/acting_{term}"] = _thin(acted, MAX_FORCE_POINTS)
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


def _thin(values: Array, points: int = MAX_POINTS) -> Array:
    step = max(1, int(np.ceil(len(values) / points)))
    return values[::step]
