from dataclasses import replace

import numpy as np
import pytest

from sim_jax.state import AIRBORNE, Limits
from tuner.config import TrajectorySettings
from tuner.evaluate.comparison import (
    Comparison,
    FlightErrors,
    SignalErrors,
    laps_of,
    rmse_of,
    wrap_degrees,
)
from tuner.objective.trajectory import with_named_reference
from tuner.recordings.flight import Series
from tuner.search.job_flights import Recording
from tuner.search.problem import limits_of
from tuner.vehicle import ControllerFile, with_values

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


def errors(position, attitude, **options):
    signals = {}
    for name, values in (("position", position), ("attitude", attitude)):
        error = np.asarray(values, float)
        signals[name] = SignalErrors(np.arange(len(error)) * 1.0, np.zeros_like(error), error)
    return FlightErrors(**signals, **{"laps": np.zeros(0), "crash_time": None} | options)


def test_the_root_mean_square_of_known_errors():
    rmse = errors([[3, 0, 1], [-4, 0, 1]], [[1, 2, 0], [1, -2, 0]]).rmse
    assert rmse.x == pytest.approx(np.sqrt(12.5))
    assert (rmse.y, rmse.z, rmse.roll, rmse.pitch, rmse.yaw) == (0, 1, 1, 2, 0)


def test_flights_are_pooled_by_their_samples():
    single = errors([[1, 0, 0]], [[1, 0, 0]])
    three = errors([[3, 0, 0]] * 3, [[3, 0, 0]] * 3)
    assert rmse_of([single, three]).x == pytest.approx(np.sqrt((1 + 3 * 9) / 4))


def test_a_crash_or_nothing_measured_has_no_rmse():
    crashed = errors([[1, 0, 0]], [[1, 0, 0]], crash_time=1.0)
    assert set(rmse_of([errors([[1, 1, 1]], [[1, 1, 1]]), crashed]).model_dump().values()) == {None}
    assert errors(np.zeros((0, 3)), [[1, 0, 0]]).rmse.x is None


def test_a_stretch_is_cut_by_each_clock():
    part = errors(np.eye(3), np.eye(3)).between(1.0, 2.0)
    np.testing.assert_array_equal(part.position.error, [[0, 1, 0]])
    np.testing.assert_array_equal(part.attitude.error, [[0, 1, 0]])


def test_the_vehicle_that_flew_meets_its_recording(flight, updated):
    comparison = Comparison([Recording(flight)], ControllerFile())
    flown = comparison.fly(updated, forces=True)["small_circle"]
    assert flown.crash_time is None
    for axis in ("x", "y", "z"):
        assert getattr(flown.rmse, axis) < 2e-4, axis
    for axis in ("roll", "pitch", "yaw"):
        assert getattr(flown.rmse, axis) < 0.02, axis
    draggy = comparison.fly(with_values(updated, {"rotor_drag_coefficient": 8e-4}))["small_circle"]
    assert draggy.rmse.x > 100 * flown.rmse.x
    thrust = flown.forces.of_term["thrust"][:, 2]
    turned = np.interp(
        flown.forces.time, flight.time, np.sum(flight.signals["rotor_speed"] ** 2, axis=1)
    )
    np.testing.assert_allclose(thrust, updated.aerodynamics.motor_constant * turned, rtol=0.02)
    assert flown.forces.time[-1] == pytest.approx(flight.duration, abs=0.03)


def test_angles_are_compared_the_short_way_round():
    just_left, just_right = np.array([[0, 0, 179.0]]), np.array([[0, 0, -179.0]])
    np.testing.assert_allclose(wrap_degrees(just_left - just_right), [[0, 0, -2]])
    np.testing.assert_allclose(wrap_degrees(np.array([[-190.0, 180.0, 10.0]])), [[170, -180, 10]])


def test_a_late_clock_is_taken_back(flight, updated):
    late = replace(
        flight,
        series={
            name: Series(data.time + 0.05, data.values)
            if name in ("position", "attitude")
            else data
            for name, data in flight.series.items()
        },
    )
    as_is = Comparison([Recording(late)], ControllerFile()).fly(updated)["small_circle"].rmse
    known = Comparison([Recording(late, time_offset=0.05)], ControllerFile()).fly(updated)
    assert known["small_circle"].rmse.x < 3e-4
    assert as_is.x > 0.02


def test_a_vehicle_that_cannot_fly_crashes(flight, updated):
    heavy = with_values(updated, {"mass": 9.0})
    crash = Comparison([Recording(flight)], ControllerFile()).fly(heavy, forces=True)[
        "small_circle"
    ]
    assert 0 < crash.crash_time < 12
    assert crash.rmse.x is None
    assert crash.crash_time - 0.03 < crash.forces.time[-1] < crash.crash_time


def test_flights_of_different_length_fly_side_by_side(flight, updated):
    half = replace(
        flight,
        name="half",
        time=flight.time[:600],
        signals={name: values[:600] for name, values in flight.signals.items()},
    )
    both = Comparison([Recording(flight), Recording(half)], ControllerFile()).fly(updated)
    assert both["half"].position.time[-1] <= half.duration
    assert both["half"].rmse.x < 2e-4
    assert both["small_circle"].rmse.x < 2e-4


def test_laps_are_where_the_counter_rises(flight):
    laps = laps_of(flight)
    assert len(laps) >= 3
    assert np.all(np.diff(laps) > 0.5)
    assert len(laps_of(replace(flight, series={}))) == 0


def test_the_arena_gives_way_to_recordings_beyond_it(flight):
    assert limits_of([flight]) == Limits()
    place = flight.series["position"]
    low = Series(place.time, place.values - [0, 0, 0.6])
    assert limits_of([replace(flight, series={**flight.series, "position": low})]) == AIRBORNE


def test_a_named_trajectory_stands_in_for_a_reference(flight):
    bare = replace(
        flight,
        signals={k: v for k, v in flight.signals.items() if not k.startswith("reference")},
    )
    shape = TrajectorySettings(name="circle", radius=0.3, omega=1.0, speed_scale=4.0)
    named = with_named_reference(bare, shape)
    np.testing.assert_allclose(
        named.signals["reference_position"], flight.signals["reference_position"], atol=1e-12
    )
    assert named.yaw_rate_setpoint is None
    spin = with_named_reference(bare, TrajectorySettings(name="yaw_spin", yaw_rate=1.5))
    assert spin.yaw_rate_setpoint == 1.5
