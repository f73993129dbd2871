"""Functions of Python on a vehicle: simulate it, export it for another simulator."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from tuner.config.job import TrajectoryName
from tuner.core.disk import exists
from tuner.core.errors import ExportError
from tuner.core.runtime import configure
from tuner.engine import engine_for
from tuner.recordings.flight import Array
from tuner.result import Run, read_run
from tuner.vehicle import ControllerFile, VehicleFile

if TYPE_CHECKING:
    from sim_jax.precision import Precision
    from tuner.evaluate.simulate import Simulation
    from tuner.exporters.export import Exported

Named = str | Path
T = TypeVar("T")


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
        Coefficient -> (B,) values: B vehicles fly side by side. `tuner.evaluate.simulate.grid_of`
        makes every combination of several ranges.
    precision
        What to compute in: ``float32`` is twice as fast for many vehicles, and 0.02 mm off.
    forces
        Whether each simulation has ``forces``: what acted along the flight, term by term.
    workers, cluster
        As of `tuner.fit`.

    Returns
    -------
    tuple
        One simulation, or B of them; `tuner.evaluate.write.write_flights` writes them.

    Raises
    ------
    InputError
        Something cannot be flown.
    """
    configure()
    from tuner.evaluate.simulate import fly  # noqa: PLC0415 (jax)

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
                text_of(vehicle),
                text_of(controller),
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
    simulator: str = "",
    accept: str = "",
    draws: int | None = None,
) -> Exported:
    """Write a run's coefficients for a simulator, once they fly there as in it; ``tune export``.

    Parameters
    ----------
    run
        A run, its result folder, or a vehicle file, whose numbers no flight has been compared with.
    format
        The name of a target, as ``yaml``, ``sdf`` or ``px4``.
    into
        With ``sdf``, the model to put them into; None gives the tags alone.
    out
        Where to write; None is the model itself, or ``export/`` in the result folder.
    simulator
        Which of a format's simulators it is for, as of ``tune export``.
    accept
        A reason to export in spite of conditions that are not met.
    draws
        How many draws of the run's joint posterior are written besides, into the folder ``out``.

    Raises
    ------
    ExportError
        A condition is not met, or the file would not read back.
    OutputError
        The file cannot be written.
    """
    configure()
    from tuner.exporters.effective_of_run import kept_effective  # noqa: PLC0415
    from tuner.exporters.export import export as export_run  # noqa: PLC0415 (jax)
    from tuner.exporters.export import export_draws, export_vehicle  # noqa: PLC0415
    from tuner.exporters.refly import refly  # noqa: PLC0415

    if draws is not None:
        if into is not None:
            raise ExportError("--draws", "do not go with --into", "leave one of them out")
        return export_draws(
            run if isinstance(run, Run) else read_run(run),
            format,
            draws,
            refly=refly,
            today=date.today(),
            refit=kept_effective,
            out=None if out is None else Path(out),
            simulator=simulator,
            accept=accept,
        )
    if not isinstance(run, Run) and exists(Path(run)) and Path(run).is_file():
        return export_vehicle(
            Path(run),
            format,
            today=date.today(),
            into=None if into is None else Path(into),
            out=None if out is None else Path(out),
            simulator=simulator,
            accept=accept,
        )
    return export_run(
        run if isinstance(run, Run) else read_run(run),
        format,
        refly=refly,
        refit=kept_effective,
        today=date.today(),  # the user's own day
        into=None if into is None else Path(into),
        out=None if out is None else Path(out),
        simulator=simulator,
        accept=accept,
    )


def text_of(named: Path | T) -> str | T:
    """Return a path as text, and anything else as it is."""
    return str(named) if isinstance(named, Path) else named
