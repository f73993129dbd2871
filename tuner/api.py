"""The commands as functions of Python: the same names, defaults and errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from threadpoolctl import threadpool_limits

from tuner import result as results
from tuner.config import TrajectoryName
from tuner.core.disk import exists
from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.core.runtime import configure
from tuner.engine import engine_for
from tuner.options import (
    ExaminationOptions,
    ExportOptions,
    Options,
    RecordingOptions,
    SimulationOptions,
    check_model,
    plain,
    taking,
)
from tuner.recordings import loader
from tuner.result import Run
from tuner.vehicle import VehicleFile

if TYPE_CHECKING:
    from tuner.evaluate.closed_loop import Simulation
    from tuner.evaluate.records import RmseTable
    from tuner.exporters.export import ExportedFile
    from tuner.job.sensitivity import SensitivityResult
    from tuner.service.client import Client

Named = str | Path

__all__ = [
    "compare",
    "connect",
    "export",
    "fit",
    "load_flight",
    "read_run",
    "sensitivity",
    "simulate",
]


F = TypeVar("F", bound=Callable[..., Any])
ONE_THREAD: Callable[[F], F] = threadpool_limits.wrap(limits=1, user_api="blas")
"""While a job runs, as for the command: matrices are small, and sums the same on any machine."""


load_flight = taking()(loader.load_flight)
read_run = taking()(results.read_run)


@taking(Options)
@ONE_THREAD
def fit(flights: Named | Sequence[Named], **options: Any) -> Run:
    """Fit the coefficients of a vehicle to recordings, as ``tune --flights`` does.

    Parameters
    ----------
    flights
        Recordings, or globs.
    options
        Those of `tune` by their names, as ``cross_validate=True``: all fields of `Options`. ``fit``
        and ``fix`` are called ``free`` and ``fixed``; ``vehicle`` and ``controller`` may be such a
        thing itself. A script that names ``workers`` needs ``if __name__ == "__main__":``.

    Returns
    -------
    Run
        The result folder, read: ``run.vehicle`` has the best coefficients, ``run.result`` the rest.

    Raises
    ------
    InputError
        The input cannot be used; one line says what to do.
    """
    configure()
    from tuner.job.run import run  # noqa: PLC0415 (jax)

    given = Options.of(flights=flights, **options)
    with engine_for(given.workers, given.cluster):
        folder, _ = run(
            given,
            out=given.out,
            resume=given.resume,
            command=f"tuner.fit from Python: {given.flights}",
        )
    return read_run(folder)


@taking(RecordingOptions)
def compare(
    flights: Named | Sequence[Named],
    vehicles: Named | Sequence[Named] | Mapping[str, Named | VehicleFile],
    *,
    out: Sequence[Named] = (),
    **options: Any,
) -> RmseTable:
    """Simulate recorded flights with several vehicles and tabulate the RMSE, as ``tune compare``.

    Parameters
    ----------
    flights
        Recordings, or globs.
    vehicles
        Files or names of shipped ones; or label -> one of those, or a vehicle.
    out
        Files to write, by suffix .csv, .json or .html.
    options
        ``controller``, ``config``, ``topics`` and ``namespace`` as of `fit`.

    Returns
    -------
    RmseTable
        ``table.best`` is the closest set, ``table.of(vehicle, flight)`` its RMSE.

    Raises
    ------
    InputError
        The input cannot be used.
    """
    configure()
    from tuner.report.comparison import compare as compare_vehicles  # noqa: PLC0415 (jax)

    given = RecordingOptions.of(flights=flights, **options)
    names = [vehicles] if isinstance(vehicles, Named) else vehicles
    labelled = names if isinstance(names, Mapping) else {str(name): name for name in names}
    sets: dict[str, str | VehicleFile] = {str(k): plain(v) for k, v in labelled.items()}
    for vehicle in sets.values():
        check_model("vehicle", vehicle)
    table, _ = compare_vehicles(given, sets, [Path(path) for path in out])
    return table


@taking(ExaminationOptions)
@ONE_THREAD
def sensitivity(
    flights: Named | Sequence[Named],
    *,
    arena: Sequence[float] | None = None,
    **options: Any,
) -> SensitivityResult:
    """Report what recordings say about each coefficient of a vehicle, as ``tune sensitivity`` does.

    Parameters
    ----------
    flights
        Recordings, or globs.
    arena
        m from wall to wall along x and y, about the origin, and up: what the next flight must fit
        into. None takes what the recorded flights took, and a little more.
    options
        Those of `tune sensitivity` by their names: all fields of `ExaminationOptions`, as of `fit`;
        ``global_`` is called ``global_method``. Nothing is fitted: the coefficients that would be
        are judged, and held-out flights examined like the others.

    Returns
    -------
    SensitivityResult
        ``knowledge.coefficients`` has each coefficient's verdict, interval and origin,
        ``knowledge.outputs`` what it does to each signal, ``proposals`` what to fly next, and
        ``folder`` the tables and the report.

    Raises
    ------
    InputError
        The input cannot be used; one line says what to do.
    """
    configure()
    from tuner.job.sensitivity import examine_vehicle  # noqa: PLC0415 (jax)

    asked = ExaminationOptions.of(flights=flights, **options)
    with engine_for(asked.workers, asked.cluster):
        command = f"tuner.sensitivity from Python: {asked.flights}"
        return examine_vehicle(asked, arena, command=command)


@taking()
def connect(url: str | None = None, *, token: str | None = None) -> Client:
    """Return a tuning service, whose ``fit`` is `fit` on its machine.

    Parameters
    ----------
    url
        Its address; None takes ``TUNE_SERVER``, or the one that `tune serve` listens to.
    token
        That its server demands; None takes ``TUNE_TOKEN``.

    Raises
    ------
    InputError
        The address is none, or the extra ``service`` is not installed.
    """
    from tuner.service.client import Client  # noqa: PLC0415 (an extra)

    return Client(url, token)


@taking(SimulationOptions)
def simulate(
    trajectory: TrajectoryName,
    *,
    grid: Mapping[str, Array] | None = None,
    forces: bool = False,
    **options: Any,
) -> tuple[Simulation, ...]:
    """Simulate a trajectory, as ``tune simulate`` does.

    Parameters
    ----------
    trajectory
        Which shape, flown from rest.
    grid
        Coefficient -> (B,) values: B vehicles fly side by side. Every combination of several ranges
        is made by `tuner.evaluate.closed_loop.grid_of`.
    forces
        Whether each simulation has ``forces``: what acted along the flight, term by term.
    options
        Those of `tune simulate` by their names: all other fields of `SimulationOptions`.
        ``vehicle`` and ``controller`` may be such a thing itself.

    Returns
    -------
    tuple
        One simulation, or B of them; `tuner.evaluate.simulation_files.write_flights` writes them.

    Raises
    ------
    InputError
        Something cannot be flown.
    """
    configure()
    from tuner.evaluate.closed_loop import fly  # noqa: PLC0415 (jax)

    asked = SimulationOptions.of(trajectory=trajectory, **options)
    with engine_for(asked.workers, asked.cluster):
        return tuple(fly(asked, grid=grid, forces=forces))


@taking(ExportOptions)
def export(run: Run | Named, format: str, **options: Any) -> ExportedFile:  # noqa: A002 (the option's name)
    """Write a run's coefficients for a simulator, once they fly there as in it; ``tune export``.

    Parameters
    ----------
    run
        A run, its result folder, or a vehicle file, whose numbers no flight has been compared with.
    format
        The name of a target, as ``yaml``, ``sdf`` or ``px4``.
    options
        Those of `tune export` by their names: all other fields of `ExportOptions`.

    Raises
    ------
    ExportError
        A condition is not met, or the file would not read back.
    OutputError
        The file cannot be written.
    """
    configure()
    from tuner.exporters.export import export as export_run  # noqa: PLC0415 (jax)
    from tuner.exporters.export import export_draws, export_vehicle  # noqa: PLC0415

    asked = ExportOptions.of(format=format, **options)
    today = date.today()  # the user's own day
    if asked.draws is not None and asked.into is not None:
        raise ExportError("--draws", "do not go with --into", "leave one of them out")
    if isinstance(run, Run):
        of = run
    elif asked.draws is None and exists(Path(run)) and Path(run).is_file():
        return export_vehicle(Path(run), asked, today=today)
    else:
        of = read_run(run)
    writes = export_run if asked.draws is None else export_draws
    return writes(of, asked, today=today)
