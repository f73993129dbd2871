"""From what a user names to flights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from sim_jax.precision import Precision
from tuner.config import (
    ControllerFile,
    TrajectorySettings,
    VehicleFile,
    check_names,
    find_config,
    read_controller,
    read_vehicle,
)
from tuner.flights.flight import Array
from tuner.simulation.simulate import Simulation, simulate
from tuner.simulation.trajectory import at_speed
from tuner.yaml_files.section import Number, Section, build


class Plan(Section):
    """What is flown for how long, ``duration`` in s, and written how often, ``rate`` in Hz."""

    trajectory: TrajectorySettings
    duration: Annotated[Number, Interval(gt=0, le=3600)]
    rate: Annotated[Number, Interval(gt=0, le=10_000)]
    precision: Precision


def fly(
    vehicle: str | VehicleFile,
    controller: str | ControllerFile,
    trajectory: Mapping[str, object],
    *,
    speed: float | None = None,
    duration: float = 40.0,
    rate: float = 100.0,
    grid: Mapping[str, Array] | None = None,
    precision: Precision = "float64",
    forces: bool = False,
) -> Iterator[Simulation]:
    """Fly a trajectory once, or with each vehicle of a grid.

    Parameters
    ----------
    vehicle, controller
        What flies: the thing itself, a path, or the name of a shipped file.
    trajectory
        The fields of `TrajectorySettings`.
    speed
        m/s at which the reference peaks; None keeps the velocity scaler.
    duration
        s.
    rate
        Hz of the result.
    grid
        Coefficient -> (B,) values.
    precision
        What to compute in.
    forces
        Whether to give what acted along each flight, term by term.

    Raises
    ------
    InputError
        Something named does not exist, or cannot be flown.
    """
    options = {
        "trajectory": dict(trajectory),
        "duration": duration,
        "rate": rate,
        "precision": precision,
    }
    plan = build(Plan, options, "command line")
    shape = plan.trajectory if speed is None else at_speed(plan.trajectory, speed)
    check_names(grid or (), "grid")
    if isinstance(vehicle, str):
        vehicle = read_vehicle(find_config("vehicles", vehicle, Path()))
    if isinstance(controller, str):
        controller = read_controller(find_config("controllers", controller, Path()))
    return simulate(
        vehicle,
        controller,
        shape,
        duration=plan.duration,
        rate=plan.rate,
        grid=grid,
        precision=plan.precision,
        forces=forces,
    )
