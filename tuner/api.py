"""The commands as functions of Python: the same names, defaults and errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from threadpoolctl import threadpool_limits

from tuner.core.runtime import configure
from tuner.engine import engine_for
from tuner.options import ExaminationOptions, Options, RecordingOptions, taking
from tuner.recordings.loader import load_flight
from tuner.result import Run, read_run
from tuner.vehicle import VehicleFile
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


F = TypeVar("F", bound=Callable[..., Any])
ONE_THREAD: Callable[[F], F] = threadpool_limits.wrap(limits=1, user_api="blas")
"""While a job runs, as for the command: matrices are small, and sums the same on any machine."""


@taking(Options)
@ONE_THREAD
def fit(flights: Sequence[Named], **options: Any) -> Run:
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

    given = Options.of(flights, **options)
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
    flights: Sequence[Named],
    vehicles: Sequence[Named] | Mapping[str, Named | VehicleFile],
    *,
    out: Sequence[Named] = (),
    **options: Any,
) -> Table:
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
    Table
        ``table.best`` is the closest set, ``table.of(vehicle, flight)`` its RMSE.

    Raises
    ------
    InputError
        The input cannot be used.
    """
    configure()
    from tuner.evaluate.compare import compare as compare_vehicles  # noqa: PLC0415 (jax)

    given = RecordingOptions.of(flights, **options)
    labelled = vehicles if isinstance(vehicles, Mapping) else {str(name): name for name in vehicles}
    sets: dict[str, str | VehicleFile] = {k: text_of(v) for k, v in labelled.items()}
    table, _ = compare_vehicles(Options(**vars(given)), sets, [Path(path) for path in out])
    return table


@taking(ExaminationOptions)
@ONE_THREAD
def sensitivity(
    flights: Sequence[Named],
    *,
    arena: Sequence[float] | None = None,
    global_method: Literal["morris", "sobol"] | None = None,
    samples: int | None = None,
    span: float = 30.0,
    profile: Sequence[str] | None = None,
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
    global_method
        Also computes the indices of Morris or Sobol over the range of the coefficients.
    samples
        Trajectories (Morris) or base points (Sobol) that they are computed from.
    span
        Percent by which coefficients are varied for them where the job file gives no bounds.
    profile
        Coefficients whose likelihood is profiled: the others are fitted again along a grid.
    options
        ``vehicle``, ``controller``, ``mass``, ``config``, ``free``, ``fixed``, ``topics``,
        ``namespace``, ``out``, ``workers`` and ``cluster`` as of `fit`. Nothing is fitted: the
        coefficients that would be are judged, and held-out flights examined like the others.

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

    given = ExaminationOptions.of(flights, **options)
    with engine_for(given.workers, given.cluster):
        return examine_vehicle(
            Options(**vars(given)),
            SensitivityRequest(
                arena=arena,
                global_method=global_method,
                samples=samples,
                span=span / 100.0,
                profiles=tuple(profile or ()),
            ),
            out=folder_for(given.out),
            command=f"tuner.sensitivity from Python: {given.flights}",
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

    return Client(url, token)
