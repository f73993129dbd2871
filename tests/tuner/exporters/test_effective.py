"""The second answer: what Gazebo lacks is made up for, or named, and nothing else moves."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tuner.exporters.conftest import as_fitted
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.records import AxesRmse
from tuner.exporters.effective import (
    carried_terms,
    find_effective,
    lost_terms,
    pose_rmse,
    recordings_of,
)
from tuner.exporters.simulators import GAZEBO_CLASSIC, GZ_SIM
from tuner.result import PoseRmse
from tuner.vehicle import ControllerFile, values_of, with_values


def axes(*values):
    return AxesRmse(**dict(zip(("x", "y", "z", "roll", "pitch", "yaw"), values, strict=True)))


def of_vehicle(run, **changes):
    """Return a run of another vehicle."""
    return run.model_copy(update={"vehicle": run.vehicle.replace(**changes)})


def test_a_vehicle_of_which_gazebo_lacks_nothing_has_one_answer(make_run):
    effects = {
        "fuselage_drag": 0.0,
        "center_of_mass_x": 0.004,
        "rotor_thrust_scale_1": 1.02,
        "marker_tilt_x": 0.01,
    }
    run = of_vehicle(make_run(), effects=effects)
    assert lost_terms(run, GAZEBO_CLASSIC) == {}
    assert carried_terms(GAZEBO_CLASSIC, run.vehicle) == (
        "center_of_mass_x",
        "rotor_thrust_scale_1",
    )

    def fail(*_):
        raise AssertionError("nothing is read")

    assert find_effective(run, GAZEBO_CLASSIC, fail, on_message=fail) is None


def test_what_gazebo_lacks_is_named_by_groups_and_taken_away(make_run):
    run = make_run()
    run = of_vehicle(
        run,
        effects={"linear_drag_x": 0.1, "linear_drag_z": 0.0, "rotor_drag_ratio_y": 1.0},
        motor=run.vehicle.motor.replace(quadratic=-20.0),
    )
    lost = lost_terms(run, GAZEBO_CLASSIC)
    assert lost == {"quadratic": ("quadratic",), "linear_drag": ("linear_drag_x",)}
    bare = GAZEBO_CLASSIC.with_built_in(run.vehicle, ["quadratic", "linear_drag_x"])
    assert bare.motor.quadratic == 0.0
    assert set(bare.effects) == {"linear_drag_z", "rotor_drag_ratio_y"}
    assert lost_terms(run.model_copy(update={"vehicle": bare}), GAZEBO_CLASSIC) == {}


def test_laws_that_no_coefficient_says_are_lost_too(make_run):
    run = make_run()
    assert "other laws" in lost_terms(run, GZ_SIM)
    turning = run.vehicle.aerodynamics.replace(reaction_torque="world")
    run = of_vehicle(run, aerodynamics=turning)
    assert lost_terms(run, GAZEBO_CLASSIC) == {"other laws": ()}


def test_a_battery_that_declines_is_lost_and_wind_is_not(make_run):
    around = {"wind_x": 1.0, "wind_y": 1.0, "battery_decline": -1.0}
    run = make_run(flights={"circle": {"conditions": around}})
    assert lost_terms(run, GAZEBO_CLASSIC) == {"battery_decline": ("battery_decline",)}


def test_coefficients_stand_in_for_a_term_that_is_lost_and_the_set_up_stays(run):
    """Two laws of drag: without one, the other grows by as much."""
    true = values_of(run.vehicle)
    speed = np.sqrt(true["mass"] * 9.81 / 4 / true["motor_constant"])
    drag = 0.1  # of the body: four rotors at hover speed drag like 4·k·Ω
    less = true["rotor_drag_coefficient"] - drag / (4 * speed)
    vehicle = with_values(run.vehicle, {"rotor_drag_coefficient": less})
    run = of_vehicle(
        as_fitted(run),
        aerodynamics=vehicle.aerodynamics,
        effects={"linear_drag_x": drag, "linear_drag_y": drag},
    )
    said, progressed = [], []
    found = find_effective(
        run, GAZEBO_CLASSIC, recordings_of, on_message=said.append, on_progress=progressed.append
    )
    assert said[0].startswith("Gazebo cannot fly linear_drag: looking for the coefficients")
    assert progressed[-1].iterations[-1].stage == "for Gazebo, polish again"
    after = values_of(found.vehicle)
    assert after["rotor_drag_coefficient"] == pytest.approx(
        true["rotor_drag_coefficient"], rel=0.02
    )
    assert {n: after[n] for n in after if n != "rotor_drag_coefficient"} == {
        n: true[n] for n in after if n != "rotor_drag_coefficient"
    }
    assert found.result.rmse_effective.position < 0.2 * found.result.rmse_unfitted.position
    (lost,) = found.result.lost
    assert lost.rmse_without == found.result.rmse_unfitted


def test_moments_of_inertia_that_a_job_ties_are_refitted_tied(run):
    run = of_vehicle(as_fitted(run), effects={"linear_drag_x": 0.1, "linear_drag_y": 0.1})
    inertia, rows = ("inertia_xx", "inertia_yy"), run.result.coefficients
    free = {
        n: rows[n].model_copy(update={"fitted": True, "lower": 0.001, "upper": 0.1})
        for n in inertia
    }
    result = run.result.model_copy(update={"coefficients": rows | free})

    def tied(run):
        settings, recordings = recordings_of(run)
        return replace(settings, job=settings.job.replace(ties=(inertia,))), recordings

    found = find_effective(run.model_copy(update={"result": result}), GAZEBO_CLASSIC, tied)
    before, after = values_of(run.vehicle), values_of(found.vehicle)
    moved = after["inertia_xx"] / before["inertia_xx"]
    assert moved != 1.0
    assert after["inertia_yy"] / before["inertia_yy"] == pytest.approx(moved, rel=1e-9)


@pytest.mark.parametrize(("room", "moves"), [(1.1, False), (3.0, True)])
def test_a_coefficient_that_ends_on_a_bound_stays_as_it_is(run, room, moves):
    """Half of the drag is a body's, without which that of rotors would double."""
    name = "rotor_drag_coefficient"
    less = 0.5 * values_of(run.vehicle)[name]
    vehicle = with_values(run.vehicle, {name: less})
    run = of_vehicle(
        as_fitted(run), aerodynamics=vehicle.aerodynamics, effects={"linear_drag_x": 0.1}
    )
    bounds = {"lower": 0.9 * less, "upper": room * less}
    rows = run.result.coefficients
    rows = rows | {name: rows[name].model_copy(update=bounds)}
    run = run.model_copy(update={"result": run.result.model_copy(update={"coefficients": rows})})
    found = find_effective(run, GAZEBO_CLASSIC, recordings_of)
    ends = values_of(found.vehicle)[name]
    assert ends == (pytest.approx(2 * less, rel=0.1) if moves else pytest.approx(less, rel=1e-9))


def test_nothing_free_is_nothing_refitted(run):
    run = of_vehicle(as_fitted(run), effects={"fuselage_drag": 0.04})
    fixed = {
        name: row.model_copy(update={"fitted": False})
        for name, row in run.result.coefficients.items()
    }
    result = run.result.model_copy(update={"coefficients": fixed})
    found = find_effective(run.model_copy(update={"result": result}), GAZEBO_CLASSIC, recordings_of)
    assert found.vehicle == GAZEBO_CLASSIC.with_built_in(run.vehicle, ["fuselage_drag"])


def test_a_condition_that_gazebo_lacks_is_left_out_where_it_flies_alone(run):
    """Without the drag the battery declines, without its decline the drag acts."""
    run = of_vehicle(as_fitted(run), effects={"fuselage_drag": 0.04})
    (flight,) = run.result.flights
    flight = flight.model_copy(update={"conditions": {"battery_decline": 0.3}})
    fixed = {
        name: row.model_copy(update={"fitted": False})
        for name, row in run.result.coefficients.items()
    }
    update = {"coefficients": fixed, "flights": (flight,)}
    run = run.model_copy(update={"result": run.result.model_copy(update=update)})
    found = find_effective(run, GAZEBO_CLASSIC, recordings_of)
    bare = GAZEBO_CLASSIC.with_built_in(run.vehicle, ["fuselage_drag"])
    (recording,) = recordings_of(run)[1]

    def flown(vehicle, conditions):
        held = Comparison([replace(recording, conditions=conditions)], ControllerFile())
        return pose_rmse([held.fly(vehicle)[flight.name].rmse])

    assert {term.group: term.rmse_without for term in found.result.lost} == {
        "fuselage_drag": flown(bare, flight.conditions),
        "battery_decline": flown(run.vehicle, {}),
    }
    assert found.result.rmse_unfitted == flown(bare, {})


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
