"""The commands of `tune` beside the fit, the service and a starting vehicle."""

from __future__ import annotations

import json as json_module
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from tuner.cli.options import FLATTENED, TYPED_WORDS, Quiet, Verbose
from tuner.core.errors import InputError
from tuner.core.phrases import printable
from tuner.options import (
    ExaminationOptions,
    ExportOptions,
    ReadingOptions,
    RecordingOptions,
    SimulationOptions,
)

if TYPE_CHECKING:
    from tuner.evaluate.comparison import FlightErrors


def inspect(
    *flights: Annotated[str, Parameter(help="Inspect these recordings, or a quoted glob.")],
    reading: Annotated[ReadingOptions, FLATTENED] = ReadingOptions(),
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
    from dataclasses import asdict

    from tuner.core.disk import find_flights

    paths = find_flights(flights)
    if suggest:
        from tuner.recordings.inspector import suggested_map

        for path in paths:
            sys.stdout.write(suggested_map(path))
        return
    from tuner.job.recording_verdict import in_words, verdict_of
    from tuner.recordings.inspection import as_json, inspect_recordings

    inspections, errors = inspect_recordings(
        paths, topics=reading.topics, namespace=reading.namespace or ""
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
            sys.stderr.write(printable(f"tune: {error}") + "\n")
        raise errors[-1]


def compare(
    *,
    recordings: Annotated[RecordingOptions, FLATTENED],
    vehicle: list[str],
    out: list[Path] | None = None,
    laps: bool = False,
    plot: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Simulate the recorded flights with several coefficient sets and tabulate the RMSE.

    Parameters
    ----------
    vehicle
        Compare these vehicle files, or shipped vehicles by their names.
    out
        Write the table into these files: .csv, .json or .html.
    laps
        Show each lap on the terminal, too.
    plot
        Draw the position errors over time into this FILE.png, .svg or .pdf.
    """
    from tuner.cli.progress import progress_on_terminal
    from tuner.cli.tables import print_comparison
    from tuner.core.runtime import configure

    configure()
    from tuner.evaluate.comparison import compare as compare_vehicles
    from tuner.report.paper import check_figure, comparison_figure, write_figure

    written = list(out or ())
    if plot is not None:
        check_figure(plot)
        written.append(plot)

    def draw(flown: Mapping[str, Mapping[str, FlightErrors]]) -> None:
        if plot is not None:
            write_figure(comparison_figure(flown), plot)

    with progress_on_terminal(quiet=quiet, verbose=True) as listener:
        table, settings = compare_vehicles(
            recordings, vehicle, out or (), on_flown=draw, on_message=listener.on_message
        )
    if not quiet:
        print_comparison(table, settings, laps=laps, written=written)


def simulate(
    *,
    out: Path,
    asked: Annotated[SimulationOptions, FLATTENED],
    sweep: list[str] | None = None,
    forces: Path | None = None,
    quiet: Quiet = False,
) -> None:
    """Simulate a vehicle and its controller on a trajectory, and write the flight.

    Parameters
    ----------
    out
        Write FILE.csv, or FILE.bag with the topics of a MAVROS lab; .png, .svg and .pdf draw it.
    sweep
        Vary a coefficient: NAME=LOW:HIGH:COUNT. Several of them give all combinations.
    forces
        Write force and moment of each term along the flights into this FILE.csv, too.
    """
    from tuner.cli.tables import print_flights
    from tuner.core.runtime import configure

    configure()
    from tuner.engine import engine_for
    from tuner.evaluate.closed_loop import fly, grid_of
    from tuner.evaluate.simulation_files import Summary, summary_of, write_flights
    from tuner.report.paper import SUFFIXES, check_figure, flight_figure, write_figure

    drawn = out.suffix in SUFFIXES
    if drawn and (sweep or forces):
        raise InputError(out, "a figure is of one flight, without forces", "write a .csv")
    if drawn:
        check_figure(out)
    flights = fly(asked, grid=grid_of(sweep or ()) or None, forces=forces is not None)
    with engine_for(asked.workers, asked.cluster):
        if drawn:
            flight = next(flights)
            write_figure(flight_figure(flight, f"{asked.vehicle}: {asked.trajectory}"), out)
            summaries: tuple[Summary, ...] = (summary_of(flight),)
        else:
            summaries = write_flights(flights, out, forces=forces)
    if not quiet:
        print_flights(summaries, out)


def sensitivity(
    *,
    asked: Annotated[ExaminationOptions, FLATTENED],
    arena: str | None = None,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Report the effect of each coefficient, how well it is known and from which flights.

    Parameters
    ----------
    arena
        Propose next flights that fit into X,Y,Z in m: from wall to wall, and up. Default: what the
        recorded flights took, and a little more.
    """
    from tuner.cli.options import arena_lengths
    from tuner.cli.progress import progress_on_terminal
    from tuner.cli.results import print_sensitivity
    from tuner.core.runtime import configure

    configure()
    from tuner.engine import engine_for
    from tuner.job.sensitivity import examine_vehicle

    with (
        engine_for(asked.workers, asked.cluster),
        progress_on_terminal(quiet=quiet, verbose=verbose) as listener,
    ):
        result = examine_vehicle(
            asked,
            None if arena is None else arena_lengths(arena),
            command=TYPED_WORDS.get(),
            on_message=listener.on_message,
        )
    if not quiet:
        print_sensitivity(result, verbose=verbose)


def export(
    run: Path, /, *, asked: Annotated[ExportOptions, FLATTENED], quiet: Quiet = False
) -> None:
    """Write the coefficients of a run, or a vehicle file, for a simulator.

    A run's are written once its flights fly there as in the run.

    Parameters
    ----------
    run
        Export from this result folder, or this vehicle file, which no flight is compared with.
    """
    from tuner.api import export as export_run

    done = export_run(run, **vars(asked))
    if not quiet:
        from tuner.cli.tables import print_export

        print_export(done)


def audit(
    model: Path,
    /,
    *,
    params: Path | None = None,
    run: Path | None = None,
    json: bool = False,
    quiet: Quiet = False,
) -> int:
    """Check a simulator's model against itself, PX4's parameters and physics.

    The exit status is 1 where a fault is found, 0 where none is.

    Parameters
    ----------
    model
        Audit this model (.sdf or .sdf.jinja), with what it includes from folders beside its own.
    params
        Also hold it against these parameters of PX4 (.params).
    run
        Also say how far each coefficient is from the fitted one of this result folder.
    json
        Print the faults as JSON.
    """
    from tuner.exporters.audit import audit as audited
    from tuner.result import read_run

    found = audited(model, params, None if run is None else read_run(run))
    if json:
        text = {"model": str(found.path), "faults": found.faults, "compared": found.differences}
        print(json_module.dumps(text, indent=2, ensure_ascii=False))
    else:
        from tuner.cli.tables import console

        screen = console()
        for fault in found.faults:
            screen.print(f"{found.path.name}: {fault}", soft_wrap=True)
        for line in found.differences:
            screen.print(line, soft_wrap=True)
        if not found.faults and not quiet:
            screen.print(f"{found.path.name}: no fault found, {found.mass:.4g} kg")
    return 1 if found.faults else 0


def report(
    run: Path,
    /,
    *,
    open_: Annotated[bool, Parameter(name="--open", negative=())] = False,
    plots: bool = False,
    quiet: Quiet = False,
) -> None:
    """Render report.html of a result folder again, from what the folder holds.

    Parameters
    ----------
    run
        The result folder.
    open_
        Show the page in the browser.
    plots
        Also write its figures as SVG, into plots/ of the folder.
    """
    from tuner.report import render

    path = render(run, plots=plots)
    if open_ and not webbrowser.open(path.resolve().as_uri()):
        raise InputError("--open", "finds no browser here", f"open {path} yourself")
    if not quiet:
        print(path)


def bench(
    file: Path, /, *, out: Path | None = None, quiet: Quiet = False, verbose: Verbose = False
) -> None:
    """Estimate coefficients from ground measurements, combine them and test whether they agree.

    Parameters
    ----------
    file
        The list of experiments, bench.yaml.
    out
        Write into this result folder. Default: runs/ and the time.
    """
    from tuner.job.bench import bench as run_bench

    result = run_bench(file, out=out, command=TYPED_WORDS.get())
    if not quiet:
        from tuner.cli.results import print_bench

        print_bench(result, verbose=verbose)
