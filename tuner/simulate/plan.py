"""From what a user names to flights in a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from tuner.config import TrajectorySettings, find_config, read_controller, read_vehicle
from tuner.config.model import Number, Section, build
from tuner.simulate.simulate import simulate
from tuner.simulate.sweep import grid_of
from tuner.simulate.trajectory import at_speed
from tuner.simulate.write import Summary, write_flights


class Plan(Section):
    """What is flown for how long, ``duration`` in s, and written how often, ``rate`` in Hz."""

    trajectory: TrajectorySettings
    duration: Annotated[Number, Interval(gt=0, le=3600)]
    rate: Annotated[Number, Interval(gt=0, le=10_000)]


def simulate_to_file(
    out: Path,
    *,
    vehicle: str,
    controller: str,
    trajectory: Mapping[str, object],
    speed: float | None = None,
    duration: float = 40.0,
    rate: float = 100.0,
    sweep: Sequence[str] = (),
) -> tuple[Summary, ...]:
    """Fly a trajectory and write the flight, or each of a grid.

    Parameters
    ----------
    out
        FILE.csv or FILE.bag.
    vehicle, controller
        Paths, or names of shipped files.
    trajectory
        The fields of `TrajectorySettings`.
    speed
        m/s at which the reference peaks; None keeps the velocity scaler.
    duration
        s.
    rate
        Hz of the written samples.
    sweep
        Each ``name=low:high:count``.

    Raises
    ------
    InputError
        Something named does not exist or cannot be flown, or the file cannot be written.
    """
    said = {"trajectory": dict(trajectory), "duration": duration, "rate": rate}
    plan = build(Plan, said, "command line")
    shape = plan.trajectory if speed is None else at_speed(plan.trajectory, speed)
    grid = grid_of(sweep)
    flown = read_vehicle(find_config("vehicles", vehicle, Path()))
    controllers = read_controller(find_config("controllers", controller, Path()))
    return write_flights(
        simulate(
            flown, controllers, shape, duration=plan.duration, rate=plan.rate, grid=grid or None
        ),
        out,
    )
