"""What acts along a flight, term by term, is what moved it."""

import math

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from tuner.config import TrajectorySettings
from tuner.core.errors import InputError
from tuner.evaluate.closed_loop import COMPONENTS, simulate
from tuner.evaluate.simulation_files import write_flights
from tuner.vehicle import ControllerFile, with_values

#: Every term beyond the motor model's four, with what makes it felt.
EFFECTS = {
    "fuselage_drag": 0.05,
    "linear_drag_x": 0.1,
    "thrust_inflow_coefficient": 1e-4,
    "flapping_moment_coefficient": -2e-6,
    "rotor_inertia": 6e-5,
    "angular_drag_y": 0.01,
    "torque_trim_x": 0.02,
    "center_of_mass_x": 0.01,
    "rotor_thrust_scale_1": 1.05,
}
TERMS = [
    *("thrust", "rotor_drag", "rolling_moment", "drag_torque", "fuselage_drag", "linear_drag"),
    *("thrust_inflow", "flapping_moment", "gyroscopic_moment", "angular_drag", "torque_trim"),
    "gravity",
]
QUICK = TrajectorySettings(name="lemniscate", speed_scale=6.0)


@pytest.fixture(scope="module")
def flown(vehicle):
    heavy = with_values(vehicle, EFFECTS)
    (flight,) = simulate(heavy, ControllerFile(), QUICK, duration=4.0, rate=400.0, forces=True)
    return flight


def check(acting, change):
    """Compare with differences, which round off the kinks where the controller's ticks are."""
    inside = slice(10, -10)
    error = (acting - change)[inside]
    assert np.abs(error).max() < 0.03 * np.abs(change).max()
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.sqrt(np.mean(change[inside] ** 2))


def test_forces_add_up_to_mass_times_acceleration(flown, vehicle):
    assert list(flown.forces.of_term) == TERMS
    attitude = Rotation.from_quat(flown.signals["attitude"], scalar_first=True)
    force = attitude.apply(sum(flown.forces.of_term.values())[:, :3])
    slope = vehicle.mass * np.gradient(flown.signals["velocity"], flown.time, axis=0)
    assert np.abs(slope).max() > 1.0
    check(force, slope)


def test_moments_turn_the_body_as_euler_says(flown, vehicle):
    rate = flown.signals["body_rate"]
    momentum = rate * [vehicle.inertia.xx, vehicle.inertia.yy, vehicle.inertia.zz]
    moment = sum(flown.forces.of_term.values())[:, 3:]
    change = np.gradient(momentum, flown.time, axis=0) + np.cross(rate, momentum)
    assert np.abs(change).max() > 0.05
    check(moment, change)


def test_no_term_is_idle(flown):
    for name, values in flown.forces.of_term.items():
        assert np.abs(values).max() > 1e-4, name


def test_the_forces_of_a_grid_go_into_one_table(vehicle, tmp_path):
    grid = {"mass": np.array([2.243, 9.0])}
    hover = TrajectorySettings(name="hover")
    flights = simulate(vehicle, ControllerFile(), hover, duration=4.0, grid=grid, forces=True)
    write_flights(flights, tmp_path / "f.csv", forces=tmp_path / "forces.csv")
    table = pd.read_csv(tmp_path / "forces.csv")
    assert list(table.columns[:3]) == ["mass", "time", "thrust_fx"]
    assert list(table.columns[-6:]) == [f"gravity_{name}" for name in COMPONENTS]
    light, heavy = table[table["mass"] < 3], table[table["mass"] > 3]
    assert light["thrust_fz"].iloc[-1] == pytest.approx(2.243 * 9.81, rel=1e-3)
    assert light["gravity_fz"].iloc[-1] == pytest.approx(-2.243 * 9.81, rel=1e-6)
    assert 0 < len(heavy) < len(light) == 401  # it crashes, and what lies still is not written


def test_forces_go_into_a_table_of_their_own(circle, tmp_path):
    for name in ("c.csv", "f.txt"):
        with pytest.raises(InputError, match="csv of their own"):
            write_flights([circle], tmp_path / "c.csv", forces=tmp_path / name)
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="cannot be written"):
        write_flights([circle], tmp_path / "c.csv", forces=tmp_path / "file" / "f.csv")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert math.isclose(circle.time[-1], 4.0)
