"""From what a user names, a vehicle, a trajectory and ``name=low:high:count``, to flights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from annotated_types import Interval

from sim_jax.precision import Precision
from tuner.config import TrajectorySettings
from tuner.core.errors import InputError, did_you_mean
from tuner.core.shipped import find_config
from tuner.core.yaml_section import Number, Section, build
from tuner.evaluate.simulate import Simulation, simulate
from tuner.objective.trajectory import at_speed
from tuner.recordings.flight import Array
from tuner.vehicle import (
    COEFFICIENTS,
    ControllerFile,
    VehicleFile,
    check_names,
    read_controller,
    read_vehicle,
)

#: A grid of more flights than this is taken for a mistake.
MAX_FLIGHTS = 100_000


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


def grid_of(sweeps: Sequence[str]) -> dict[str, Array]:
    """Return coefficient -> (B,) values of every combination, the last sweep varying fastest.

    Parameters
    ----------
    sweeps
        Each ``name=low:high:count``, both ends included; ``name=value`` sets one value.

    Raises
    ------
    InputError
        Says which sweep is wrong, and how to write it.
    """
    axes = dict(_axis(sweep) for sweep in sweeps)
    if len(axes) < len(sweeps):
        raise InputError("--sweep", "names a coefficient twice", "sweep each once")
    count = int(np.prod([len(values) for values in axes.values()], dtype=np.int64)) if axes else 0
    if count > MAX_FLIGHTS:
        raise InputError("--sweep", f"asks for {count} flights", f"at most {MAX_FLIGHTS}")
    mesh = np.meshgrid(*axes.values(), indexing="ij")
    return {name: values.ravel() for name, values in zip(axes, mesh, strict=True)}


def _axis(sweep: str) -> tuple[str, Array]:
    name, _, span = sweep.partition("=")
    if name not in COEFFICIENTS:
        raise InputError(
            "--sweep", f"unknown coefficient '{name}'", did_you_mean(name, COEFFICIENTS)
        )
    try:
        match [float(word) for word in span.split(":")]:
            case [value]:
                values = np.array([value])
            case [low, high, count] if count == int(count) and 1 <= count <= MAX_FLIGHTS:
                values = np.linspace(low, high, int(count))
            case _:
                raise ValueError
        if not np.isfinite(values).all():
            raise ValueError
    except (ValueError, OverflowError):
        raise InputError(
            "--sweep", f"'{sweep}' is no range", "write motor_constant=1.2e-5:1.6e-5:9"
        ) from None
    return name, values
