"""Everything that a result folder holds for the page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from tuner.core.disk import exists, file_name
from tuner.core.errors import InputError
from tuner.design.proposals import Proposals
from tuner.evaluate.comparison_table import Table
from tuner.ground.bench_json import BenchRecord
from tuner.recordings.flight import Array
from tuner.report.record import About, Recording, SearchRecord, read_traces
from tuner.result import ExportRecord, ExportRecords, Run, RunResult, read_run
from tuner.uncertainty.records import GlobalSensitivity, Profiles
from tuner.uncertainty.sensitivity_json import Knowledge


@dataclass(frozen=True)
class Contents:
    """A result folder, read; None for what it does not hold.

    Attributes
    ----------
    folder
        Where everything lies.
    about
        What it was made of: of a run, too.
    run
        The fit.
    knowledge
        What is known about each coefficient.
    proposals
        What to fly next.
    global_sensitivity, profiles
        Indices between the bounds, and profiles of the likelihood.
    bench
        Ground measurements.
    search, laps
        How the fit went, and how closely laps are met.
    exports
        What was exported into the folder, or refused.
    traces
        Flight -> name -> array, see `tuner.report.record`.
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
    laps: Table | None
    exports: Sequence[ExportRecord]
    traces: Mapping[str, Mapping[str, Array]]


def read_contents(folder: str | Path) -> Contents:
    """Read the folder of a run, or of an examination without one.

    Raises
    ------
    InputError
        It is neither, or one of its files cannot be used.
    """
    folder = Path(folder)
    if not (exists(folder) and folder.is_dir()):
        raise InputError(folder, "is no folder", "give the result folder of a run")
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
        laps=Table.read_if_any(folder),
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
            Recording(name=f.name, path=f.path, sha256=f.sha256, duration=f.duration)
            for f in result.flights
        ],
    )
