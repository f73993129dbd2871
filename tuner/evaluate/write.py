"""Simulated flights into a file, and what is worth knowing of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.core.disk import check_file
from tuner.core.errors import InputError
from tuner.evaluate.bag import write_bag
from tuner.evaluate.simulate import Simulation
from tuner.evaluate.simulation_table import flights_below_each_other, write_csv, write_forces


@dataclass(frozen=True)
class Summary:
    """One simulated flight in a line.

    Attributes
    ----------
    coefficients
        What was varied.
    crash_time
        s; None for a flight that did not crash.
    top_speed
        m/s.
    tracking_rmse
        (x, y, z) m between the vehicle and its reference.
    """

    coefficients: Mapping[str, float]
    crash_time: float | None
    top_speed: float
    tracking_rmse: tuple[float, float, float]


def write_flights(
    simulations: Iterable[Simulation], path: Path, *, forces: Path | None = None
) -> tuple[Summary, ...]:
    """Write flights as they come, as ``.csv`` or one of them as a ROS 1 ``.bag``.

    Parameters
    ----------
    simulations
        The flights, with their forces where ``forces`` is given.
    path
        Where they go.
    forces
        A ``.csv`` for what acted along them, term by term (`tuner.evaluate.forces`).

    Raises
    ------
    InputError
        A file's suffix is another, several flights are to go into one bag, or it cannot be
        written.
    """
    writers: dict[str, Callable[[Iterator[Simulation], Path], None]] = {
        ".csv": write_csv,
        ".bag": _write_only_one,
    }
    if path.suffix not in writers:
        raise InputError(path, f"no flight is written as '{path.suffix}'", "name a .csv or a .bag")
    check_file(path)
    if forces is not None:
        if forces.suffix != ".csv" or forces == path:
            raise InputError(forces, "forces are written as a .csv of their own", "name one")
        check_file(forces)
    summaries: list[Summary] = []
    with nullcontext() if forces is None else flights_below_each_other(forces) as append:

        def passing() -> Iterator[Simulation]:
            for simulation in simulations:
                summaries.append(summary_of(simulation))
                if append is not None:
                    write_forces(simulation, append)
                yield simulation

        writers[path.suffix](passing(), path)
    return tuple(summaries)


def summary_of(simulation: Simulation) -> Summary:
    """Return what is worth knowing of a flight."""
    signals = simulation.signals
    error = signals["position"] - signals["reference_position"]
    x, y, z = np.sqrt(np.mean(error**2, axis=0)).tolist()
    speed = np.linalg.norm(signals["velocity"], axis=1)
    return Summary(simulation.coefficients, simulation.crash_time, float(speed.max()), (x, y, z))


def _write_only_one(simulations: Iterator[Simulation], path: Path) -> None:
    first = next(simulations)
    if next(simulations, None) is not None:
        raise InputError(path, "a bag holds one flight", "write a grid as .csv")
    write_bag(first, path)
