"""Flights without a pose: what gyro, accelerometer and commands say agrees with what flew."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.tuner.recordings.micro_sd import log_of
from tuner.config import TrajectorySettings, resolve_settings
from tuner.core.errors import InputError, RecordingError
from tuner.core.shipped import configs_folder
from tuner.evaluate.closed_loop import fly, simulate
from tuner.findings.findings import Code, one_line
from tuner.ground.measurement import Combination, joint_prior
from tuner.inertial.measurement import measure_inertial
from tuner.inertial.signals import rate_errors, stretches_of
from tuner.job.bench import measured_vehicle, resolution_of
from tuner.job.without_pose import fit_without_pose
from tuner.options import Options, SimulationOptions
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.loader import read_inertial
from tuner.recordings.notes import NoteCode
from tuner.report.contents import read_contents
from tuner.report.outcome import outcome
from tuner.result import BEST_FIT_FILE
from tuner.search.job_flights import read_inertial_flights, read_recordings
from tuner.uncertainty.verdict import Verdict
from tuner.vehicle import ControllerFile, read_vehicle, values_of, with_values

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
LATENCY = 0.004
WRONG = {"motor_constant": 1.3, "inertia_xx": 0.7, "inertia_yy": 1.2, "time_constant_up": 2.0}
SHOWN = ("inertia_xx", "inertia_yy", "time_constant_up", "time_constant_down")
G = 9.80665
ORDER = (1, 3, 4, 2)
"""Where the Crazyflie's motors m1 to m4 stand in PX4's order, from 1."""


@pytest.fixture(scope="module")
def flown(updated):
    return with_values(updated, {"actuator_latency": LATENCY})


@pytest.fixture(scope="module")
def simulation(flown):
    shape = TrajectorySettings(name="lemniscate", radius=1.0, omega=1.0, speed_scale=4.0)
    return next(iter(simulate(flown, ControllerFile(), shape, duration=14.0, rate=400.0)))


@pytest.fixture(scope="module")
def measured(simulation, flown, tmp_path_factory):
    """What the flight says: of tests about what is made of it."""
    path = log_file(simulation, tmp_path_factory.mktemp("measured") / "log00")
    ((flight,), _) = read_inertial_flights(settings_for(path, flown))
    return measure_inertial(flight, flown)


def log_file(simulation, path, *, order=ORDER, noise=1.0):
    """Write what a Crazyflie's memory card would hold, noise included, and nothing of the pose."""
    generator, signals = np.random.default_rng(3), simulation.signals
    rate = np.degrees(signals["body_rate"]) + noise * generator.normal(
        0.0, 0.1, (len(simulation.time), 3)
    )
    force = signals["acceleration"] / G + noise * generator.normal(0.0, 0.02, rate.shape)
    columns = {f"gyro.{axis}": ("f", rate[:, i]) for i, axis in enumerate("xyz")}
    columns |= {f"acc.{axis}": ("f", force[:, i]) for i, axis in enumerate("xyz")}
    for rotor, place in enumerate(order):
        pwm = 65535 * signals["command"][:, rotor]
        columns[f"motor.m{place}"] = ("I", pwm)
    return log_of(simulation.time, dict(sorted(columns.items())), path)


@pytest.mark.parametrize("name", ["lemniscate", "straight", "hover"])
def test_a_simulated_log_without_noise_is_fitted_or_refused(name, flown, tmp_path):
    """A simulation turns about no axis that it is not sent about: a misfit is exactly zero."""
    shape = TrajectorySettings(name=name, radius=1.0, omega=1.0, speed_scale=4.0)
    simulation = next(iter(simulate(flown, ControllerFile(), shape, duration=14.0, rate=400.0)))
    path = log_file(simulation, tmp_path / "log00", noise=0.0)
    settings = settings_for(path, flown)
    flights, _ = read_inertial_flights(settings)
    if name == "hover":
        with pytest.raises(RecordingError, match="nothing turns it"):
            fit_without_pose(settings, flights, out=tmp_path / "run")
        return
    fitted = fit_without_pose(settings, flights, out=tmp_path / "run")
    truth = dict.fromkeys(("torque_trim_x", "torque_trim_y", "torque_trim_z"), 0.0)
    truth |= values_of(flown)
    for coefficient, found in fitted.result.coefficients.items():
        assert np.isfinite(found.best), coefficient
        if found.std_error is not None:
            assert found.std_error > 0.0
            close = max(5.0 * found.std_error, 0.05 * abs(truth[coefficient]))
            assert abs(found.best - truth[coefficient]) < close, coefficient


TRIM = 0.02
"""Share of the weight that, at a rotor's place, turns the vehicle steadily."""


def settings_for(path, vehicle):
    return resolve_settings(Options([str(path)], vehicle=vehicle))


def test_intervals_hold_the_vehicle_that_flew(simulation, flown, tmp_path):
    truth = values_of(flown)
    start = with_values(flown, {n: truth[n] * factor for n, factor in WRONG.items()})
    path = log_file(simulation, tmp_path / "log00", order=(1, 3, 4, 2))
    settings = settings_for(path, with_values(start, {"actuator_latency": 0.0}))
    ((flight,), _) = read_inertial_flights(settings)
    assert flight.flying[0][1] > 13.0
    fitted = fit_without_pose(settings, [flight], out=tmp_path / "run")
    result = fitted.result.coefficients
    for name in SHOWN:
        error = result[name].std_error
        assert error is not None, name
        assert abs(result[name].best - truth[name]) < 3.0 * error, name
        assert error < 0.25 * truth[name], name
    assert abs(result["actuator_latency"].best - LATENCY) < 0.004
    assert result["motor_constant"].best == pytest.approx(truth["motor_constant"], rel=0.02)
    over = result["moment_constant"].best / result["inertia_zz"].best
    assert over == pytest.approx(truth["moment_constant"] / truth["inertia_zz"], rel=0.03)
    assert result["moment_constant"].std_error is None  # each by itself stays open
    assert not result["mass"].fitted
    codes = {finding.code for finding in fitted.result.findings}
    assert codes == {Code.SCALES_WITH_MASS, Code.NO_TACHOMETER, Code.YAW_OPEN}
    contents = read_contents(fitted.folder)
    said = outcome(contents.run.result, contents.bench).what
    assert said == "12 coefficients come from 1 flight without a pose; none was simulated."
    again = values_of(read_vehicle(fitted.folder / BEST_FIT_FILE))
    assert again["inertia_xx"] == result["inertia_xx"].best


@pytest.mark.parametrize("name", ["circle", "lemniscate"])
def test_air_that_drags_at_the_rotors_is_not_taken_for_inertia(name, tmp_path):
    """At 4 m/s the moment of the shipped rotor drag is three times that of the turning, or more."""
    vehicle = read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml")
    (flown,) = fly(
        SimulationOptions(trajectory=name, vehicle=vehicle, speed=4.0, duration=16.0, rate=400.0)
    )
    settings = settings_for(log_file(flown, tmp_path / "log00", noise=0.0), vehicle)
    fitted = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")
    truth = values_of(vehicle)
    for coefficient in SHOWN:
        found = fitted.result.coefficients[coefficient]
        assert found.std_error is not None or name == "circle"  # where the drag is all that turns
        if found.std_error is not None:
            assert abs(found.best - truth[coefficient]) < 3.0 * found.std_error, coefficient
    for coefficient in ("inertia_xx", "inertia_yy", "motor_constant"):
        found = fitted.result.coefficients[coefficient]
        assert found.best == pytest.approx(truth[coefficient], rel=0.1), coefficient


def test_a_motor_constant_is_known_only_with_the_curve_of_rotor_speeds(simulation, flown, tmp_path):
    """Rotors that turn at 0.8 of the speeds and give more fly what was flown."""
    truth = values_of(flown)
    slower = {name: 0.8 * truth[name] for name in ("input_scaling", "zero_position_armed")}
    settings = settings_for(log_file(simulation, tmp_path / "log00"), with_values(flown, slower))
    fitted = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")
    result = fitted.result.coefficients
    motor, curve = result["motor_constant"], result["input_scaling"]
    assert motor.verdict is curve.verdict is Verdict.NOT_IDENTIFIABLE
    assert motor.reason.correlated_with == "input_scaling"
    assert curve.best == pytest.approx(slower["input_scaling"], rel=1e-9)
    assert motor.best == pytest.approx(truth["motor_constant"] / 0.8**2, rel=0.02)
    for name in ("inertia_xx", "inertia_yy"):
        assert abs(result[name].best - truth[name]) < 3.0 * result[name].std_error, name
    prior = joint_prior(fitted.folder)
    places = [prior.names.index(name) for name in ("motor_constant", "input_scaling")]
    along = np.array([2.0, -1.0])
    information = prior.information[np.ix_(places, places)]
    assert along @ information @ along < 1e-9 * np.trace(information)


def test_a_vehicle_file_of_another_size_gives_a_rigid_body(simulation, flown, tmp_path):
    truth = values_of(flown)
    wrong = {name: 9.0 * truth[name] for name in ("inertia_xx", "inertia_yy", "inertia_zz")}
    settings = settings_for(log_file(simulation, tmp_path / "log00"), with_values(flown, wrong))
    fitted = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")
    best = values_of(read_vehicle(fitted.folder / BEST_FIT_FILE))
    assert best["inertia_xx"] == pytest.approx(truth["inertia_xx"], rel=0.1)
    assert best["inertia_zz"] == pytest.approx(truth["inertia_zz"], rel=0.1)  # the proportion's


def test_a_steady_moment_is_the_vehicles_trim(flown, tmp_path):
    x, _, _ = flown.rotors[0].position
    moment = TRIM * flown.mass * G * abs(x)
    trimmed = with_values(flown, {"torque_trim_x": moment, "torque_trim_y": -2.0 * moment})
    shape = TrajectorySettings(name="lemniscate", radius=1.0, omega=1.0, speed_scale=4.0)
    simulation = next(iter(simulate(trimmed, ControllerFile(), shape, duration=14.0, rate=400.0)))
    settings = settings_for(log_file(simulation, tmp_path / "log00"), flown)
    fitted = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")
    best = values_of(read_vehicle(fitted.folder / BEST_FIT_FILE))
    for name, truth in {"torque_trim_x": moment, "torque_trim_y": -2.0 * moment}.items():
        assert best[name] == pytest.approx(truth, rel=0.1), name
        assert fitted.result.coefficients[name].fitted
        # known by its own size or the vehicle's, whichever is larger, small as the vehicle may be
        assert resolution_of(name, flown) < 0.1 * moment
        assert resolution_of(name, flown.replace(mass=1e-3)) < 1e-3 * moment
    # the file that leaves the trims out foretells the body rate worse
    ((flight,), _) = read_inertial_flights(settings)
    stretches = stretches_of(flight.series, flight.flying)
    *_, foretold = rate_errors(stretches, flown, read_vehicle(fitted.folder / BEST_FIT_FILE))
    assert foretold.fitted < 0.5 * foretold.initial
    codes = {finding.code for finding in fitted.result.findings}
    assert Code.RATE_WORSE not in codes


def test_a_fit_that_foretells_worse_says_so(simulation, flown, measured, tmp_path, monkeypatch):
    settings = settings_for(log_file(simulation, tmp_path / "log00"), flown)
    wrong = with_values(flown, {"inertia_xx": 2.0 * values_of(flown)["inertia_xx"]})
    monkeypatch.setattr("tuner.job.without_pose.measured_vehicle", lambda *_: wrong)
    monkeypatch.setattr("tuner.job.without_pose.measure_inertial", lambda *_: measured)
    fitted = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")
    (worse,) = [f for f in fitted.result.findings if f.code is Code.RATE_WORSE]
    assert worse.level == "warning"
    assert worse.numbers["after"] > worse.numbers["before"]


def test_a_moment_that_commands_do_not_say_adds_up_until_holding_is_better(
    simulation, flown, measured, tmp_path, monkeypatch
):
    wrong = with_values(flown, {"torque_trim_x": 5.0 * values_of(flown)["inertia_xx"]})
    settings = settings_for(log_file(simulation, tmp_path / "log00"), wrong)
    monkeypatch.setattr("tuner.job.without_pose.measured_vehicle", lambda *_: wrong)
    monkeypatch.setattr("tuner.job.without_pose.measure_inertial", lambda *_: measured)
    ((flight,), _) = read_inertial_flights(settings)
    fitted = fit_without_pose(settings, [flight], out=tmp_path / "run")
    (held,) = [f for f in fitted.result.findings if f.code is Code.RATE_NOT_PREDICTED]
    for errors in rate_errors(stretches_of(flight.series, flight.flying), wrong, wrong):
        assert (errors.fitted < errors.hold) == (errors.seconds < held.numbers["seconds"])
    assert held.numbers["seconds"] > 0.1


@pytest.mark.slow
def test_a_heavier_vehicle_scales_thrust_and_inertia_alike(
    simulation, flown, measured, tmp_path, monkeypatch
):
    path = log_file(simulation, tmp_path / "log00")
    settings = settings_for(path, flown.replace(mass=2.0 * flown.mass))
    heavy = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "heavy")
    settings = settings_for(path, flown)
    monkeypatch.setattr("tuner.job.without_pose.measure_inertial", lambda *_: measured)
    light = fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "light")
    for name in ("motor_constant", "inertia_xx", "inertia_yy"):
        pair = [run.result.coefficients[name].best for run in (light, heavy)]
        assert pair[1] / pair[0] == pytest.approx(2.0, rel=1e-6), name


def test_commands_of_other_motors_are_refused_in_one_line(simulation, flown, tmp_path):
    # motor 3 is logged where the map expects motor 1, and so on
    path = log_file(simulation, tmp_path / "log00", order=(3, 1, 2, 4))
    settings = settings_for(path, flown)
    # the map lists m1, m3, m4, m2: the rotors from front right on are now m3, m1, m2, m4
    with pytest.raises(RecordingError, match="2, 1, 4 and 3 of the columns that the topic map"):
        fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_rotors_that_spin_the_other_way_are_noticed(simulation, flown, tmp_path):
    rate = simulation.signals["body_rate"] * [1.0, 1.0, -1.0]
    mirrored = replace(simulation, signals={**simulation.signals, "body_rate": rate})
    settings = settings_for(log_file(mirrored, tmp_path / "log00"), flown)
    with pytest.raises(RecordingError, match=r"(?s)yaw.*spins"):
        fit_without_pose(settings, read_inertial_flights(settings)[0], out=tmp_path / "run")


def test_a_log_on_the_ground_is_refused(tmp_path):
    time = np.arange(2000) / 400
    nothing = np.zeros(2000)
    columns = {f"{kind}.{axis}": ("f", nothing) for kind in ("gyro", "acc") for axis in "xyz"}
    columns |= {f"motor.m{i}": ("I", nothing) for i in range(1, 5)}
    with pytest.raises(RecordingError, match="the motors only idle"):
        read_inertial(log_of(time, columns, tmp_path / "log00"))


@pytest.mark.parametrize(("rate", "seconds", "refusal"), [
    (400.0, 10.0, None), (119.0, 10.0, "command at 119 Hz"), (400.0, 1.5, "the motors only idle"),
])  # fmt: skip
def test_inspect_and_tune_agree_on_what_can_be_fitted(rate, seconds, refusal, tmp_path):
    time = np.arange(int(seconds * rate)) / rate
    columns = {f"{kind}.{axis}": ("f", time) for kind in ("gyro", "acc") for axis in "xyz"}
    columns |= {f"motor.m{i}": ("I", 30000 + 0 * time) for i in range(1, 5)}
    path = log_of(time, columns, tmp_path / "log00")
    (seen,), _ = inspect_recordings([path])
    fitted = [note for note in seen.notes if note.code is NoteCode.WITHOUT_POSE]
    if refusal is None:
        assert read_inertial(path) is not None
        assert seen.problem is None
        assert fitted
        return
    with pytest.raises(RecordingError, match=refusal) as caught:
        read_inertial(path)
    assert seen.problem == f"{caught.value.what}; {caught.value.remedy}"
    assert not fitted


def test_what_cannot_be_used_is_left_out_and_what_is_held_out_is_predicted(
    simulation, flown, tmp_path
):
    fitted = log_file(simulation, tmp_path / "log00")
    held_out = log_file(simulation, tmp_path / "log01")
    mixed_up = log_file(simulation, tmp_path / "log02", order=(3, 1, 2, 4))
    still = np.zeros(2000)
    columns = {f"{kind}.{axis}": ("f", still) for kind in ("gyro", "acc") for axis in "xyz"}
    columns |= {f"motor.m{i}": ("I", still) for i in range(1, 5)}
    on_ground = log_of(np.arange(2000) / 400, columns, tmp_path / "log03")
    paths = [str(path) for path in (on_ground, fitted, held_out, mixed_up)]
    start = with_values(flown, {"inertia_xx": 0.7 * values_of(flown)["inertia_xx"]})
    settings = resolve_settings(Options(paths, vehicle=start, holdout=["log01"]))
    flights, left_out = read_inertial_flights(settings)
    assert [flight.name for flight in flights] == ["log00", "log01", "log02"]
    run = fit_without_pose(settings, flights, left_out=left_out, out=tmp_path / "run")
    assert [experiment.name for experiment in run.record.experiments] == ["log00"]
    left = [f for f in run.result.findings if f.code is Code.LEFT_OUT]
    assert [finding.subject for finding in left] == ["log03", "log02"]
    assert "of the columns that the topic map lists" in one_line(left[1])
    (foretold,) = [f for f in run.result.findings if f.subject == "log01"]
    assert foretold.numbers["after"] < foretold.numbers["before"]
    with pytest.raises(RecordingError, match="the motors only idle"):
        read_inertial_flights(resolve_settings(Options([str(on_ground)], vehicle=flown)))
    with pytest.raises(InputError, match="holds out all flights that can be used"):
        fit_without_pose(settings, flights[1:2], out=tmp_path / "run")


def test_beside_flights_with_a_pose_those_without_one_are_left_out(simulation, flown, tmp_path):
    bare, posed = log_file(simulation, tmp_path / "log00"), FLIGHTS / "circle_4mps.bag"
    settings = resolve_settings(Options([str(bare), str(posed)], vehicle=flown, holdout=[]))
    assert read_inertial_flights(settings) == ((), ())
    usable, (left_out,) = read_recordings(settings)
    assert [recording.flight.name for recording in usable] == ["circle_4mps"]
    assert left_out.subject == "log00"
    assert "by themselves" in one_line(left_out)


def test_lags_near_zero_that_combine_to_less_are_zero(tmp_path):
    combination = Combination(
        names=("actuator_latency",),
        scaled=np.array([-0.002]),
        information=np.array([[1e6]]),
        covariance=np.array([[1e-6]]),
        chi_square=0.0,
        degrees_of_freedom=1,
        p_value=1.0,
        conflicts=(),
    )
    vehicle = measured_vehicle(
        tmp_path / "a.ulg",
        read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml"),
        combination,
    )
    assert vehicle.setup.actuator_latency == 0.0
