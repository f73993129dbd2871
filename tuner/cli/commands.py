"""The commands of `tune` beside the fit and the service."""

from __future__ import annotations

import json as json_module
import math
import sys
import webbrowser
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from tuner.cli.tune import FLATTENED, TYPED_WORDS, Quiet, Verbose
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
    from tuner.vehicle.scaling_laws import Airframe


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
        from tuner.recordings.inspection_rules import suggested_map

        for path in paths:
            sys.stdout.write(suggested_map(path))
        return
    from tuner.job.recording_verdict import in_words, verdict_of, with_verdict
    from tuner.recordings.inspection import as_json, inspect_recordings

    inspections, errors = inspect_recordings(
        paths, topics=reading.topics, namespace=reading.namespace or ""
    )
    verdicts = {
        seen.path: verdict_of(seen, **vars(reading), vehicle=vehicle) for seen in inspections
    }
    inspections = tuple(with_verdict(seen, verdicts[seen.path]) for seen in inspections)
    if json:
        print(as_json(inspections, errors, {path: asdict(of) for path, of in verdicts.items()}))
    else:
        from tuner.cli.results import console, inspections_drawn

        words = {path: in_words(verdict) for path, verdict in verdicts.items()}
        console().print(inspections_drawn(inspections, words))
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
    from tuner.cli.results import print_comparison
    from tuner.core.runtime import configure

    configure()
    from tuner.report.comparison import compare as compare_vehicles

    with progress_on_terminal(quiet=quiet, verbose=True) as listener:
        table, settings = compare_vehicles(
            recordings, vehicle, out or (), plot, on_message=listener.on_message
        )
    if not quiet:
        written = [*(out or ()), *([] if plot is None else [plot])]
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
    from tuner.cli.results import print_flights
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
    from tuner.cli.progress import progress_on_terminal
    from tuner.cli.results import print_sensitivity
    from tuner.cli.tune import arena_lengths
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
        from tuner.cli.results import print_export

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
        from tuner.cli.results import console

        screen = console()
        for fault in found.faults:
            screen.print(f"{found.path.name}: {fault}", soft_wrap=True)
        for line in found.differences:
            screen.print(line, soft_wrap=True)
        if not found.faults and not quiet:
            without = f" without {', '.join(found.unread)}, not read" if found.unread else ""
            screen.print(f"{found.path.name}: no fault found, {found.mass:.4g} kg{without}")
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


INCH = 0.0254
QUESTIONS = {
    "--mass": (0.01, 100.0, "kg", "Mass, ready to fly [kg]: "),
    "--wheelbase": (0.03, 5.0, "m", "Distance between opposite motors [m]: "),
    "--cells": (1.0, 24.0, "cells", "Cells of the battery in series (empty if not known): "),
    "--motor-kv": (30.0, 40000.0, "rpm/V", "kV of the motors [rpm/V] (empty if not known): "),
    "--hover-throttle": (
        0.05,
        0.95,
        "of full command",
        "Throttle in hover, 0 to 1 (empty if not known): ",
    ),
    "--rotor-height": (
        -1.0,
        1.0,
        "m",
        "Height of the rotors above the centre of mass [m] (empty: 0): ",
    ),
}
"""Option -> the smallest and the largest that it may be, its unit, and how it is asked for."""


def new_vehicle(
    *,
    out: Path,
    mass: float | None = None,
    wheelbase: float | None = None,
    layout: Literal["x", "plus"] = "x",
    propeller: str | None = None,
    cells: int | None = None,
    motor_kv: Annotated[float | None, Parameter(name="--motor-kv")] = None,
    hover_throttle: float | None = None,
    rotor_height: float | None = None,
    like: Literal["hovergames", "crazyflie"] | None = None,
    quiet: Quiet = False,
) -> None:
    """Write a starting vehicle file, and a job file with priors, from what can be read off it.

    On a terminal it asks for what was not given; piped, it never asks.

    Parameters
    ----------
    out
        Write this vehicle file, and beside it a job file that ends in .job.yaml.
    mass
        Give the mass ready to fly, in kg.
    wheelbase
        Give the distance between opposite motors, in m.
    layout
        Arrange the rotors so; the simulated mixer is that of the X.
    propeller
        Give diameter and pitch in inch, as 11x4.7.
    cells
        Give the battery's cells in series; 1 is taken for coreless motors.
    motor_kv
        Give the motors' speed per voltage without load, in rpm/V.
    hover_throttle
        Give the command in hover, 0 to 1, of any log.
    rotor_height
        Give the rotors' height above the centre of mass, in m. Default: 0.
    like
        Scale from this known vehicle, and take from it what is not given.
    """
    from tuner.vehicle.scaling_laws import KNOWN_AIRFRAMES
    from tuner.vehicle.scaling_laws import new_vehicle as make

    if layout != "x":
        remedy = "describe it with the body axes turned by 45 degrees, as an x"
        raise InputError("--layout", "the simulated mixer is that of the X", remedy)
    asking = like is None and sys.stdin.isatty() and sys.stdout.isatty()
    given = {"--mass": mass, "--wheelbase": wheelbase, "--cells": cells,
             "--motor-kv": motor_kv, "--hover-throttle": hover_throttle,
             "--rotor-height": rotor_height}  # fmt: skip
    if asking:
        for option, (*_, question) in QUESTIONS.items():
            if given[option] is None:
                given[option] = _parse_answer(option, input(question))
        if propeller is None:
            propeller = input("Propeller, diameter x pitch in inch, as 11x4.7: ").strip()
    for option, value in given.items():
        _check(option, value)
    airframe = _airframe(given, propeller, KNOWN_AIRFRAMES.get(like or ""))
    estimates = make(airframe, out, like=like)
    if not quiet:
        from tuner.cli.results import print_estimates

        print_estimates(estimates, out)


def _airframe(
    given: Mapping[str, float | None], propeller: str | None, known: Airframe | None
) -> Airframe:
    """Return the given properties, and the others of a known vehicle."""
    from tuner.vehicle.scaling_laws import Airframe

    numbers = {option: value for option, value in given.items() if value is not None}
    if known is not None:
        numbers = {"--mass": known.mass, "--wheelbase": known.wheelbase} | numbers
    for option in ("--mass", "--wheelbase"):
        if option not in numbers:
            raise InputError(option, "is missing", "give it, or --like a known vehicle")
    if propeller is not None:
        diameter, pitch = _size(propeller)
    elif known is not None:
        diameter, pitch = known.diameter, known.pitch
    else:
        raise InputError("--propeller", "is missing", "give it as 11x4.7, or --like")
    drive = known if known is not None and not propeller else None
    cell_count = numbers.get("--cells", drive.cells if drive else None)
    kv = numbers.get("--motor-kv")
    return Airframe(
        mass=numbers["--mass"],
        wheelbase=numbers["--wheelbase"],
        diameter=diameter,
        pitch=pitch,
        cells=None if cell_count is None else int(cell_count),
        motor_kv=kv * math.pi / 30 if kv is not None else drive.motor_kv if drive else None,
        hover_throttle=numbers.get("--hover-throttle", drive.hover_throttle if drive else None),
        rotor_height=numbers.get("--rotor-height", known.rotor_height if known else 0.0),
    )


def _parse_answer(option: str, text: str) -> float | None:
    try:
        return float(text) if text.strip() else None
    except ValueError:
        raise InputError(option, f"'{text}' is no number", "write it as 2.2") from None


def _check(option: str, value: float | None) -> None:
    low, high, unit, _ = QUESTIONS[option]
    if value is not None and not low <= value <= high:
        remedy = f"give {low:g} to {high:g} {unit}"
        raise InputError(option, f"{value:g} is not one of a multirotor", remedy)


def _size(word: str) -> tuple[float, float]:
    """Return diameter and pitch, m, of ``11x4.7``."""
    try:
        diameter, pitch = (float(part) for part in word.lower().split("x"))
    except ValueError:
        diameter = pitch = math.nan
    if not (0.5 <= diameter <= 60 and 0.1 <= pitch / diameter <= 1.5):
        what = f"'{word}' is no propeller of a multirotor"
        raise InputError("--propeller", what, "write diameter and pitch in inch, as 11x4.7")
    return diameter * INCH, pitch * INCH
