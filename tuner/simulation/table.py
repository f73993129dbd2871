"""Simulated flights as CSV."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from tuner.disk import whole_file
from tuner.flights.flight import Array
from tuner.simulation.simulate import Simulation

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
    """Write flights below each other; of a grid, the varied coefficients are the first columns.

    Units: s, m, m/s (world), degrees for roll, pitch, yaw, rad/s (body), rad/s, commands and thrust
    set-point 0..1; the quaternion is body to world. The file appears whole.

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
        for number, simulation in enumerate(simulations):
            if number == 0:
                names = (name for columns in COLUMNS.values() for name in columns)
                writer.writerow([*simulation.coefficients, "time", *names])
            writer.writerows(_rows(simulation))


def _rows(simulation: Simulation) -> Iterator[list[float]]:
    first = simulation.coefficients.values()
    signals = {
        **simulation.signals,
        "roll_pitch_yaw": roll_pitch_yaw(simulation.signals["attitude"]),
    }
    table = np.column_stack([simulation.time, *(signals[name] for name in COLUMNS)])
    for row in table.tolist():
        yield [*first, *row]


def roll_pitch_yaw(attitude: Array) -> Array:
    """Return (N, 3) degrees of (N, 4) quaternions w, x, y, z: turned by yaw, pitch, then roll."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    turns = Rotation.from_quat(attitude, scalar_first=True)
    angles: Array = turns.as_euler("ZYX", degrees=True)[:, ::-1]
    return angles
