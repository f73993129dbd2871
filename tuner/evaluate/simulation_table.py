"""Simulated flights, and what acted along them, as CSV."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from tuner.core.disk import whole_file
from tuner.evaluate.forces import COMPONENTS
from tuner.evaluate.simulate import Simulation
from tuner.recordings.flight import Array

Append = Callable[[Mapping[str, float], Sequence[str], Sequence[Array]], None]

_XYZ = ("x", "y", "z")
#: Signal -> the columns that hold it, in the order of the file.
COLUMNS: dict[str, tuple[str, ...]] = {
    "position": _XYZ,
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "roll_pitch_yaw": ("roll", "pitch", "yaw"),
    "body_rate": ("wx", "wy", "wz"),
    "rotor_speed": tuple(f"rotor_speed_{rotor}" for rotor in range(1, 5)),
    "command": tuple(f"command_{rotor}" for rotor in range(1, 5)),
    "thrust_setpoint": ("thrust_setpoint",),
    "reference_position": tuple(f"ref_{axis}" for axis in _XYZ),
    "reference_velocity": tuple(f"ref_v{axis}" for axis in _XYZ),
    "reference_acceleration": tuple(f"ref_a{axis}" for axis in _XYZ),
}


def write_csv(simulations: Iterable[Simulation], path: Path) -> None:
    """Write flights below each other.

    Units: s, m, m/s (world), degrees for roll, pitch, yaw, rad/s (body), rad/s, commands and thrust
    set-point 0..1; the quaternion is body to world.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    names = [name for columns in COLUMNS.values() for name in columns]
    with flights_below_each_other(path) as append:
        for simulation in simulations:
            signals = {
                **simulation.signals,
                "roll_pitch_yaw": roll_pitch_yaw(simulation.signals["attitude"]),
            }
            columns = (simulation.time, *(signals[name] for name in COLUMNS))
            append(simulation.coefficients, names, columns)


def write_forces(simulation: Simulation, append: Append) -> None:
    """Append what acted along a flight, one column per term and component, as ``thrust_fz``."""
    if simulation.forces is not None:
        time, of_term = simulation.forces.time, simulation.forces.of_term
        names = [f"{term}_{component}" for term in of_term for component in COMPONENTS]
        append(simulation.coefficients, names, (time, *of_term.values()))


@contextmanager
def flights_below_each_other(path: Path) -> Iterator[Append]:
    """Write a CSV of flights: what is yielded appends one.

    It takes the coefficients that were varied for the flight, which are the first columns, the
    names of its columns behind ``time``, and time and columns. The file appears whole.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with (
        whole_file(path) as unfinished,
        unfinished.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        begun = False

        def append(
            varied: Mapping[str, float], names: Sequence[str], columns: Sequence[Array]
        ) -> None:
            nonlocal begun
            if not begun:
                writer.writerow([*varied, "time", *names])
                begun = True
            rows = np.column_stack(columns).tolist()
            writer.writerows([*varied.values(), *row] for row in rows)

        yield append


def roll_pitch_yaw(attitude: Array) -> Array:
    """Return (N, 3) degrees of (N, 4) quaternions w, x, y, z: turned by yaw, pitch, then roll."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    turns = Rotation.from_quat(attitude, scalar_first=True)
    angles: Array = turns.as_euler("ZYX", degrees=True)[:, ::-1]
    return angles
