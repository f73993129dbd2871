import importlib
import math
import sys

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from lanes.program import _program_of
from sim_jax import terms
from sim_jax.geometry import Vec3
from sim_jax.rigid_body import Wrench
from sim_jax.trajectory import Shape
from tuner.cli import main
from tuner.config import TrajectorySettings
from tuner.core.errors import InputError
from tuner.core.shipped import configs_folder
from tuner.design.ranking import Arena, candidates
from tuner.evaluate import closed_loop
from tuner.evaluate.closed_loop import COMPONENTS, simulate
from tuner.evaluate.simulation_files import write_flights
from tuner.objective.trajectory import at_speed, published
from tuner.options import SimulationOptions
from tuner.recordings.flight import SIGNALS
from tuner.vehicle import ControllerFile, read_controller, with_values

#: One duration for all, so that the loop is compiled once.
SHORT = {"duration": 4.0}


def fly(vehicle, name="circle", controller=None, **options):
    settings = TrajectorySettings(name=name, **options.pop("settings", {}))
    return list(simulate(vehicle, controller or ControllerFile(), settings, **SHORT | options))


def test_signals_are_those_of_a_flight_on_a_uniform_clock(circle):
    np.testing.assert_allclose(circle.time, np.arange(401) / 100)
    for name, values in circle.signals.items():
        assert values.shape == (401, SIGNALS[name].columns), name
        assert np.isfinite(values).all(), name
    assert circle.crash_time is None


def test_it_starts_at_rest_at_the_first_point_and_follows_the_reference(circle):
    np.testing.assert_allclose(circle.signals["position"][0], [2, 0, 1])
    np.testing.assert_allclose(circle.signals["velocity"][0], 0)
    error = circle.signals["position"] - circle.signals["reference_position"]
    assert 0.01 < np.abs(error).max() < 0.5
    assert circle.signals["position"][-1, 1] > 0.1


def test_velocity_is_the_derivative_of_position(circle):
    slope = np.gradient(circle.signals["position"], circle.time, axis=0)
    np.testing.assert_allclose(slope[1:-1], circle.signals["velocity"][1:-1], atol=5e-3)


def test_an_accelerometer_at_hover_shows_gravity_upwards(vehicle):
    (hover,) = fly(vehicle, "hover")
    np.testing.assert_allclose(hover.signals["acceleration"][-1], [0, 0, 9.81], atol=0.05)
    thrust = 4 * 1.45e-5 * hover.signals["rotor_speed"][-1, 0] ** 2
    assert thrust == pytest.approx(2.243 * 9.81, rel=2e-3)


def test_a_yaw_spin_turns_at_its_rate(vehicle):
    (spin,) = fly(vehicle, "yaw_spin", settings={"yaw_rate": 1.5})
    assert spin.signals["body_rate"][-1, 2] == pytest.approx(1.5, abs=0.05)
    np.testing.assert_allclose(spin.signals["rate_setpoint"][10:], [[0, 0, 1.5]] * 391)


@pytest.mark.parametrize("name", ["straight", "diagonal", "lemniscate"])
def test_the_other_shapes_fly(vehicle, name):
    (flight,) = fly(vehicle, name)
    assert flight.crash_time is None
    assert np.ptp(flight.signals["reference_position"][:, 0]) > 1e-3


def test_rates_that_do_not_divide_the_physics_rate_are_interpolated(vehicle):
    sitl = read_controller(configs_folder() / "controllers" / "hovergames_sitl.yaml")
    (at_100,) = fly(vehicle, controller=sitl, rate=100.0)
    (at_250,) = fly(vehicle, controller=sitl, rate=250.0)
    assert len(at_100.time) == 401
    np.testing.assert_allclose(
        at_100.signals["position"][::2], at_250.signals["position"][::5], atol=1e-6
    )


@pytest.mark.parametrize("rate", [2.5, 0.5])
def test_a_rate_that_is_no_whole_number_is_that_of_the_samples(vehicle, rate):
    (often,), (seldom,) = fly(vehicle, rate=100.0), fly(vehicle, rate=rate)
    step = round(100.0 / rate)
    np.testing.assert_allclose(seldom.time, often.time[::step])
    np.testing.assert_allclose(
        seldom.signals["position"], often.signals["position"][::step], atol=1e-6
    )


@pytest.mark.parametrize(
    ("given", "grid", "expected"),
    [
        ({}, {"mass": ["a"]}, "holds no numbers of mass; give a list"),
        ({}, {"mass": [2 + 1j]}, "holds no numbers of mass"),
        ({}, {"mass": [[2.0], [2.0, 2.1]]}, "holds no numbers of mass"),
        ({}, {"mass": np.full(100_001, 2.0)}, "asks for 100001 flights; at most 100000"),
        ({"duration": 0.005}, None, "0.005 s hold no two samples at 100 Hz"),
        ({"rate": 0.1}, None, "4 s hold no two samples at 0.1 Hz"),
        ({}, {"mass": [2.0, 2.1], "inertia_xx": [0.02]}, "holds 2 of mass and 1 of inertia_xx"),
        ({}, {"mass": []}, "holds 0 of mass"),
        ({}, {"mass": [[2.0, 2.1]]}, "holds 2 of mass"),
        ({}, {"mass": [2.0, -1.0]}, "mass is -1.0; it should be more than 0"),
        ({}, {"inertia_xx": [0.02, 1.0]}, "inertia.xx is 1.0, more than the other two"),
        ({}, {"estimate_latency": [0.05, 0.2]}, "latency is 0.2; it should be at most 0.1"),
        ({}, {"gyro_cutoff": [40.0, 200.0]}, "cutoff is 200 Hz, not below half of rate.rate"),
    ],
)
def test_what_makes_no_flight_is_refused(given, grid, expected):
    with pytest.raises(InputError, match=expected):
        closed_loop.fly(SimulationOptions(trajectory="circle", **SHORT | given), grid=grid)


def test_a_grid_flies_each_vehicle_as_it_flies_alone(vehicle):
    grid = {
        "motor_constant": np.array([1.3e-5, 1.5e-5]),
        "inertia_xx": np.array([0.025, 0.030]),
    }
    together = fly(vehicle, grid=grid)
    assert [flight.coefficients for flight in together] == [
        {"motor_constant": 1.3e-5, "inertia_xx": 0.025},
        {"motor_constant": 1.5e-5, "inertia_xx": 0.030},
    ]
    for flight in together:
        (alone,) = fly(with_values(vehicle, flight.coefficients))
        for name, values in alone.signals.items():
            np.testing.assert_allclose(flight.signals[name], values, atol=1e-4, err_msg=name)
    assert not np.allclose(together[0].signals["position"], together[1].signals["position"])


def test_a_large_grid_takes_turns(vehicle, monkeypatch):
    monkeypatch.setattr("tuner.evaluate.closed_loop.MAX_LANES", 2)
    constants = [1.3e-5, 1.4e-5, 1.5e-5]
    grid = {"motor_constant": np.array(constants), "inertia_xx": np.array([0.025] * 3)}
    in_turns = fly(vehicle, "hover", grid=grid)
    assert [flight.coefficients["motor_constant"] for flight in in_turns] == constants
    for flight in in_turns:
        (alone,) = fly(with_values(vehicle, flight.coefficients), "hover")
        np.testing.assert_allclose(flight.signals["position"], alone.signals["position"], atol=1e-6)


def test_a_vehicle_that_cannot_fly_crashes_and_says_when(vehicle):
    (flight,) = fly(with_values(vehicle, {"mass": 9.0}), "hover")
    assert 0.2 < flight.crash_time < 4.0
    assert np.isfinite(flight.signals["position"]).all()


def test_laps_are_counted(vehicle):
    fast = {"speed_scale": 20.0, "omega": 1.0, "radius": 0.01}
    (flight,) = fly(vehicle, settings=fast)
    assert flight.signals["lap"][0, 0] == 0
    assert flight.signals["lap"][-1, 0] >= 2


@pytest.mark.parametrize(
    ("name", "peak"),
    [("circle", 1.0), ("lemniscate", math.sqrt(2)), ("straight", 1.0), ("diagonal", math.sqrt(2))],
)
def test_a_speed_is_that_of_the_reference_at_its_fastest(name, peak):
    settings = at_speed(TrajectorySettings(name=name, radius=1.0), 1.2)
    assert settings.speed_scale == pytest.approx(1.2 / (0.7 * peak))
    points = published(settings, duration=20.0, control_rate=100.0).inlet.points.position
    moved = np.gradient(np.stack([points.x, points.y, points.z]), 0.01, axis=1)[:, 1100:-1]
    assert np.linalg.norm(moved, axis=0).max() == pytest.approx(1.2, rel=1e-3)


def test_what_stays_in_place_has_no_speed():
    with pytest.raises(InputError, match="hover stays in one place"):
        at_speed(TrajectorySettings(name="hover"), 3.0)
    with pytest.raises(InputError, match="is no speed"):
        at_speed(TrajectorySettings(name="circle"), -3.0)


@pytest.mark.parametrize("name", ["lemniscate", "yaw_spin"])
def test_single_precision_costs_less_than_a_twentieth_of_a_millimetre(vehicle, name):
    whole = {"duration": 40.0}
    (exact,) = fly(vehicle, name, **whole)
    (quick,) = fly(vehicle, name, **whole, precision="float32")
    apart = np.linalg.norm(exact.signals["position"] - quick.signals["position"], axis=1)
    assert 0.0 < apart.max() < 5e-5
    turned = np.abs(np.sum(exact.signals["attitude"] * quick.signals["attitude"], axis=1))
    assert np.degrees(2 * np.arccos(np.minimum(turned, 1.0))).max() < 0.01


def test_a_grid_in_single_precision_is_the_grid(vehicle):
    grid = {"mass": np.linspace(2.0, 2.4, 3)}
    exact, quick = (
        fly(vehicle, grid=grid, precision=precision) for precision in ("float64", "float32")
    )
    for exact_flight, quick_flight in zip(exact, quick, strict=True):
        assert exact_flight.coefficients == quick_flight.coefficients
        np.testing.assert_allclose(
            quick_flight.signals["position"], exact_flight.signals["position"], atol=1e-4
        )


def pushed_east(_vehicle, _motion, _rotor_speed, air):
    return Wrench(Vec3.of(jnp.asarray([PUSH["newton"], 0.0, 0.0])), Vec3.zeros(air.velocity.x))


PUSH = {"newton": 0.0}


def test_a_force_that_is_defined_elsewhere_is_never_taken_from_what_is_kept(vehicle, monkeypatch):
    monkeypatch.setattr(terms, "TERMS", (*terms.TERMS, pushed_east))
    east = []
    for newton in (0.0, 1.0):
        monkeypatch.setitem(PUSH, "newton", newton)
        _program_of.cache_clear()  # as in another process
        (hover,) = fly(vehicle, "hover")
        east.append(hover.signals["position"][-1, 0])
    _program_of.cache_clear()
    assert east[1] - east[0] > 0.01


# what acts along a flight, term by term, is what moved it

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


# a trajectory is one place: a subclass of `Shape`, here in a module made for the test

SQUIRCLE = '''
"""A rounded square."""

import jax.numpy as jnp

from sim_jax.trajectory import Shape
from sim_jax.geometry import Vec3


class Squircle(Shape):
    name = "squircle"
    peak_speed = 1.5
    peak_acceleration = 2.0
    extent = (1.25, 1.25)

    def position(self, angle):
        x = jnp.cos(angle) + 0.25 * jnp.cos(3 * angle)
        y = jnp.sin(angle) + 0.25 * jnp.sin(3 * angle)
        return Vec3(self.radius * x, self.radius * y, jnp.zeros_like(angle)) + self.origin
'''


@pytest.fixture
def squircle(tmp_path, monkeypatch):
    """Write the module and import it; it is gone after the test."""
    (tmp_path / "squircle_module.py").write_text(SQUIRCLE)
    monkeypatch.syspath_prepend(tmp_path)
    before = Shape.__subclasses__()
    shape = importlib.import_module("squircle_module").Squircle
    yield shape
    del sys.modules["squircle_module"]
    Shape.__subclasses__ = lambda: before  # the class itself outlives the test in JAX's caches


def test_a_new_trajectory_is_simulated_and_proposed(squircle, tmp_path, capsys):
    out = tmp_path / "flight.csv"
    flown = ["simulate", "--trajectory", "squircle", "--radius", "1", "--speed", "1"]
    assert main([*flown, "--duration", "4", "--out", str(out)]) == 0
    table = np.genfromtxt(out, delimiter=",", names=True)
    assert table["ref_x"][0] == pytest.approx(1.25)
    assert abs(table["x"] - table["ref_x"]).max() < 0.2
    names = [*candidates(Arena(8.0, 6.0, 3.0))]
    assert "a squircle of 2 m radius at 1.5 m/s" in names
    capsys.readouterr()
    assert main(["simulate", "--trajectory", "square", "--out", str(out)]) == 2
    assert squircle.name in capsys.readouterr().err
