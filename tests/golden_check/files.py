"""Which check belongs to which golden file."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pandas as pd

from tests.golden_check import flights, geometry, motor, plant, px4, trajectories
from tests.golden_check.table import Deviation, Table

Check = Callable[[Table], list[Deviation]]
SUFFIX = ".csv.gz"

CHECKS: dict[str, Check] = {
    "geo_quat_ops": geometry.quaternion_operations,
    "geo_acc2quaternion": geometry.attitude_of_acceleration,
    "geo_attcontrollers": geometry.attitude_laws,
    "geo_control_full": geometry.position_controller,
    "traj_shape": trajectories.shapes,
    **{f"traj_update_{name}_s2.1": trajectories.publisher(name) for name in trajectories.SHAPES},
    "px4_rate_control": px4.rate_control,
    "px4_gyro_filter": px4.gyro_filter,
    "px4_mixer_quad_x": px4.mixer_quad_x,
    "px4_rate_mixer_loop": px4.rate_and_mixer,
    "motor_command_map": motor.command_map,
    "motor_filter_hg": motor.rotor_filter,
    "motor_model_hg": motor.motor_model,
    "motor_model_up": motor.motor_model,
    "plant_wrench": plant.wrench,
    "plant_rollout_rk4_1k": plant.open_loop,
}


def check_of(name: str) -> Check | None:
    """Return the check for a file's name without its suffix, None if there is none."""
    return CHECKS.get(name) or flights.check_of(name)


def golden_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Yield name and path of the golden files of a folder."""
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        yield path.name.removesuffix(SUFFIX), path


def read(path: Path) -> Table:
    """Read a golden file, to the last digit."""
    return Table(pd.read_csv(path, compression="gzip", float_precision="round_trip"))
