"""Open-loop predictions: the truth predicts, nothing of the flight ahead is looked at."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import fast_flights
from benchmarks.prediction import (
    HELD_OUT,
    LinearRegression,
    cut,
    options_for_set,
    weighed_mass,
    with_pose,
)
from tuner.config import resolve_settings
from tuner.core.errors import InputError
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.prediction import LAGS, FlightPredictor, Predictions, TorqueObserver, hold_state
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.objective.segments import stamped_earlier
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.loader import InertialFlight
from tuner.recordings.states import MIN_HALF_WIDTH_S
from tuner.search.job_flights import JobFlight, read_recordings
from tuner.vehicle import ControllerFile, with_values


def predict(vehicle, flight, inlet, *, stride=0.2, input_late=0.0):
    predictor = FlightPredictor(flight, inlet, stride=stride, input_late=input_late)
    return predictor.predict(vehicle, ControllerFile())


@pytest.fixture(scope="module")
def truth(full_flight, updated):
    return FlightPredictor(full_flight, "rotor_speed", stride=0.2).predict(
        updated, ControllerFile()
    )


def test_the_vehicle_that_flew_predicts_its_flight_better_than_one_that_holds(truth, full_flight):
    naive = hold_state(full_flight, truth.begins, truth.ahead)
    for name in PREDICTED_UNITS:
        assert truth.mean(0.5)[name] < 0.05 * naive.mean(0.5)[name], name
    assert truth.errors["position"].shape == (50, len(truth.begins))
    assert truth.begins[-1] + 0.5 <= full_flight.duration
    assert naive.mean(0.5)["position"] > naive.mean(0.1)["position"] > 0.0


def test_the_distances_are_euclidean_and_the_angle_is_geodesic(truth, full_flight):
    naive = hold_state(full_flight, truth.begins[:1], truth.ahead)
    time, place = full_flight.time, full_flight.signals["position"]
    begin = int(np.searchsorted(time, truth.begins[0]))
    moved = np.linalg.norm(place[begin + 50] - place[begin])
    assert naive.errors["position"][-1, 0] == pytest.approx(moved, abs=1e-3)
    first, last = full_flight.signals["attitude"][[begin, begin + 50]]
    angle = 2 * np.arccos(abs(first @ last))
    assert naive.errors["attitude"][-1, 0] == pytest.approx(angle, abs=2e-3)


def test_a_wrong_vehicle_predicts_worse_and_a_late_input_is_put_right(truth, full_flight, updated):
    heavy = with_values(updated, {"motor_constant": 0.9 * updated.aerodynamics.motor_constant})
    worse = predict(heavy, full_flight, "rotor_speed")
    assert worse.mean(0.5)["velocity"] > 5 * truth.mean(0.5)["velocity"]
    speed = full_flight.series["rotor_speed"]
    late = replace(
        full_flight,
        series=dict(full_flight.series) | {"rotor_speed": Series(speed.time + 0.02, speed.values)},
    )
    off = predict(updated, late, "rotor_speed")
    right = predict(updated, late, "rotor_speed", input_late=0.02)
    assert off.mean(0.5)["body_rate"] > 2 * right.mean(0.5)["body_rate"]
    assert right.mean(0.5) == pytest.approx(truth.mean(0.5), rel=0.02)


def test_what_is_followed_is_not_called_predicted(full_flight, updated):
    followed = FlightPredictor(full_flight, "attitude", stride=1.0).predict(
        updated, ControllerFile()
    )
    assert set(followed.errors) == {"position", "velocity"}
    means = followed.mean(0.5)
    assert means["position"] < 0.05
    assert np.isnan(means["attitude"])


def test_what_lies_ahead_is_not_looked_at(truth, full_flight, updated):
    position = full_flight.series["position"]
    moved = position.values + np.where(position.time > truth.begins[5] + 0.1, 1.0, 0.0)[:, None]
    changed = replace(
        full_flight,
        series=dict(full_flight.series) | {"position": Series(position.time, moved)},
    )
    elsewhere = FlightPredictor(changed, "rotor_speed", stride=0.2).predict(
        updated, ControllerFile()
    )
    for name in ("velocity", "attitude", "body_rate"):
        np.testing.assert_allclose(
            elsewhere.errors[name][:, 5], truth.errors[name][:, 5], rtol=1e-9, err_msg=name
        )
    assert elsewhere.errors["position"][-1, 5] == pytest.approx(np.sqrt(3.0), rel=0.02)


@pytest.mark.parametrize("inlet", ["body_rate", "actuator", "attitude"])
def test_no_inlet_looks_at_the_path_ahead(full_flight, updated, inlet):
    position = full_flight.series["position"]
    ahead = (position.time > 3.0 + 1.1 * MIN_HALF_WIDTH_S) & (position.time < 3.4)
    away = 0.02  # m: as far as a start might have been from where it was recorded
    shifted = Series(position.time, position.values + np.where(ahead, away, 0.0)[:, None])
    elsewhere = replace(full_flight, series=dict(full_flight.series) | {"position": shifted})
    wrong = with_values(updated, {"motor_constant": 0.98 * updated.aerodynamics.motor_constant})

    def errors(flight):
        comparison = Comparison([JobFlight(flight, inlet)], ControllerFile())
        name, predicted = (
            flight.name,
            predict(wrong, flight, inlet, stride=1.0),
        )
        return (
            comparison.fly(wrong)[name],
            comparison.fly(wrong, fitted_starts=True)[name],
            predicted,
        )

    (windows, met, predicted), (windows_moved, met_moved, moved) = map(
        errors, (full_flight, elsewhere)
    )
    there = (windows.position.time > 3.0 + 1.1 * MIN_HALF_WIDTH_S) & (windows.position.time < 3.4)
    only_recorded = np.where(there, -away, 0.0)[:, None].repeat(3, 1)
    change = windows_moved.position.error - windows.position.error
    np.testing.assert_allclose(change, only_recorded, atol=1e-9)
    np.testing.assert_allclose(windows_moved.attitude.error, windows.attitude.error, atol=1e-9)
    followed = met_moved.position.error - met.position.error - only_recorded
    assert np.abs(followed).max() > 0.1 * away  # the test would see a start that is fitted
    begun = np.flatnonzero(np.isclose(predicted.begins, 3.0))
    behind = predicted.ahead > 0.4 + 2.0 * MIN_HALF_WIDTH_S  # where the path is as recorded again
    for name in set(predicted.errors) - {"position"}:
        np.testing.assert_allclose(
            moved.errors[name][:, begun], predicted.errors[name][:, begun], rtol=1e-9
        )
    change = moved.errors["position"][:, begun] - predicted.errors["position"][:, begun]
    np.testing.assert_allclose(change[behind], 0.0, atol=1e-9)
    assert np.abs(change[~behind]).max() > 0.5 * away


def test_a_comparison_of_windows_predicts_and_names_what_is_fitted_otherwise(full_flight, updated):
    wrong = with_values(updated, {"torque_trim_x": 0.02})
    comparison = Comparison([JobFlight(full_flight, "rotor_speed")], ControllerFile())
    predicted = comparison.fly(wrong)[full_flight.name].rmse
    met = comparison.fly(wrong, fitted_starts=True)[full_flight.name].rmse
    assert predicted.roll > 3 * met.roll  # a trim in each window hides what is wrong
    assert comparison.fly(updated)[full_flight.name].rmse.roll < 0.1 * predicted.roll


def test_fitted_starts_meet_a_flight_no_worse_than_recorded_ones(full_flight, updated):
    # rotors that lift half as much: steps towards the likeliest start overshoot
    wrong = with_values(updated, {"angular_drag_x": -0.2, "torque_trim_x": 0.3})
    comparison = Comparison([JobFlight(full_flight, "rotor_speed")], ControllerFile())
    predicted = comparison.fly(wrong)[full_flight.name]
    met = comparison.fly(wrong, fitted_starts=True)[full_flight.name]
    assert met.rmse.norm("attitude") < predicted.rmse.norm("attitude")


def of_attitude(error, seconds=0.5):
    begins = 0.1 * np.arange(len(error))
    return Predictions(begins, np.array([seconds]), {"attitude": np.asarray(error)[None]})


def test_another_predicts_better_where_its_errors_are_smaller_by_more_than_chance():
    random = np.random.default_rng(0)
    held = 0.07 + 0.02 * random.standard_normal(300)
    worse = of_attitude(held + 0.02 + 0.02 * random.standard_normal(300))
    assert worse.worse_than(of_attitude(held), 0.5) == ("attitude",)
    assert of_attitude(held).worse_than(worse, 0.5) == ()
    lost = np.where(np.arange(300) < 30, np.nan, worse.errors["attitude"][0])
    assert of_attitude(lost).worse_than(of_attitude(held), 0.5) == ("attitude",)
    few = of_attitude(worse.errors["attitude"][0, :20])
    assert few.worse_than(of_attitude(held[:20]), 0.5) == ()


def test_errors_that_predictions_share_are_chance_but_once():
    found = []
    for seed in range(200):
        random = np.random.default_rng(seed)
        disturbed = np.repeat(random.standard_normal(30), 10)  # 1 s each, all of 30 s
        found.append(of_attitude(0.1 + 0.02 * disturbed).worse_than(of_attitude([0.1] * 300), 0.5))
    assert 0.0 < np.mean([bool(names) for names in found]) < 0.06  # 2.5 % to one side


def without_speeds(flight):
    series, signals = (
        {name: one for name, one in of.items() if name != "rotor_speed"}
        for of in (flight.series, flight.signals)
    )
    return replace(flight, series=series, signals=signals)


def test_a_predictor_predicts_each_vehicle_and_loop_as_if_it_were_the_first(full_flight, updated):
    """Rotors that no tachometer shows begin as their lag has it; steps are the loop's."""
    lags = dict.fromkeys(("time_constant_up", "time_constant_down"), 0.2)
    slow, usual = with_values(updated, lags), ControllerFile()
    fine = usual.replace(physics=usual.physics.replace(rate=800.0))

    def make():
        return FlightPredictor(without_speeds(full_flight), "actuator", stride=2.0)

    first = make()
    for vehicle, controller in ((updated, usual), (slow, usual), (slow, fine)):
        again, fresh = (p.predict(vehicle, controller) for p in (first, make()))
        for name, errors in fresh.errors.items():
            np.testing.assert_array_equal(again.errors[name], errors, err_msg=name)


def test_rotors_of_a_window_followed_the_commands_at_their_corrected_times(full_flight, updated):
    """Stamps of commands that are late, by a lateness that is known, change no error."""
    flight = without_speeds(full_flight)
    late = stamped_earlier(flight, ["command"], -0.05)
    plain, corrected = (
        Comparison([recording], ControllerFile()).fly(updated)[flight.name].attitude.error
        for recording in (
            JobFlight(flight, "actuator"),
            JobFlight(late, "actuator", input_late=0.05),
        )
    )
    apart = np.abs(corrected - plain).max(axis=1)
    assert np.median(apart) < 1e-9  # few windows lack the commands before them


# what turns a vehicle unseen: told from the samples before a prediction, and from them alone

LASTS = 0.08
"""s that the racer's hidden torques last."""


@pytest.fixture(scope="module")
def flights():
    racer = fast_flights.drawn(4)
    return racer, fast_flights.fly(racer, seed=4, seconds=7.0)


@pytest.fixture(scope="module", params=["rotor_speed", "command"])
def flown(request, flights, tmp_path_factory):
    """The racer as it is, its recordings and what observes it."""
    folder, (racer, signals) = tmp_path_factory.mktemp("fast"), flights
    paths = fast_flights.write(racer, signals, folder, seed=4, fed=request.param)
    settings = resolve_settings(
        Options([str(path) for path in paths], config=str(folder / "tune.yaml"))
    )
    recordings, _ = read_recordings(settings)
    motor = {
        "input_scaling": fast_flights.FASTEST - fast_flights.IDLE,
        "zero_position_armed": fast_flights.IDLE,
        "time_constant_up": fast_flights.MOTOR_LAG,
        "time_constant_down": fast_flights.MOTOR_LAG,
    }
    vehicle = with_values(settings.vehicle, racer.values | motor)
    known = [(r.flight, r.inlet, 0.0) for r in recordings if not r.holdout]
    observer = TorqueObserver.of(vehicle, settings.controller, known)
    return vehicle, settings.controller, recordings, observer


def test_a_hidden_torque_lasts_as_long_as_it_was_made_to(flown):
    *_, observer = flown
    early = LAGS <= 0.05
    made = np.exp(-LAGS[early] / LASTS)
    for axis in (0, 1):  # about z it is as small as the gyro's noise
        np.testing.assert_allclose(observer.autocorrelation[early, axis], made, atol=0.13)
    assert not observer.autocorrelation[-1].any()


def test_what_is_known_of_it_predicts_turning_better(flown):
    vehicle, controller, recordings, observer = flown
    for recording in recordings:
        if not recording.holdout:
            continue
        predictor = FlightPredictor(recording.flight, recording.inlet, stride=0.05)
        alone, observed = (predictor.predict(vehicle, controller, of) for of in (None, observer))
        for seconds, quantity, most in ((0.05, "body_rate", 0.75), (0.1, "attitude", 0.75)):
            assert observed.mean(seconds)[quantity] < most * alone.mean(seconds)[quantity]


def test_it_is_told_by_no_sample_that_is_yet_to_come(flown):
    *_, recordings, observer = flown
    flight, inlet = recordings[0].flight, recordings[0].inlet
    begins = np.array([1.0, 3.0, 5.0])

    def moment(given):
        acting = observer.disturbance((given, inlet, 0.0), begins).moment
        return np.stack([acting.x, acting.y, acting.z])

    series = dict(flight.series)
    for name in ("body_rate", "rotor_speed", "command"):
        if name in series:
            rows = series[name]
            filtered = MIN_HALF_WIDTH_S if name == "body_rate" else 1e-9
            later = (rows.time > 3.0 + filtered)[:, None]
            series[name] = Series(rows.time, np.where(later, 0.9 * rows.values, rows.values))
    here, elsewhere = moment(flight), moment(replace(flight, series=series))
    np.testing.assert_array_equal(elsewhere[..., :2], here[..., :2])
    assert np.abs(elsewhere[..., 2] - here[..., 2]).max() > 1e-3


def test_noise_alone_is_not_carried_on(full_flight, updated):
    gyro = full_flight.series["body_rate"]
    noisy = gyro.values + 0.01 * np.random.default_rng(0).normal(size=gyro.values.shape)
    series = dict(full_flight.series) | {"body_rate": Series(gyro.time, noisy)}
    flight = replace(full_flight, series=series)
    observer = TorqueObserver.of(updated, ControllerFile(), [(flight, "rotor_speed", 0.0)])
    predictor = FlightPredictor(flight, "rotor_speed", stride=0.2)
    alone, observed = (predictor.predict(updated, ControllerFile(), of) for of in (None, observer))
    for seconds in (0.1, 0.5):
        assert observed.mean(seconds) == pytest.approx(alone.mean(seconds), rel=0.05)


def test_a_flight_that_no_recorded_rotor_turns_tells_nothing(full_flight, updated):
    fed = (full_flight, "attitude", 0.0)
    assert TorqueObserver.of(updated, ControllerFile(), [fed]) is None
    by_rotors = (full_flight, "rotor_speed", 0.0)
    observer = TorqueObserver.of(updated, ControllerFile(), [fed, by_rotors])
    assert observer.disturbance(fed, np.array([1.0])) is None


# the predictors that a fit is held against, and what a set of recordings is fitted with


def test_linear_regression_predicts_better_than_one_that_holds(full_flight):
    begins, ahead = np.arange(0.2, 5.0, 0.1), np.arange(1, 51) * 0.01
    regression = LinearRegression.of([full_flight], "rotor_speed")
    predicted = regression.predict(full_flight, begins, ahead)
    naive = hold_state(full_flight, begins, ahead)
    for name in ("position", "velocity", "attitude"):
        assert predicted.mean(0.5)[name] < 0.3 * naive.mean(0.5)[name], name
    assert predicted.errors["body_rate"].shape == (50, len(begins))


def test_a_set_brings_its_own_job_or_two_flights_are_held_out(tmp_path):
    folder = tmp_path / "lab"
    folder.mkdir()
    with pytest.raises(InputError, match="holds no recording"):
        options_for_set(folder)
    for name in ("a.csv", "b.csv", "c.csv", "d.csv", "README.md", "LICENSE"):
        (folder / name).write_text("")
    options = options_for_set(folder)
    assert [path.rsplit("/", 1)[1] for path in options.flights] == [f"{n}.csv" for n in "abcd"]
    assert options.holdout == ["c", "d"]
    assert options.config is None
    (folder / "tune.yaml").write_text("holdout: [a]")
    assert options_for_set(folder).holdout is None
    assert options_for_set(folder).config == str(folder / "tune.yaml")
    known = tmp_path / "nanobench"
    folder.rename(known)
    (known / "tune.yaml").unlink()
    assert options_for_set(known).config.endswith("configs/jobs/crazyflie.yaml")
    assert options_for_set(known).holdout == list(HELD_OUT["nanobench"])


def test_the_second_half_of_a_flight_is_that_half(full_flight):
    half = cut(full_flight, 0.5, 1.0)
    assert half.duration == pytest.approx(full_flight.duration / 2, abs=0.02)
    shift = full_flight.time[-1] - half.time[-1]
    there = np.searchsorted(full_flight.time, shift + half.time[10] - 1e-9)
    np.testing.assert_array_equal(
        half.signals["position"][10], full_flight.signals["position"][there]
    )
    begin = full_flight.signals["position"][there - 10]
    np.testing.assert_allclose(half.initial.position, begin, atol=0.01)
    last = full_flight.series["rotor_speed"].time[-1] - shift
    assert half.series["rotor_speed"].time[-1] == pytest.approx(last)


def test_the_mass_beside_a_flight_is_read(tmp_path):
    path = tmp_path / "info1.yaml"
    path.write_text("motors: upgraded\nmass: 0.0375\n")
    assert weighed_mass(path) == 0.0375
    path.write_text("motors: upgraded\n")
    with pytest.raises(InputError, match="no mass"):
        weighed_mass(path)


def test_the_attitude_of_a_flight_without_a_pose_is_that_of_its_gyro(full_flight):
    series = {name: full_flight.series[name] for name in ("body_rate", "command")}
    begin, end = 1.0, full_flight.duration - 1.0
    flight = with_pose(InertialFlight("a", "a", series, ((begin, end),), ()))
    assert flight.duration == pytest.approx(end - begin, abs=0.02)
    recorded = full_flight.signals["attitude"]
    turned = Rotation.from_quat(
        recorded[np.searchsorted(full_flight.time, [begin, begin + 2.0])], scalar_first=True
    )
    there = Rotation.from_quat(flight.signals["attitude"][200], scalar_first=True)
    error = (turned[0].inv() * turned[1]).inv() * there
    assert error.magnitude() < 0.02
