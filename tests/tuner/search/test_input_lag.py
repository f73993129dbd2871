"""The lateness of recorded inputs, to a fraction of a sample, before anything is fitted."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from benchmarks import fast_flights
from tuner.config import resolve_settings
from tuner.findings.findings import Code
from tuner.job.prepare import _motor_orders
from tuner.objective.rotor_signals import motor_order, order_findings
from tuner.options import Options
from tuner.recordings.flight import Flight, Series
from tuner.recordings.states import initial_state
from tuner.search.job_flights import JobFlight, read_recordings
from tuner.search.recorded_rotors import InputLag, _is_late, input_lag, with_input_lags

RATE = 500.0


@pytest.fixture(scope="module")
def broadband(updated):
    """Return 20 s of a vehicle that random changes of its rotors' speeds push about."""
    generator = np.random.default_rng(4)
    time = np.arange(0.0, 20.0, 1.0 / RATE)
    speed = 616.0 + _slow(generator.normal(0.0, 1.0, (len(time), 4)), 4.0) * 6.0
    place = np.array([rotor.position for rotor in updated.rotors])
    spin = np.array([1.0 if rotor.spin == "ccw" else -1.0 for rotor in updated.rotors])
    thrust = updated.aerodynamics.motor_constant * speed**2
    torque = np.column_stack([thrust @ place[:, 1], -thrust @ place[:, 0], -0.033 * thrust @ spin])
    inertia = np.array([updated.inertia.xx, updated.inertia.yy, updated.inertia.zz])
    rate, velocity = np.zeros((len(time), 3)), np.zeros((len(time), 3))
    turned = [Rotation.identity()]
    for k in range(len(time) - 1):
        # a weak attitude loop, so that it stays upright
        back = 8.0 * turned[-1].as_rotvec() + 4.0 * rate[k]
        rate[k + 1] = rate[k] + (torque[k] / inertia - back) / RATE
        turned.append(turned[-1] * Rotation.from_rotvec(rate[k] / RATE))
        up = turned[k].apply([0.0, 0.0, thrust[k].sum() / updated.mass])
        velocity[k + 1] = velocity[k] + (up - [0, 0, 9.81] - 1.0 * velocity[k]) / RATE
    series = {
        "position": Series(time, np.cumsum(velocity, axis=0) / RATE),
        "velocity": Series(time, velocity),
        "attitude": Series(time, Rotation.concatenate(turned).as_quat(scalar_first=True)),
        "body_rate": Series(time, rate),
        "rotor_speed": Series(time + 0.5 / RATE, speed),  # what acts over a step
        "command": Series(time, (speed - 100.0) / 950.0),
    }
    clock = np.arange(0.0, 19.9, 0.01)
    signals = {
        name: np.column_stack([np.interp(clock, time, column) for column in signal.values.T])
        for name, signal in series.items()
    }
    return Flight("a", "a.csv", "", 100.0, clock, signals, series, initial_state(series))


def _slow(white, frequency):
    share = 1.0 - np.exp(-2 * np.pi * frequency / RATE)
    return lfilter([share], [1.0, share - 1.0], white, axis=0) / np.sqrt(share / 2)


def late_by(flight, seconds, *, noise=0.0, name=None):
    """Return a flight whose rotor speeds are stamped later, at 100 Hz, with noise."""
    speed = flight.series["rotor_speed"]
    stamps = np.arange(0.04, 19.9, 0.01)
    columns = [np.interp(stamps - seconds, speed.time, column) for column in speed.values.T]
    generator = np.random.default_rng(5)
    values = np.column_stack(columns) + generator.normal(0.0, noise, (len(stamps), 4))
    series = dict(flight.series) | {"rotor_speed": Series(stamps, values)}
    return replace(flight, series=series, name=name or flight.name)


@pytest.mark.parametrize("seconds", [-0.0173, 0.0, 0.0042, 0.02])
def test_lateness_is_found_to_a_fraction_of_a_sample(broadband, updated, seconds):
    lag = input_lag(late_by(broadband, seconds, noise=5.0), "rotor_speed", updated)
    assert lag is not None
    assert lag.seconds == pytest.approx(seconds, abs=0.003)
    assert lag.sd < 0.0015


def test_a_lateness_that_may_be_chance_is_not_believed(broadband, updated):
    flight = late_by(broadband, 0.01)
    assert _is_late(flight, updated, InputLag(0.01, 0.001))
    assert not _is_late(flight, updated, InputLag(0.01, 0.005))


def test_noise_alone_shows_no_lag(broadband, updated):
    generator = np.random.default_rng(1)
    speed = broadband.series["rotor_speed"]
    noise = Series(speed.time, generator.normal(600.0, 10.0, speed.values.shape))
    flight = replace(broadband, series=dict(broadband.series) | {"rotor_speed": noise})
    assert input_lag(flight, "rotor_speed", updated) is None


def test_each_fitted_flight_has_its_own_lateness_and_a_held_out_one_the_mean(broadband, updated):
    recordings = [
        JobFlight(late_by(broadband, 0.015, name="a"), "rotor_speed", None),
        JobFlight(late_by(broadband, -0.005, name="b"), "rotor_speed", None),
        JobFlight(late_by(broadband, 0.02, name="c"), "rotor_speed", None, holdout=True),
        JobFlight(late_by(broadband, 0.02, name="d"), "rotor_speed", 0.0),
        JobFlight(replace(broadband, name="e"), "reference", None),
    ]
    late = [r.input_late for r in with_input_lags(recordings, updated)]
    assert late[0] == pytest.approx(0.015, abs=0.002)
    assert late[1] == pytest.approx(-0.005, abs=0.002)
    assert late[2] == pytest.approx((late[0] + late[1]) / 2)
    assert late[3:] == [0.0, 0.0]


def test_the_mean_lateness_of_commands_is_the_vehicles_own_lag(broadband, updated):
    command = broadband.series["command"]

    def moved(seconds, name):
        series = dict(broadband.series) | {
            "command": Series(command.time + seconds, command.values)
        }
        return JobFlight(replace(broadband, series=series, name=name), "actuator", None)

    first, second = with_input_lags([moved(0.0, "a"), moved(0.012, "b")], updated)
    assert first.input_late == pytest.approx(-second.input_late)
    assert second.input_late - first.input_late == pytest.approx(0.012, abs=0.002)


def test_the_lag_of_commands_is_found_by_the_whole_curve_of_the_rotors(broadband, updated):
    speed = broadband.series["rotor_speed"].values
    lags = []
    for quadratic, offset in ((0.0, 0.0), (900.0, 0.1)):
        motor = updated.motor.replace(quadratic=quadratic, input_offset=offset)
        lift = (speed - motor.zero_position_armed) / motor.input_scaling
        command = 2.0 * lift / (1.0 + np.sqrt(1.0 + 4.0 * quadratic / motor.input_scaling * lift))
        series = {"command": Series(broadband.series["command"].time, command - offset)}
        flight = replace(broadband, series=dict(broadband.series) | series)
        lags.append(input_lag(flight, "command", updated.replace(motor=motor)))
    straight, bent = lags
    assert bent.seconds == pytest.approx(straight.seconds, abs=1e-6)
    assert bent.sd == pytest.approx(straight.sd, rel=1e-3)


@pytest.mark.parametrize("source", ["command", "rotor_speed"])
@pytest.mark.parametrize("late", [-0.2, 0.0, 0.1, 0.3])
def test_a_signal_that_is_stamped_late_is_named(source, late, broadband, updated):
    of, span = broadband.series[source], (0.0, broadband.duration)
    series = dict(broadband.series) | {source: Series(of.time + late, of.values)}
    found = order_findings("a", series, updated, span, source)
    assert [(one.code, one.names) for one in found] == [(Code.STAMPED_LATE, (source,))] * bool(late)
    for one in found:
        assert one.numbers["seconds"] == pytest.approx(late, abs=0.03)


def test_the_order_is_seen_where_a_recording_begins_and_ends_during_a_turn(broadband, updated):
    rate = broadband.series["body_rate"]
    turning = Series(rate.time, rate.values + np.array([2.0, 1.0, 0.5]))
    series, span = {**broadband.series, "body_rate": turning}, (0.0, broadband.duration)
    for source in ("command", "rotor_speed"):
        order = motor_order(series, updated, source, span)
        assert order is not None
        assert order.is_right


def test_spins_are_reversed_where_both_halves_of_a_recording_say_so(broadband, updated):
    rate, span = broadband.series["body_rate"], (0.0, broadband.duration)
    early = rate.time < 0.5 * broadband.duration

    def is_reversed(factor):
        yaw = np.stack([np.ones(len(early)), np.ones(len(early)), factor], axis=1)
        series = {**broadband.series, "body_rate": Series(rate.time, rate.values * yaw)}
        order = motor_order(series, updated, "rotor_speed", span)
        assert order is not None
        return bool(order.reversed_spins)

    assert is_reversed(np.full(len(early), -1.0))
    assert not is_reversed(np.where(early, -9.0, 1.0))
    assert not is_reversed(np.where(early, 1.0, -9.0))


def test_rotors_that_change_speed_alike_show_no_order(broadband, updated):
    speed = broadband.series["rotor_speed"]
    alike = Series(speed.time, np.repeat(speed.values[:, :1], 4, axis=1))
    series = dict(broadband.series) | {"rotor_speed": alike}
    assert motor_order(series, updated, "rotor_speed", (0.0, broadband.duration)) is None


def test_the_order_of_measured_speeds_is_seen_in_how_they_turn_the_vehicle(broadband, updated):
    speed, span = broadband.series["rotor_speed"], (0.0, broadband.duration)
    assert order_findings("a", broadband.series, updated, span, "rotor_speed") == ()
    swapped = Series(speed.time, speed.values[:, [0, 2, 1, 3]])
    series = dict(broadband.series) | {"rotor_speed": swapped}
    (finding,) = order_findings("a", series, updated, span, "rotor_speed")
    assert (finding.code, finding.names) == (Code.MOTOR_ORDER, ("1", "3", "2", "4"))
    series.pop("command", None)
    flown = replace(broadband, series=series)  # turns that it does not explain are followed
    settings = SimpleNamespace(vehicle=updated)
    job = SimpleNamespace(fitted=(flown,), inlets=("attitude",), settings=settings)
    (said,) = _motor_orders(job)
    assert (said.code, said.names) == (finding.code, finding.names)


def test_the_loops_response_to_hidden_torques_is_no_lateness(tmp_path):
    racer = fast_flights.drawn(32)
    signals = fast_flights.fly(racer, seed=32, seconds=10.0)
    paths = fast_flights.write(racer, signals, tmp_path, seed=32)
    chosen = [str(p) for p in paths if p.stem in ("circle_13mps", "lemniscate_9mps")]
    settings = resolve_settings(Options(chosen, config=str(tmp_path / "tune.yaml")))
    recordings, _ = read_recordings(settings)
    lag = input_lag(recordings[0].flight, "rotor_speed", settings.vehicle)
    assert lag.seconds < -3.0 * lag.sd  # by spectra alone

    def believed(seconds):
        stamped = [_stamped(recording, seconds) for recording in recordings]
        return [r.input_late for r in with_input_lags(stamped, settings.vehicle)]

    assert believed(0.0) == [0.0, 0.0]
    for seconds in (-0.01, 0.01):  # where the manoeuvre tells
        assert believed(seconds)[1] == pytest.approx(seconds, abs=1e-3)


def _stamped(recording, seconds):
    """Return a recording whose rotor speeds are stamped later."""
    speed = recording.flight.series["rotor_speed"]
    series = {"rotor_speed": Series(speed.time + seconds, speed.values)}
    return replace(
        recording, flight=replace(recording.flight, series=recording.flight.series | series)
    )


def test_where_gaps_are_everywhere_no_lateness_is_believed(broadband, updated):
    flight = late_by(broadband, 0.015)
    speed = flight.series["rotor_speed"]
    there = np.arange(len(speed.time)) % 8 < 5
    series = dict(flight.series) | {"rotor_speed": Series(speed.time[there], speed.values[there])}
    recordings = [JobFlight(replace(flight, series=series), "rotor_speed", None)]
    assert [r.input_late for r in with_input_lags(recordings, updated)] == [0.0]
