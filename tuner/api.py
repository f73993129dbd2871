"""What the command line does, as functions: the same names, the same defaults, the same errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tuner.config import Options
from tuner.config.job import Method
from tuner.core.runtime import configure
from tuner.engine import engine_for
from tuner.recordings.loader import load_flight
from tuner.result import Run, read_run
from tuner.vehicle import ControllerFile, VehicleFile
from tuner.vehicle_api import Named, export, simulate, text_of

if TYPE_CHECKING:
    from tuner.client.client import Client
    from tuner.evaluate.comparison_table import Table
    from tuner.job.sensitivity import SensitivityResult

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

    options = Options.of(
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
        bench=bench,
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
    from tuner.evaluate.compare import compare as compare_vehicles  # noqa: PLC0415 (jax)

    options = Options.of(
        flights, controller=controller, config=config, topics=topics, namespace=namespace
    )
    labelled = vehicles if isinstance(vehicles, Mapping) else {str(name): name for name in vehicles}
    sets: dict[str, str | VehicleFile] = {k: text_of(v) for k, v in labelled.items()}
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

    options = Options.of(
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
