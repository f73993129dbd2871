"""Simulated flights into a file, and what is worth knowing of each."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tuner.disk import check_file
from tuner.errors import InputError
from tuner.simulation.bag import write_bag
from tuner.simulation.simulate import Simulation
from tuner.simulation.table import write_csv


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


def write_flights(simulations: Iterable[Simulation], path: Path) -> tuple[Summary, ...]:
    """Write flights as they come, as ``.csv`` or one of them as a ROS 1 ``.bag``.

    Raises
    ------
    InputError
        The file's suffix is another, several flights are to go into one bag, or it cannot be
        written.
    """
    writers: dict[str, Callable[[Iterator[Simulation], Path], None]] = {
        ".csv": write_csv,
        ".bag": _write_only_one,
    }
    if path.suffix not in writers:
        raise InputError(path, f"no flight is written as '{path.suffix}'", "name a .csv or a .bag")
    check_file(path)
    summaries: list[Summary] = []

    def passing() -> Iterator[Simulation]:
        for simulation in simulations:
            summaries.append(summary_of(simulation))
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
