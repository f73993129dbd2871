"""From what a user names to flights in a file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NotRequired, TypedDict, Unpack

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
from tuner.simulation.sweep import grid_of
from tuner.simulation.trajectory import at_speed
from tuner.simulation.write import Summary, write_flights
from tuner.yaml_files.section import Number, Section, build


class Plan(Section):
    """What is flown for how long, ``duration`` in s, and written how often, ``rate`` in Hz."""

    trajectory: TrajectorySettings
    duration: Annotated[Number, Interval(gt=0, le=3600)]
    rate: Annotated[Number, Interval(gt=0, le=10_000)]
    precision: Precision


class Flown(TypedDict):
    """The arguments of `fly` that the command line gives."""

    vehicle: str
    controller: str
    trajectory: Mapping[str, object]
    speed: NotRequired[float | None]
    duration: NotRequired[float]
    rate: NotRequired[float]
    precision: NotRequired[Precision]


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
    )


def simulate_to_file(
    out: Path, *, sweep: Sequence[str] = (), **flown: Unpack[Flown]
) -> tuple[Summary, ...]:
    """Fly, and write the flight or each of a grid.

    Parameters
    ----------
    out
        FILE.csv or FILE.bag.
    sweep
        Each ``name=low:high:count``.
    flown
        As of `fly`.

    Raises
    ------
    InputError
        Something named does not exist or cannot be flown, or the file cannot be written.
    """
    return write_flights(fly(**flown, grid=grid_of(sweep) or None), out)
