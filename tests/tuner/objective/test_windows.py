"""Windows of a flight, through every inlet: the truth meets them, and is found again."""

from dataclasses import replace

import numpy as np
import pytest

from sim_jax.inlet import ActuatorInlet
from sim_jax.schedule import Schedule
from tuner.core.errors import RecordingError
from tuner.objective.initial_conditions import ROWS
from tuner.objective.inlets import (
    INLETS,
    at_ticks,
    linear_interpolation,
    mean_of_hold,
    zero_order_hold,
)
from tuner.objective.segments import cut_windows, window_segments
from tuner.objective.windows import windows_of
from tuner.recordings.flight import Series
from tuner.search.job_flights import inlet_for


def test_windows_follow_each_other_and_start_where_the_flight_is(flight):
    windows = windows_of(flight, 1.0)
    assert [round(window.begin) for window in windows] == list(range(len(windows)))
    for window in windows[1:]:
        index = np.searchsorted(flight.time, window.begin)
        np.testing.assert_allclose(
            window.flight.initial.position, flight.signals["position"][index], atol=2e-3
        )
        np.testing.assert_allclose(
            window.flight.initial.velocity, flight.signals["velocity"][index], atol=0.05
        )


def test_a_stretch_without_poses_is_no_window(flight):
    position = flight.series["position"]
    gap = (position.time > 3.0) & (position.time < 4.2)
    series = dict(flight.series) | {"position": Series(position.time[~gap], position.values[~gap])}
    begins = [round(window.begin) for window in windows_of(replace(flight, series=series), 1.0)]
    assert 3 not in begins
    assert 5 in begins


def test_a_window_that_begins_in_a_gap_of_the_pose_is_one_however_its_start_is_smoothed(flight):
    bare = {name: signal for name, signal in flight.series.items() if name != "velocity"}
    for name in ("position", "attitude"):
        time, values = bare[name].time, bare[name].values
        kept = np.abs(time - 3.0) > 0.12  # no slope within a tenth of a second of the begin
        bare[name] = Series(time[kept], values[kept])
    signals = {name: rows for name, rows in flight.signals.items() if name != "velocity"}
    gap = replace(flight, series=bare, signals=signals)
    wide, narrow = (windows_of(gap, 1.0, smoothed_widely=wide) for wide in (True, False))
    (begun,) = (window.flight.initial for window in wide if round(window.begin) == 3)
    index = np.searchsorted(flight.time, 3.0)
    np.testing.assert_allclose(begun.velocity, flight.signals["velocity"][index], atol=0.1)
    assert [window.begin for window in wide] == [window.begin for window in narrow]


def test_a_flight_without_poses_is_refused(flight):
    series = {name: signal for name, signal in flight.series.items() if name != "position"}
    with pytest.raises(RecordingError, match="poses throughout"):
        windows_of(replace(flight, series=series), 1.0)


def test_auto_takes_the_most_upstream_inlet_that_can_be_fed(flight):
    assert inlet_for(flight, "auto") == "reference"
    signals = dict(flight.signals)
    del signals["reference_velocity"]
    assert inlet_for(replace(flight, signals=signals), "reference") == "reference"
    without = inlet_for(replace(flight, signals=signals), "auto")
    assert without in ("body_rate", "actuator")
    for name in ("rate_setpoint", "thrust_setpoint"):
        signals.pop(name, None)
    assert inlet_for(replace(flight, signals=signals), "auto") == "actuator"
    with pytest.raises(RecordingError, match="no rate_setpoint"):
        inlet_for(replace(flight, signals=signals), "body_rate")


def test_commands_recorded_in_full_are_held_and_sparse_ones_joined():
    series = Series(np.array([0.0, 0.1, 0.2]), np.array([[0.0], [1.0], [np.nan]]))
    clock = np.array([0.0, 0.05, 0.1, 0.3])
    assert zero_order_hold(series, clock)[:, 0].tolist() == [0.0, 0.0, 1.0, 1.0]
    assert linear_interpolation(series, clock)[:, 0].tolist() == pytest.approx([0.0, 0.5, 1.0, 1.0])


def test_the_mean_of_a_hold_counts_what_holds_for_a_part_of_a_step():
    series = Series(np.array([0.1, 0.15, 0.3]), np.array([[2.0], [4.0], [1.0]]))
    edges = np.array([0.0, 0.1, 0.2, 0.3, 0.5])
    assert mean_of_hold(series, edges)[:, 0] == pytest.approx([2.0, 3.0, 4.0, 1.0], abs=1e-12)


@pytest.mark.parametrize("rate", [160.0, 500.0])
def test_commands_act_on_time_at_any_rate_of_their_log(flight, rate):
    schedule = Schedule()
    time = np.arange(round(flight.duration * rate)) / rate
    ramp = Series(time, np.tile(time[:, None], 4))
    inlet = INLETS["actuator"].lay_out(
        [replace(flight, series={**flight.series, "command": ramp})], schedule
    )
    middle = (np.arange(800, 1600) + 0.5) * schedule.step
    held_for = 0.0 if rate < 0.5 * schedule.rate_control_rate else 0.5 / rate
    late = middle - np.asarray(inlet.command[0])[800:1600, 0]
    assert np.mean(late) == pytest.approx(held_for, abs=1e-6)


@pytest.mark.parametrize("rate", [437.3, 601.0])
def test_a_log_on_another_clock_tells_when_the_loop_ran(rate):
    ran = Series(np.arange(1250) / 250.0, np.random.default_rng(0).normal(size=(1250, 4)))
    clock, edges = np.arange(0.0012, 4.9, 1.0 / rate), np.arange(100, 4800) / 1000.0
    logged = Series(clock, zero_order_hold(ran, clock))
    error, left = (
        np.std(mean_of_hold(series, edges) - mean_of_hold(ran, edges))
        for series in (logged, at_ticks(logged, 250.0))
    )
    assert left < 0.3 * error
    in_step = at_ticks(Series(ran.time, np.repeat(ran.values[::2], 2, axis=0)), 125.0)
    np.testing.assert_allclose(in_step.time, ran.time[::2], atol=1e-9)
    assert at_ticks(logged, 1.1 * rate) is logged  # it does not see every run
    of_another = at_ticks(logged, 237.0)
    assert np.isin(of_another.time, clock).mean() > 0.9


def test_the_actuator_inlet_holds_recorded_commands(flight):
    schedule = Schedule()
    inlet = INLETS["actuator"].lay_out([flight], schedule)
    assert isinstance(inlet, ActuatorInlet)
    series = flight.series["command"]
    at = 4.0
    recorded = np.interp(at, series.time, series.values[:, 2])
    fed = float(inlet.command[2][round(at * schedule.physics_rate), 0])
    assert fed == pytest.approx(recorded, abs=0.02)


@pytest.mark.parametrize(
    ("inlet", "known"),
    [
        ("body_rate", {"trim"}),
        ("actuator", {"rate_integral"}),
        ("rotor_speed", {"rotor_speed", "rate_integral"}),
        ("attitude", {"attitude", "body_rate", "rate_integral", "trim"}),
    ],
)
def test_every_inlet_gives_segments_whose_starts_are_free(flight, inlet, known):
    segments = window_segments(
        [flight],
        cut_windows([flight], inlets=[inlet], seconds=1.0),
        inlets=[inlet],
        schedule=Schedule(),
        lag=0.02,
        noise={"position": 1e-3, "body_rate": 0.02, "rotor_speed": 2.0, "command": 1e-3},
    )
    assert segments.start_sd is not None
    assert np.all(np.asarray(segments.start_sd) > 0.0)
    of_known = {row for name in known for row in range(100)[ROWS[name]]}
    rows = range(max(row.stop for row in ROWS.values()))
    assert segments.free_rows == tuple(row for row in rows if row not in of_known)
    assert ("command" in segments.measured) == (inlet == "body_rate")
    assert ("rotor_speed" in segments.measured) == (inlet not in ("rotor_speed", "attitude"))
    assert segments.begins.tolist() == pytest.approx(list(range(segments.count)), abs=0.02)
