"""What the command line does, as functions: the same names, the same defaults, the same errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from tuner.config import ControllerFile, Options, VehicleFile
from tuner.config.job import Method
from tuner.engine import engine_for
from tuner.flights.flight import Array
from tuner.flights.load import load_flight
from tuner.result import Run, read_run
from tuner.runtime import configure
from tuner.trajectory_settings import TrajectoryName

if TYPE_CHECKING:
    from sim_jax.precision import Precision
    from tuner.client.client import Client
    from tuner.comparison.table import Table
    from tuner.exporters.export import Exported
    from tuner.exporters.target import Simulator
    from tuner.job.sensitivity import SensitivityResult
    from tuner.simulation.simulate import Simulation

Named = str | Path
T = TypeVar("T")

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


def fit(
    flights: Sequence[Named],
    *,
    holdout: Sequence[str] | None = None,
    vehicle: Named | VehicleFile | None = None,
    controller: Named | ControllerFile | None = None,
    mass: float | None = None,
    config: Named | None = None,
    free: Sequence[str] | None = None,
    fixed: Sequence[str] | None = None,
    method: Method | None = None,
    seed: int | None = None,
    topics: Named | None = None,
    namespace: str | None = None,
    bench: Named | None = None,
    out: Named | None = None,
    resume: bool = False,
    force: bool = False,
    cross_validate: bool = False,
    bootstrap: int | None = None,
    workers: int | None = None,
    cluster: str | None = None,
) -> Run:
    """Fit the coefficients of a vehicle to recordings, as ``tune --flights`` does.

    Parameters
    ----------
    flights
        Recordings, or globs.
    holdout
        Flights that are evaluated, never fitted.
    vehicle
        Where the search starts: a vehicle, its file, or the name of a shipped one.
    controller
        What flew: a controller, its file, or the name of a shipped one.
    mass
        kg, the weighed take-off mass instead of the vehicle's.
    config
        Job file; None takes the ``tune.yaml`` beside the flights, if there is one.
    free, fixed
        Coefficients: fit exactly the former, or the usual ones except the latter.
    method, seed
        Of the search.
    topics, namespace
        As of `load_flight`.
    bench
        Result folder of ``tune bench``: the search starts from its vehicle, with its prior.
    out
        Result folder; None makes one under ``runs/``.
    resume
        Whether to continue from the folder's checkpoint.
    force
        Whether to search even where the check before the search reports a failure.
    cross_validate
        Whether to fit without each flight in turn as well, into ``cross_validation.csv``, for the
        jackknife's standard errors.
    bootstrap
        How many refits to flights drawn with replacement are made, into ``bootstrap.csv``, for the
        standard errors that follow; None for none.
    workers, cluster
        Local processes, or the cluster file or scheduler, that compute what is independent; the
        numbers are the same. A script that names them needs ``if __name__ == "__main__":``.

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

    options = _options(
        flights,
        holdout=holdout,
        vehicle=vehicle,
        controller=controller,
        mass=mass,
        config=config,
        fit=free,
        fix=fixed,
        method=method,
        seed=seed,
        topics=topics,
        namespace=namespace,
        bench=None if bench is None else str(bench),
    )
    with engine_for(workers, cluster):
        folder, _ = run(
            options,
            out=None if out is None else Path(out),
            resume=resume,
            force=force,
            cross_validated=cross_validate,
            refits=bootstrap,
            command=f"tuner.fit from Python: {options.flights}",
        )
    return read_run(folder)


def compare(
    flights: Sequence[Named],
    vehicles: Sequence[Named] | Mapping[str, Named | VehicleFile],
    *,
    controller: Named | ControllerFile | None = None,
    config: Named | None = None,
    topics: Named | None = None,
    namespace: str | None = None,
    out: Sequence[Named] = (),
) -> Table:
    """Simulate recorded flights with several vehicles and tabulate the RMSE, as ``tune compare``.

    Parameters
    ----------
    flights
        Recordings, or globs.
    vehicles
        Files or names of shipped ones; or label -> one of those, or a vehicle.
    controller, config, topics, namespace
        As of `fit`.
    out
        Files to write, by suffix .csv, .json or .html.

    Returns
    -------
    Table
        ``table.best`` is the closest set, ``table.of(vehicle, flight)`` its RMSE.

    Raises
    ------
    InputError
        The input cannot be used.
    """
    configure()
    from tuner.comparison.compare import compare as compare_vehicles  # noqa: PLC0415 (jax)

    options = _options(
        flights,
        controller=controller,
        config=config,
        topics=topics,
        namespace=namespace,
    )
    labelled = vehicles if isinstance(vehicles, Mapping) else {str(name): name for name in vehicles}
    sets: dict[str, str | VehicleFile] = {k: _text(v) for k, v in labelled.items()}
    table, _ = compare_vehicles(options, sets, [Path(path) for path in out])
    return table


def sensitivity(
    flights: Sequence[Named],
    *,
    vehicle: Named | VehicleFile | None = None,
    controller: Named | ControllerFile | None = None,
    mass: float | None = None,
    config: Named | None = None,
    free: Sequence[str] | None = None,
    fixed: Sequence[str] | None = None,
    topics: Named | None = None,
    namespace: str | None = None,
    arena: Sequence[float] | None = None,
    global_method: Literal["morris", "sobol"] | None = None,
    samples: int | None = None,
    span: float = 30.0,
    profile: Sequence[str] | None = None,
    out: Named | None = None,
    workers: int | None = None,
    cluster: str | None = None,
) -> SensitivityResult:
    """Report what recordings say about each coefficient of a vehicle, as ``tune sensitivity`` does.

    Parameters
    ----------
    flights
        Recordings, or globs.
    vehicle, controller, mass, config, topics, namespace
        As of `fit`; nothing is fitted, held-out flights are examined like the others.
    free, fixed
        Coefficients that are judged as if they were fitted together, as of `fit`.
    arena
        m from wall to wall along x and y, about the origin, and up: what the next flight must fit
        into. None takes what the recorded flights took, and a little more.
    global_method
        Also computes the indices of Morris or Sobol over the range of the coefficients.
    samples
        Trajectories (Morris) or base points (Sobol) that they are computed from.
    span
        Percent by which coefficients are varied for them where the job file gives no bounds.
    profile
        Coefficients whose likelihood is profiled: the others are fitted again along a grid.
    out
        Folder that tables and report are written into; None makes one under ``runs/``.
    workers, cluster
        As of `fit`.

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
    from tuner.job.folder import folder_for  # noqa: PLC0415
    from tuner.job.sensitivity import SensitivityRequest, examine_vehicle  # noqa: PLC0415 (jax)

    options = _options(
        flights,
        vehicle=vehicle,
        controller=controller,
        mass=mass,
        config=config,
        fit=free,
        fix=fixed,
        topics=topics,
        namespace=namespace,
    )
    with engine_for(workers, cluster):
        return examine_vehicle(
            options,
            SensitivityRequest(
                arena=arena,
                global_method=global_method,
                samples=samples,
                span=span / 100.0,
                profiles=tuple(profile or ()),
            ),
            out=folder_for(None if out is None else Path(out)),
            command=f"tuner.sensitivity from Python: {options.flights}",
        )


def simulate(
    trajectory: TrajectoryName,
    *,
    vehicle: Named | VehicleFile = "hovergames",
    controller: Named | ControllerFile = "hovergames",
    radius: float = 2.0,
    omega: float = 0.7,
    speed_scale: float = 2.1,
    speed: float | None = None,
    yaw_rate: float = 2.0,
    duration: float = 40.0,
    rate: float = 100.0,
    grid: Mapping[str, Array] | None = None,
    precision: Precision = "float64",
    forces: bool = False,
    workers: int | None = None,
    cluster: str | None = None,
) -> tuple[Simulation, ...]:
    """Simulate a trajectory, as ``tune simulate`` does.

    Parameters
    ----------
    trajectory
        Which shape, flown from rest.
    vehicle, controller
        What flies: the thing itself, its file, or the name of a shipped one.
    radius, omega
        m and rad/s.
    speed_scale
        The publisher's velocity scaler.
    speed
        m/s at which the reference peaks; instead of ``speed_scale``.
    yaw_rate
        rad/s, of the yaw spin.
    duration
        s.
    rate
        Hz of the result.
    grid
        Coefficient -> (B,) values: B vehicles fly side by side. `tuner.simulation.sweep.grid_of`
        makes every combination of several ranges.
    precision
        What to compute in: ``float32`` is twice as fast for many vehicles, and 0.02 mm off.
    forces
        Whether each simulation has ``forces``: what acted along the flight, term by term.
    workers, cluster
        As of `fit`.

    Returns
    -------
    tuple
        One simulation, or B of them; `tuner.simulation.write.write_flights` writes them.

    Raises
    ------
    InputError
        Something cannot be flown.
    """
    configure()
    from tuner.simulation.plan import fly  # noqa: PLC0415 (jax)

    shape = {
        "name": trajectory,
        "radius": radius,
        "omega": omega,
        "speed_scale": speed_scale,
        "yaw_rate": yaw_rate,
    }
    with engine_for(workers, cluster):
        return tuple(
            fly(
                _text(vehicle),
                _text(controller),
                shape,
                speed=speed,
                duration=duration,
                rate=rate,
                grid=grid,
                precision=precision,
                forces=forces,
            )
        )


def export(
    run: Run | Named,
    format: str,  # noqa: A002 (the option's name)
    *,
    into: Named | None = None,
    out: Named | None = None,
    simulator: Simulator = "gazebo-classic",
    accept: str = "",
) -> Exported:
    """Write a run's coefficients for a simulator, once they fly there as in it; ``tune export``.

    Parameters
    ----------
    run
        A run, or its result folder.
    format
        The name of a target, as ``yaml``, ``sdf`` or ``px4``.
    into
        With ``sdf``, the model to put them into; None gives the tags alone.
    out
        Where to write; None is the model itself, or ``export/`` in the result folder.
    simulator
        Whose plugins tags without a model are for.
    accept
        A reason to export in spite of conditions that are not met.

    Raises
    ------
    ExportError
        A condition is not met, or the file would not read back.
    OutputError
        The file cannot be written.
    """
    configure()
    from tuner.exporters.export import export as export_run  # noqa: PLC0415 (jax)
    from tuner.exporters.refly import refly  # noqa: PLC0415

    return export_run(
        run if isinstance(run, Run) else read_run(run),
        format,
        refly=refly,
        today=date.today(),  # the user's own day
        into=None if into is None else Path(into),
        out=None if out is None else Path(out),
        simulator=simulator,
        accept=accept,
    )


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
    from tuner.client.client import Client  # noqa: PLC0415 (an extra)
    from tuner.client.connection import Connection  # noqa: PLC0415

    return Client(Connection(url, token))


def _options(flights: Sequence[Named], **given: Any) -> Options:
    settings: dict[str, Any] = {name: _text(value) for name, value in given.items()}
    return Options([str(path) for path in flights], **settings)


def _text(named: Path | T) -> str | T:
    """Return a path as text, and anything else as it is."""
    return str(named) if isinstance(named, Path) else named
