"""What turns a vehicle unseen: told from the samples before a prediction, and from them alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import fast_flights
from tuner.config import resolve_settings
from tuner.evaluate.prediction import LAGS, FlightPredictor, TorqueObserver
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.states import MIN_HALF_WIDTH_S
from tuner.search.job_flights import read_recordings
from tuner.vehicle import ControllerFile, with_values

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
