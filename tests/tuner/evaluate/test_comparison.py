"""Flights of a model beside recordings: errors, laps, limits, and where they part."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

from sim_jax.state import AIRBORNE, Limits
from tuner.config import TrajectorySettings, resolve_settings
from tuner.core.shipped import find_config
from tuner.evaluate.comparison import (
    Comparison,
    FlightErrors,
    SignalErrors,
    laps_of,
    rmse_of,
    wrap_degrees,
)
from tuner.evaluate.validation import flights_not_followed
from tuner.findings.findings import Code, remedy, sentence
from tuner.objective.segments import noise_of
from tuner.objective.trajectory import with_named_reference
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.recordings.loader import load_flight
from tuner.search.job_flights import JobFlight, read_recordings
from tuner.search.problem import limits_of
from tuner.vehicle import COEFFICIENTS, ControllerFile, read_vehicle, with_values

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
    comparison = Comparison([JobFlight(flight)], ControllerFile())
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
    as_is = Comparison([JobFlight(late)], ControllerFile()).fly(updated)["small_circle"].rmse
    known = Comparison([JobFlight(late, time_offset=0.05)], ControllerFile()).fly(updated)
    assert known["small_circle"].rmse.x < 3e-4
    assert as_is.x > 0.02


def test_a_vehicle_that_cannot_fly_crashes(flight, updated):
    heavy = with_values(updated, {"mass": 9.0})
    crash = Comparison([JobFlight(flight)], ControllerFile()).fly(heavy, forces=True)[
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
    both = Comparison([JobFlight(flight), JobFlight(half)], ControllerFile()).fly(updated)
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


# the recordings that ship with the project, flown with the truth that they were made with

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
NAMES = sorted(path.stem for path in FLIGHTS.glob("*.bag"))


@pytest.fixture(scope="module")
def met():
    truth = yaml.safe_load((FLIGHTS / "truth.yaml").read_text())
    vehicle = with_values(read_vehicle(find_config("vehicles", "hovergames", Path())), truth)
    shipped = ControllerFile()
    controller = shipped.replace(mixer=shipped.mixer.replace(saturation_feedback=False))
    flights = [load_flight(FLIGHTS / f"{name}.bag") for name in NAMES]
    return noise_of(flights), Comparison([JobFlight(flight) for flight in flights], controller).fly(
        vehicle
    )


def beside(noise, errors):
    """Return the root mean square of what noise does not explain."""
    return np.sqrt(np.maximum(np.mean(errors**2, axis=0) - noise**2, 0.0))


@pytest.mark.parametrize("name", NAMES)
def test_every_flight_is_met_beside_its_measurement_noise(met, name):
    noise, flown = met
    errors = flown[name]
    assert errors.crash_time is None
    assert beside(noise["position"], errors.position.error).max() < 2e-3
    assert beside(np.degrees(noise["attitude"]), errors.attitude.error).max() < 0.05


# a fast lemniscate that a slightly weaker vehicle does not fly, and where it parts


@pytest.fixture(scope="module")
def weaker():
    """The settings, the recordings, and what flies them with so much of the true thrust."""
    names = ("lemniscate_4mps", "circle_3mps", "diagonal_3mps")
    paths = [str(FLIGHTS / f"{name}.bag") for name in names]
    settings = resolve_settings(Options(paths, config=str(FLIGHTS / "tune.yaml")))
    recordings = read_recordings(settings, holdout=())[0]
    truth = yaml.safe_load((FLIGHTS / "truth.yaml").read_text())
    known = {name: value for name, value in truth.items() if name in COEFFICIENTS}
    comparison = Comparison(recordings, settings.controller)

    def fly(share):
        lift = share * known["motor_constant"]
        return comparison.fly(with_values(settings.vehicle, {**known, "motor_constant": lift}))

    return SimpleNamespace(settings=settings, recordings=recordings), fly


def test_a_loop_beyond_its_limit_is_named_with_the_time(weaker):
    job, fly = weaker
    (finding,) = flights_not_followed(job, fly(0.92))
    assert (finding.code, finding.subject) == (Code.FLIGHT_NOT_FLOWN, "lemniscate_4mps")
    assert 9.0 < finding.numbers["seconds"] < 15.0
    assert finding.numbers["beyond"] > 0.4
    assert finding.numbers["beyond_recorded"] < 0.1
    assert "beyond that limit" in sentence(finding)
    assert "max_feedback_acceleration" in remedy(finding)


@pytest.mark.parametrize("share", [1.0, 1.08])
def test_flights_that_are_all_flown_are_not(weaker, share):
    job, fly = weaker
    assert not list(flights_not_followed(job, fly(share)))


def test_a_flight_that_is_odd_for_another_reason_says_nothing_of_the_limit(weaker):
    job, _ = weaker
    met = {
        recording.flight.name: errors([[0.01, 0.0, 0.0]] * 90, [[0.0] * 3] * 90)
        for recording in job.recordings
    }
    assert not list(flights_not_followed(job, met))
    met["circle_3mps"] = errors([[0.01, 0, 0]] * 45 + [[0.5, 0, 0]] * 45, [[0.0] * 3] * 90)
    (finding,) = flights_not_followed(job, met)
    assert finding.subject == "circle_3mps"
    assert finding.numbers["seconds"] == met["circle_3mps"].position.time[45]
    assert "beyond" not in finding.numbers
    assert "max_feedback" not in remedy(finding)


def test_one_flight_has_no_peers(weaker):
    job, _ = weaker
    alone = SimpleNamespace(settings=job.settings, recordings=job.recordings[:1])
    name = job.recordings[0].flight.name
    far = {name: errors([[np.sqrt(0.5), 0, 0]] * 90, [[0.0] * 3] * 90)}
    assert not list(flights_not_followed(alone, far))
