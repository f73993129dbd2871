"""Open-loop predictions: the truth predicts, nothing of the flight ahead is looked at."""

from dataclasses import replace

import numpy as np
import pytest

from tuner.evaluate.comparison import Comparison
from tuner.evaluate.prediction import FlightPredictor, Predictions, hold_state
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.objective.segments import stamped_earlier
from tuner.recordings.flight import Series
from tuner.recordings.states import MIN_HALF_WIDTH_S
from tuner.search.job_flights import Recording
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
        comparison = Comparison([Recording(flight, inlet)], ControllerFile())
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
    comparison = Comparison([Recording(full_flight, "rotor_speed")], ControllerFile())
    predicted = comparison.fly(wrong)[full_flight.name].rmse
    met = comparison.fly(wrong, fitted_starts=True)[full_flight.name].rmse
    assert predicted.roll > 3 * met.roll  # a trim in each window hides what is wrong
    assert comparison.fly(updated)[full_flight.name].rmse.roll < 0.1 * predicted.roll


def test_fitted_starts_meet_a_flight_no_worse_than_recorded_ones(full_flight, updated):
    # rotors that lift half as much: steps towards the likeliest start overshoot
    wrong = with_values(updated, {"angular_drag_x": -0.2, "torque_trim_x": 0.3})
    comparison = Comparison([Recording(full_flight, "rotor_speed")], ControllerFile())
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


def test_rotors_of_a_window_followed_the_commands_at_their_corrected_times(full_flight, updated):
    """Stamps of commands that are late, by a lateness that is known, change no error."""
    series, signals = (
        {name: one for name, one in of.items() if name != "rotor_speed"}
        for of in (full_flight.series, full_flight.signals)
    )
    flight = replace(full_flight, series=series, signals=signals)
    late = stamped_earlier(flight, ["command"], -0.05)
    plain, corrected = (
        Comparison([recording], ControllerFile()).fly(updated)[flight.name].attitude.error
        for recording in (
            Recording(flight, "actuator"),
            Recording(late, "actuator", input_late=0.05),
        )
    )
    apart = np.abs(corrected - plain).max(axis=1)
    assert np.median(apart) < 1e-9  # few windows lack the commands before them
