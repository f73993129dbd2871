"""Flights as real loggers leave them: what cannot be used is named, and no line is said in vain."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from sim_jax.schedule import Schedule
from tests.tuner.evaluate.test_comparison import errors
from tests.tuner.recorded import recordings_of
from tests.tuner.recordings.making import FLIGHTS
from tuner.config import JobFile, Search, resolve_settings
from tuner.core.errors import ConfigError, RecordingError
from tuner.evaluate.validation import flights_worse
from tuner.findings.findings import Code, Finding
from tuner.job.prepare import _excitation, merged_by_flight, starts_on_bounds
from tuner.objective.inlets import INLETS, also_free_by, bypassed_by
from tuner.objective.segments import cut_windows, window_segments
from tuner.objective.space import space_of
from tuner.objective.windows import windows_of
from tuner.options import Options
from tuner.recordings.defects import LIMITS, is_outlier
from tuner.recordings.flight import Series
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import Note, NoteCode
from tuner.search import job_flights as recordings_module
from tuner.search.findings import turning_findings
from tuner.search.job_flights import read_recordings
from tuner.vehicle import ControllerFile


def without_commands(flight, begin, end):
    """Return a flight whose commands between two times were dropped as corrupt."""
    command = flight.series["command"]
    kept = (command.time < begin) | (command.time > end)
    series = dict(flight.series) | {"command": Series(command.time[kept], command.values[kept])}
    return replace(flight, series=series)


def settings_for(bag, **job):
    settings = resolve_settings(Options([str(bag)]))
    return replace(settings, job=JobFile(inlet="actuator", search=Search(window=0.5), **job))


def test_windows_without_what_is_fed_in_are_left_out(flight):
    gap = without_commands(flight, 3.1, 4.9)
    assert {round(window.begin) for window in windows_of(gap, 1.0)} >= {3, 4}
    begins = [round(window.begin) for window in windows_of(gap, 1.0, fed=("command",))]
    assert not {3, 4} & set(begins)
    assert {2, 5} <= set(begins)
    pieces = cut_windows([gap], inlets=["actuator"], seconds=1.0)
    segments = window_segments(
        [gap], pieces, inlets=["actuator"], schedule=Schedule(), lag=0.02, noise={}
    )
    assert segments.count == len(begins)


def test_a_start_outside_given_bounds_is_warned_of():
    parameters = [
        SimpleNamespace(name="motor_constant", moved=moved, initial=1e-5, lower=1e-6, upper=2e-5)
        for moved in (1e-6, 3e-5)
    ]
    found = starts_on_bounds(SimpleNamespace(space=SimpleNamespace(parameters=parameters)))
    assert [finding.level for finding in found] == ["info", "warning"]


def test_a_yaw_spin_without_a_gyro_is_seen_to_yaw():
    circle, spin = (load_flight(FLIGHTS / f"{n}.bag") for n in ("circle_3mps", "yaw_spin_3rps"))
    space = SimpleNamespace(free=("inertia_zz",))

    def codes(*flown):
        bare = [
            replace(f, signals={n: of for n, of in f.signals.items() if n != "body_rate"})
            for f in flown
        ]
        found = _excitation(SimpleNamespace(fitted=bare, space=space))
        return {finding.code for finding in found}

    assert Code.NO_YAW in codes(circle)
    assert Code.NO_YAW not in codes(circle, spin)


def test_a_flight_without_any_command_is_refused_in_one_line(flight):
    bare = without_commands(flight, -5.0, 50.0)
    with pytest.raises(RecordingError, match="no 1 s with command throughout"):
        windows_of(bare, 1.0, fed=("command",))


def test_what_is_left_of_corrupt_commands_is_no_slow_log(flight, bag):
    settings, command = settings_for(bag), flight.series["command"]

    def with_rows(rows):
        thinned = Series(command.time[rows], command.values[rows])
        return replace(flight, series=dict(flight.series) | {"command": thinned})

    generator = np.random.default_rng(3)
    left = np.flatnonzero(generator.random(len(command.time)) < 0.05)
    with pytest.raises(RecordingError, match="lacks a continuous command"):
        recordings_of(settings, [with_rows(left)])
    slow = np.arange(0, len(command.time), 20)  # the same number, at 5 Hz
    (recording,) = recordings_of(settings, [with_rows(slow)])
    assert recording.inlet == "actuator"


def test_a_pose_that_is_logged_too_seldom_is_not_called_a_lack_of_commands(flight, bag):
    seldom = dict(flight.series)
    for name in ("position", "attitude"):
        kept = slice(None, None, round(flight.series[name].rate / 7.0))
        seldom[name] = Series(seldom[name].time[kept], seldom[name].values[kept])
    with pytest.raises(RecordingError, match=r"a continuous pose in 100 %.*log the pose at 16 Hz"):
        recordings_of(settings_for(bag), [replace(flight, series=seldom)])


def test_a_flight_whose_every_command_is_corrupt_is_said_to_be(flight, bag):
    signals = {name: rows for name, rows in flight.signals.items() if name != "command"}
    note = Note(NoteCode.OUT_OF_RANGE, "info", "motor", 4221, names=("command",))
    bare = replace(flight, signals=signals, notes=(note,))
    with pytest.raises(RecordingError, match="4221 command samples were dropped as corrupt"):
        recordings_of(settings_for(bag), [bare])
    poses = {name: signals[name] for name in ("position", "attitude")}
    nothing_to_feed = replace(bare, signals=poses)
    with pytest.raises(RecordingError, match="nothing in it can be fed in") as caught:
        recordings_of(settings_for(bag), [nothing_to_feed])
    assert "use inlet: auto" not in str(caught.value)


def test_a_flight_most_of_whose_commands_are_corrupt_is_left_out_by_name(flight, bag, monkeypatch):
    corrupt = replace(without_commands(flight, 2.0, 11.0), name="corrupt")
    monkeypatch.setattr(recordings_module, "load_flights", lambda *_, **__: [flight, corrupt])
    settings = settings_for(bag)
    usable, (left_out,) = read_recordings(settings)
    assert [recording.flight.name for recording in usable] == [flight.name]
    assert (left_out.code, left_out.subject) == (Code.LEFT_OUT, "corrupt")
    assert "lacks a continuous command in 75 %" in left_out.names[0]
    with pytest.raises(RecordingError, match="lacks a continuous command"):
        recordings_of(settings, [corrupt])
    # nothing is left to fit: the reason is the error
    holding = replace(settings, job=settings.job.replace(holdout=(flight.name,)))
    with pytest.raises(RecordingError, match="lacks a continuous command"):
        read_recordings(holding)


def test_coefficients_that_an_inlet_bypasses_are_not_fitted(updated, flight):
    names = space_of(
        updated, ControllerFile(), JobFile(), bypassed=bypassed_by(["rotor_speed"], [flight])
    ).names
    assert {"inertia_xx", "motor_constant", "moment_constant"} <= set(names)
    assert not set(names) & set(INLETS["rotor_speed"].bypasses)
    assert bypassed_by(["rotor_speed", "reference"], [flight] * 2) == frozenset()
    assert bypassed_by(["rotor_speed", "actuator"], [flight] * 2) == {
        "estimate_latency",
        "gyro_cutoff",
        "rate_gain_roll_pitch",
        "rate_gain_yaw",
        "integral_gain",
        "gyro_cutoff_factor",
        "derivative_cutoff_factor",
        "attitude_gain",
    }
    with pytest.raises(ConfigError, match="leaves no coefficient that acts"):
        space_of(
            updated,
            ControllerFile(),
            JobFile(free=("input_scaling",)),
            bypassed=bypassed_by(["rotor_speed"], [flight]),
        )


def test_rotors_of_a_small_drone_change_quickly_without_being_outliers():
    time = np.arange(400) * 0.01
    generator = np.random.default_rng(1)
    speed = 2000.0 + 40.0 * np.sin(2 * np.pi * 1.0 * time) + generator.normal(0.0, 2.0, 400)
    speed[::40] += 80.0  # one sample of a correction
    speed[205] += 900.0
    assert np.flatnonzero(is_outlier(time, speed, LIMITS["rotor_speed"])).tolist() == [205]
    large = 0.3 * speed  # the same of a rotor at 600 rad/s
    large[205] -= 270.0 - 60.0
    assert np.flatnonzero(is_outlier(time, large, LIMITS["rotor_speed"])).tolist() == [205]


def test_what_holds_for_many_flights_is_said_once():
    same = [
        Finding(Code.MISSING_SIGNALS, "warning", name, names=("rotor_speed",)) for name in "abcdefg"
    ]
    other = Finding(Code.POSE_GAP, "warning", "a", {"seconds": 0.4})
    assert [finding.subject for finding in merged_by_flight([*same, other])] == ["7 flights", "a"]
    assert [finding.subject for finding in merged_by_flight(same[:2])] == ["a, b"]


def test_a_flight_that_a_fit_left_worse_is_named():
    before = {"f": errors([[0.1, 0, 0]] * 9, [[29, 0, 0]] * 9)}
    after = {"f": errors([[0.05, 0, 0]] * 9, [[40, 0, 0]] * 9)}
    (worse,) = flights_worse(before, after)
    assert (worse.code, worse.subject, worse.names[0]) == (Code.FLIGHT_WORSE, "f", "attitude")
    assert worse.numbers == {"before": pytest.approx(29.0), "after": pytest.approx(40.0)}
    assert not list(flights_worse(after, after))
    crashed = {"f": errors([[0.1, 0, 0]] * 9, [[0, 0, 0]] * 9, crash_time=1.0)}
    (crash,) = flights_worse(before, crashed)
    assert (crash.code, crash.subject, crash.numbers) == (
        Code.FLIGHT_CRASHES,
        "f",
        {"seconds": 1.0},
    )
    assert not list(flights_worse(crashed, crashed))


def test_what_no_loop_takes_out_is_free_where_inputs_are_fed_in(updated):
    def names(*inlets, terms):
        also_free = also_free_by(inlets, terms=terms)
        return set(space_of(updated, ControllerFile(), JobFile(), also_free=also_free).names)

    usual = names("reference", "rotor_speed", terms=True)
    trims = {"torque_trim_x", "torque_trim_y", "torque_trim_z"}
    assert not usual & trims
    assert names("rotor_speed", terms=False) == usual | trims
    more = names("rotor_speed", "actuator", terms=True)
    assert {"angular_drag_x", "linear_drag_y", "thrust_inflow_coefficient"} <= more - usual - trims


def test_inputs_that_hardly_explain_how_a_flight_turns_are_named():
    def job(*free):
        fitted = [SimpleNamespace(name=name) for name in "abc"]
        return SimpleNamespace(fitted=fitted, space=SimpleNamespace(names=free))

    turning = job("inertia_xx", "motor_constant")
    shares = {"a": 0.4, "b": 0.5, "c": 0.99, "held out": 0.1}
    (weak,) = turning_findings(turning, shares)
    assert (weak.code, weak.numbers["explained"]) == (Code.TURNING_UNEXPLAINED, 0.5)
    assert not list(turning_findings(turning, {"a": 0.97, "held out": 0.1}))
    assert not list(turning_findings(turning, {}))
    assert not list(turning_findings(job("motor_constant"), shares))
