"""The second answer: what Gazebo lacks is made up for, or named, and nothing else moves."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tuner.terms.making import unfitted_with
from tests.tuner.uncertainty.making import problem, vehicle_file, with_data
from tuner.config import JobFile
from tuner.evaluate.records import AxesRmse
from tuner.exporters.effective import (
    carried_terms,
    effective_fit,
    lost_terms,
    pose_rmse,
    refitted,
)
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.objective.criterion import Point
from tuner.objective.normal import with_conditions
from tuner.result import PoseRmse
from tuner.terms.candidates import with_terms
from tuner.vehicle import values_of

DRAG = 0.04


def axes(*values):
    return AxesRmse(**dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)))


@pytest.fixture(scope="module")
def fit():
    """A base fit of flights that lack nothing, where it begins, and its job."""
    return unfitted_with(0.0, seed=0, job=JobFile())


def test_a_vehicle_of_which_gazebo_lacks_nothing_has_one_answer(fit):
    job, fitted = fit
    even = vehicle_file().replace(
        effects={
            "fuselage_drag": 0.0,
            "center_of_mass_x": 0.004,
            "rotor_thrust_scale_1": 1.02,
            "marker_tilt_x": 0.01,
        }
    )
    assert lost_terms(even, fitted) == {}
    assert carried_terms(even) == ("center_of_mass_x", "rotor_thrust_scale_1")

    def fail(*_):
        raise AssertionError("nothing is computed twice")

    answer = effective_fit(job, fitted, even, {}, on_progress=fail, on_message=fail)
    assert answer is None


def test_what_gazebo_lacks_is_named_by_groups_and_taken_away(fit):
    _, fitted = fit
    vehicle = vehicle_file().replace(
        effects={"linear_drag_x": 0.1, "linear_drag_z": 0.0, "rotor_drag_ratio_y": 1.0},
        motor=vehicle_file().motor.replace(quadratic=-20.0),
    )
    lost = lost_terms(vehicle, fitted)
    assert lost == {"quadratic": ("quadratic",), "linear_drag": ("linear_drag_x",)}
    bare = GAZEBO_CLASSIC.lacking(vehicle, ["quadratic", "linear_drag_x"])
    assert bare.motor.quadratic == 0.0
    assert set(bare.effects) == {"linear_drag_z", "rotor_drag_ratio_y"}
    assert lost_terms(bare, fitted) == {}


def test_a_battery_that_declines_is_lost_and_wind_is_not(fit):
    _, fitted = fit
    objective, point = with_conditions(
        fitted.objective, fitted.point, ("wind_x", "wind_y", "battery_decline")
    )
    offsets = np.array(point.offsets)
    offsets[-3:] = 1.0
    around = replace(fitted, objective=objective, point=Point(point.coefficients, offsets))
    assert lost_terms(vehicle_file(), around) == {"battery_decline": ("battery_decline",)}


def test_coefficients_stand_in_for_a_term_that_is_lost_and_the_set_up_stays():
    """Two laws of drag: without one, the other grows; without the ratio, it is about the mean."""
    free = ("rotor_drag_coefficient", "motor_constant", "estimate_latency")
    flown = problem((*free, "linear_drag_x", "linear_drag_y"))
    values = {p.name: p.initial for p in flown.space.parameters}
    values |= {"linear_drag_x": 0.3, "linear_drag_y": 0.3, "estimate_latency": 0.01}
    start = flown.space.vector_of(values)
    flown = with_data(flown, flown.start(start), noise=np.random.default_rng(0))
    job, base = unfitted_with(0.0, seed=0, job=JobFile())
    job = replace(job, space=flown.space, objective=flown)
    fitted = replace(base, objective=flown, point=flown.start(start))
    vehicle = vehicle_file().replace(
        effects={"linear_drag_x": 0.3, "linear_drag_y": 0.3},
        setup=vehicle_file().setup.replace(estimate_latency=0.01),
    )
    names = ("linear_drag_x", "linear_drag_y")
    progressed = []
    end, effective = refitted(
        job,
        fitted,
        GAZEBO_CLASSIC.lacking(vehicle, names),
        names,
        lambda _, now: progressed.append(now),
    )
    before, after = values_of(vehicle), values_of(effective)
    assert progressed
    assert after["estimate_latency"] == before["estimate_latency"]
    assert not set(names).intersection(after)
    # four rotors at hover speed drag like 4·k·Ω
    speed = np.sqrt(vehicle.mass * 9.81 / 4 / before["motor_constant"])
    expected = before["rotor_drag_coefficient"] + 0.3 / (4 * speed)
    assert after["rotor_drag_coefficient"] == pytest.approx(expected, rel=0.05)
    assert after["motor_constant"] == pytest.approx(before["motor_constant"], rel=0.01)
    np.testing.assert_array_equal(end.point.offsets, fitted.point.offsets)


def test_nothing_free_is_nothing_refitted(fit):
    job, fitted = fit
    objective, point = with_terms(
        fitted.objective, fitted.point, ("fuselage_drag",), job.settings.job
    )
    fitted = replace(fitted, objective=objective, point=point)
    held = {name: name for name in objective.space.names}
    vehicle = vehicle_file().replace(effects={"fuselage_drag": DRAG})
    bare = GAZEBO_CLASSIC.lacking(vehicle, ["fuselage_drag"])
    _, effective = refitted(
        job, replace(fitted, held=held), bare, ("fuselage_drag",), lambda *_: None
    )
    assert effective == bare


def test_the_rmse_over_flights_is_of_distances_and_a_crash_stays_one():
    both = pose_rmse([axes(3.0, 4.0, 0.0, 1.0, 0.0, 0.0), axes(0.0, 0.0, 1.0, 0.0, 0.0, 7.0)])
    assert both.position == pytest.approx(np.sqrt((25 + 1) / 2))
    assert both.attitude == pytest.approx(5.0)
    assert pose_rmse([axes(*[None] * 6)]).position is None
    followed = axes(0.0, 0.0, 1.0, None, None, None)  # its attitude, which is no crash
    assert pose_rmse([axes(3.0, 4.0, 0.0, 1.0, 0.0, 0.0), followed]).attitude == 1.0
    assert pose_rmse([followed, followed]) == PoseRmse(position=1.0, attitude=None)
    assert pose_rmse([followed, axes(*[None] * 6)]).position is None
    assert pose_rmse([]).attitude is None
