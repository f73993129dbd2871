"""The truth lies in the 95 % intervals of simulated rigs as often as it should."""

import math
from pathlib import Path

import numpy as np
import pytest
from pydantic import TypeAdapter

from tests.tuner.ground import rigs
from tuner.core.errors import RecordingError
from tuner.core.shipped import configs_folder
from tuner.ground.hovers import measure_hover_weights, measure_propeller, measure_yaw_spin
from tuner.ground.measurement import combine
from tuner.ground.plan import Experiment
from tuner.ground.rig_data import read_columns
from tuner.ground.rigs import measure_bifilar, measure_rpm_curve, measure_stand
from tuner.ground.step_response import measure_step_response
from tuner.vehicle import COEFFICIENTS, read_vehicle, with_values

TRUTH = rigs.TRUTH
LEVER, ARM = 1.4231, 0.37
QUAD = with_values(
    read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml"),
    {"mass": 2.243, "motor_constant": TRUTH["motor_constant"]},
)


def plan(kind, **keys):
    """Return an experiment as ``bench.yaml`` has it."""
    needs = {"thrust_stand", "torque_stand", "rpm_curve", "bifilar"}
    recording = {"recording": "x.csv"} if kind in needs else {}
    return TypeAdapter(Experiment).validate_python({"kind": kind, **recording, **keys})


def swing(random):
    samples, ruler = rigs.swing(random)
    errors = {"mass_error": 0.002 / ruler["mass"]}
    return measure_bifilar(
        "bifilar x", "x.csv", samples, plan("bifilar", axis="x", **ruler, **errors), QUAD
    )


def thrust(random, lever=None):
    samples = rigs.stand(random, slope=4 * TRUTH["motor_constant"], lever=LEVER)
    lever = lever or LEVER * (1 + random.normal(0, 0.005))
    return measure_stand(
        "thrust", "t.csv", samples, plan("thrust_stand", rotors=4, lever_ratio=lever), QUAD
    )


def torque(random):
    slope = 2 * TRUTH["moment_constant"] * TRUTH["motor_constant"]
    samples = rigs.stand(random, slope=slope, lever=ARM, noise=0.02)
    arm = ARM * (1 + random.normal(0, 0.005))
    return measure_stand(
        "torque", "t.csv", samples, plan("torque_stand", rotors=2, lever_arm=arm), QUAD
    )


def curve(random):
    given = plan("rpm_curve", reference_voltage=16.4)
    return measure_rpm_curve("rpm", "r.csv", rigs.steps_of_command(random), given)


def steps(random):
    return measure_step_response("steps", "s.csv", rigs.motor_steps(random))


def hover(random):
    points = [{"mass": mass, "rotor_speed": speed} for mass, speed in rigs.hovers(random)]
    return measure_hover_weights("hover", plan("hover_weights", points=points), QUAD, Path())


def spin(random):
    names = ("yaw_rate", "rotor_speed_slow", "rotor_speed_fast")
    points = [dict(zip(names, point, strict=True)) for point in rigs.spins(random)]
    return measure_yaw_spin("spin", plan("yaw_spin", points=points), QUAD, Path())


def table(random):
    scatter = np.exp(random.normal(0, [0.4, 0.3]))
    diameter, density = 0.2794, 1.225
    force = TRUTH["motor_constant"] * (2 * math.pi) ** 2 / (density * diameter**4) * scatter[0]
    power = TRUTH["moment_constant"] * 2 * math.pi * force / diameter * scatter[1]
    numbers = {"thrust_coefficient": force, "power_coefficient": power}
    given = plan("propeller", diameter=diameter, air_density=density, **numbers)
    return measure_propeller("propeller", given, Path())


RIGS = (swing, thrust, torque, curve, steps, hover, spin, table)


def deviations(measurement):
    """Return by how many standard errors each number is off."""
    expected = [
        sum(factor * COEFFICIENTS[name].scaled(TRUTH[name]) for name, factor in row.items())
        for row in measurement.rows
    ]
    return (measurement.value - expected) / np.sqrt(np.diag(measurement.covariance))


@pytest.mark.parametrize("rig", RIGS)
def test_an_estimate_lies_near_the_truth(rig):
    assert (np.abs(deviations(rig(np.random.default_rng(0)))) < 4).all()


@pytest.mark.slow
@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize(
    ("repeats", "least"), [(24, 0.85), pytest.param(200, 0.9, marks=pytest.mark.long)]
)
def test_the_truth_lies_in_the_interval_as_often_as_it_says(rig, repeats, least):
    off = [deviations(rig(np.random.default_rng(seed))) for seed in range(repeats)]
    inside = np.mean(np.abs(np.concatenate(off)) < 1.959964)
    assert least <= inside <= (0.995 if repeats == 200 else 1.0), inside


def test_a_stuck_tachometer_is_refused():
    samples = rigs.steps_of_command(np.random.default_rng(0))
    stuck = samples | {"rotor_speed": np.full(len(samples["time"]), 500.0)}
    with pytest.raises(RecordingError, match="does not follow the command; check the columns"):
        measure_rpm_curve("rpm", "r.csv", stuck, plan("rpm_curve"))


def test_sensors_that_never_change_are_refused():
    random = np.random.default_rng(0)
    steps = rigs.motor_steps(random)
    still = steps | {"rotor_speed": np.zeros(len(steps["time"]))}
    with pytest.raises(RecordingError, match="a rotor speed that never changes"):
        measure_step_response("steps", "s.csv", still)
    samples, ruler = rigs.swing(random)
    hanging = samples | {"angle": np.zeros(len(samples["time"]))}
    with pytest.raises(RecordingError, match=r"shows 0\.0 oscillations"):
        measure_bifilar("x", "x.csv", hanging, plan("bifilar", axis="x", **ruler), QUAD)


def test_columns_that_never_change_are_read_as_they_are(tmp_path):
    path = tmp_path / "still.csv"
    rows = np.column_stack([np.arange(100) / 50, np.full(100, 5000.0), np.full(100, 1.5)])
    np.savetxt(path, rows, delimiter=",", header="time,rpm,force", comments="")
    read = read_columns(path, ("rotor_speed", "force"))
    assert (read["force"] == 1.5).all()


def test_a_command_without_a_speed_is_left_out():
    samples = rigs.steps_of_command(np.random.default_rng(0))
    third = samples["command"] == np.unique(samples["command"])[2]
    gone = samples | {"rotor_speed": np.where(third, np.nan, samples["rotor_speed"])}
    found = measure_rpm_curve("rpm", "r.csv", gone, plan("rpm_curve", reference_voltage=16.4))
    assert (np.abs(deviations(found)) < 4).all()


@pytest.mark.parametrize("held", [0.15, 0.0])
def test_a_body_held_before_its_release_is_no_beat(held):
    random = np.random.default_rng(0)
    samples, ruler = rigs.swing(random)
    before = held + random.normal(0, 0.02, 800)
    angle = np.concatenate([before, samples["angle"][100 if held == 0.0 else 0 :]])
    samples = {"time": np.arange(len(angle)) / 100, "angle": angle}
    errors = {"mass_error": 0.002 / ruler["mass"]}
    given = plan("bifilar", axis="x", **ruler, **errors)
    found = measure_bifilar("bifilar x", "x.csv", samples, given, QUAD)
    assert "beat" not in {remark.code for remark in found.remarks}
    assert (np.abs(deviations(found)) < 3).all()


@pytest.mark.parametrize("lag", [0.01, 0.02])
def test_a_second_lag_is_named_and_in_the_interval(lag):
    samples = rigs.motor_steps(np.random.default_rng(0), second=lag)
    found = measure_step_response("steps", "s.csv", samples)
    assert "not_first_order" in {remark.code for remark in found.remarks}
    assert (np.abs(deviations(found)) < 2).all()


def test_steps_on_a_sagging_battery_keep_their_time_constants():
    samples = rigs.motor_steps(np.random.default_rng(1))
    speed = samples["rotor_speed"] * (1 - 0.01 * samples["time"])
    found = measure_step_response("steps", "s.csv", samples | {"rotor_speed": speed})
    assert (np.abs(deviations(found)) < 2).all()


def test_a_coarse_tachometer_keeps_its_samples():
    samples = rigs.motor_steps(np.random.default_rng(0))
    coarse = samples | {"rotor_speed": np.round(samples["rotor_speed"] / 20) * 20}
    found = measure_step_response("steps", "s.csv", coarse)
    assert (np.abs(deviations(found)) < 3).all()
    curve_of = rigs.steps_of_command(np.random.default_rng(0))
    coarse = curve_of | {"rotor_speed": np.round(curve_of["rotor_speed"] / 20) * 20}
    found = measure_rpm_curve("rpm", "r.csv", coarse, plan("rpm_curve", reference_voltage=16.4))
    assert (np.abs(deviations(found)) < 3).all()


def test_telemetry_slower_than_its_log_is_no_latency(tmp_path):
    samples = rigs.motor_steps(np.random.default_rng(0))
    held = samples["rotor_speed"][np.arange(len(samples["time"])) // 10 * 10]
    path = tmp_path / "steps.csv"
    rows = np.column_stack([samples["time"], samples["command"], held])
    np.savetxt(path, rows, delimiter=",", header="time,command,rotor_speed", comments="")
    read = read_columns(path, ("command", "rotor_speed"))
    assert np.mean(np.isfinite(read["rotor_speed"])) == pytest.approx(0.1, abs=0.02)
    assert (np.abs(deviations(measure_step_response("steps", "s.csv", read))) < 3).all()


def test_stopped_motors_are_no_part_of_the_curve():
    samples = rigs.steps_of_command(np.random.default_rng(0))
    before = {name: np.zeros(200) for name in ("command", "rotor_speed")}
    begun = {"time": np.arange(200) / 50, **before, "voltage": np.full(200, 16.4)}
    given = plan("rpm_curve", reference_voltage=16.4)
    alone = measure_rpm_curve("rpm", "r.csv", samples, given)
    later = samples | {"time": samples["time"] + 4.0}
    whole = {name: np.concatenate([begun[name], later[name]]) for name in samples}
    found = measure_rpm_curve("rpm", "r.csv", whole, given)
    errors = np.sqrt(np.diag(alone.covariance))
    assert np.abs(found.value - alone.value) == pytest.approx(0, abs=0.2 * errors.min())
    assert np.sqrt(np.diag(found.covariance)) == pytest.approx(errors, rel=0.05)


@pytest.mark.parametrize("samples_early", [0, 3, 10])
def test_a_speed_that_reacts_before_its_commands_stamp_leaves_the_time_constants(samples_early):
    off = []
    for seed in range(6):
        run = rigs.motor_steps(np.random.default_rng(seed), rate=400.0)
        count = len(run["time"]) - samples_early
        early = {name: run[name][:count] for name in ("time", "command")}
        found = measure_step_response(
            "steps", "s.csv", early | {"rotor_speed": run["rotor_speed"][samples_early:]}
        )
        off.append(deviations(found))
        told = {remark.code: remark.numbers for remark in found.remarks}
        assert ("command_late" in told) is (samples_early > 2)
        if samples_early > 2:
            seconds = samples_early / 400.0 - TRUTH["actuator_latency"]
            assert told["command_late"]["seconds"] == pytest.approx(seconds, abs=0.0025)
    assert (np.abs(np.mean(off, axis=0)) < 1.5).all()
    assert (np.abs(off) < 3.0).all()


def test_a_wrong_lever_ratio_conflicts_with_the_hovers():
    random = np.random.default_rng(3)
    wrong = thrust(random, lever=1.0)
    known = {name: COEFFICIENTS[name].scaled(TRUTH[name]) for name in TRUTH if name in KNOWN}
    together = combine([wrong, hover(random)], known)
    assert together.p_value < 1e-6
    assert {conflict.experiment for conflict in together.conflicts} == {"thrust", "hover"}
    right = combine([thrust(random), hover(random)], known)
    assert right.conflicts == ()
    assert right.p_value > 0.001


KNOWN = {"motor_constant", "moment_constant", "rotor_drag_coefficient"}


def test_what_was_not_measured_stays_near_the_vehicle_file():
    known = {"motor_constant": math.log(1.4e-5), "moment_constant": math.log(0.04)}
    alone = combine([torque(np.random.default_rng(5))], known)
    assert not alone.determined.any()
    product = math.exp(alone.scaled.sum())
    assert product == pytest.approx(TRUTH["moment_constant"] * TRUTH["motor_constant"], rel=0.03)
