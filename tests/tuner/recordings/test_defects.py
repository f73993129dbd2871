"""Each defect of a signal is found, repaired or left out, and counted; honest motion is kept."""

from __future__ import annotations

import numpy as np
import pytest

from tests.tuner.recorded import recordings_of
from tuner.config import resolve_settings
from tuner.core.errors import RecordingError
from tuner.options import Options
from tuner.recordings.defects import (
    clean,
    has_stale_attitude,
    is_position_frozen,
    without_stale_end,
)
from tuner.recordings.flight import Series
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.loader import load_flight
from tuner.recordings.missions import find_missions
from tuner.recordings.notes import NoteCode
from tuner.recordings.unit_detection import to_si


def _cleaned(signal: str, time: np.ndarray, values: np.ndarray):
    return clean(signal, "/topic", time, values)


def test_tachometer_artefacts_go_and_steps_stay() -> None:
    time = np.arange(2000) * 0.01
    speed = 600 + 100 * np.sign(np.sin(2 * np.pi * time)) + 30 * np.sin(40 * time)
    motor = np.empty_like(speed)
    state = speed[0]
    for k, target in enumerate(speed):  # a real motor: first-order, 15 ms
        state += (target - state) * (1 - np.exp(-0.01 / 0.015))
        motor[k] = state
    motor += np.random.default_rng(0).normal(0, 2, len(motor))
    dirty = motor.copy()
    artefacts = np.array([50, 333, 700, 701, 1200, 1777])
    dirty[artefacts] *= [0.5, 1.5, 0.5, 1.5, 0.5, 1.5]
    values = np.full((2000, 4), np.nan)
    values[:, 2] = dirty
    kept, left, notes = _cleaned("rotor_speed", time, values)
    assert set(np.flatnonzero(~np.isin(time, kept))) == set(artefacts)
    assert notes[0].count == len(artefacts)
    assert np.isnan(left[:, 0]).all()


def test_disarmed_motors_are_no_reason_to_doubt_the_unit_of_commands() -> None:
    """PX4 sends 900 µs to disarmed motors, or nothing, half a minute on the ground."""
    pulses = np.full((3000, 4), 1550.0)
    pulses[:1500], pulses[2700:], pulses[2000, 2] = 900.0, 0.0, 900.0
    time, kept, notes = _cleaned("command", np.arange(3000) * 0.01, to_si(pulses, "pwm_us"))
    assert len(time) == 2999  # one of four motors alone is not disarmed
    assert not kept[:1500].any()
    assert not kept[-300:].any()
    assert kept[1500:2000] == pytest.approx(0.55)
    assert [note.code for note in notes[:1]] == [NoteCode.OUT_OF_RANGE]


def test_fast_honest_flight_loses_no_sample() -> None:
    time = np.arange(4000) * 0.01
    angle = 6.0 * time  # 8 m/s on a 1.33 m circle, rolled and yawing fast
    position = np.column_stack(
        [1.33 * np.cos(angle), 1.33 * np.sin(angle), 1 + 0.5 * np.sin(9 * time)]
    )
    position += np.random.default_rng(0).normal(0, 5e-4, position.shape)
    _, kept, notes = _cleaned("position", time, position)
    assert len(kept) == 4000
    assert notes == ()
    yaw = 8.0 * time
    attitude = np.column_stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)])
    _, kept, notes = _cleaned("attitude", time, attitude)
    assert len(kept) == 4000
    assert notes == ()


def test_slow_motion_capture_of_a_fast_flight_loses_no_sample() -> None:
    time = np.arange(1000) / 30
    position = np.column_stack([np.cos(4 * time), np.sin(4 * time), np.ones(1000)])
    lost = (np.arange(1000) % 50) > 41  # a third of a second without markers, time and again
    _, kept, notes = _cleaned("position", time[~lost], position[~lost])
    assert len(kept) == (~lost).sum()
    assert [note.count for note in notes] == [lost[:-8].sum()]  # reported as missing, none dropped


def test_pose_jumps_are_dropped() -> None:
    time = np.arange(500) * 0.01
    position = np.column_stack([3 * time, np.zeros(500), np.ones(500)])
    position[[100, 101, 300]] += [0.0, 0.4, 0.0]
    kept, _, notes = _cleaned("position", time, position)
    assert not np.isin(time[[100, 101, 300]], kept).any()
    assert len(kept) == 497
    assert notes[0].count == 3


def test_order_duplicates_and_nan() -> None:
    time = np.array([0.0, 0.02, 0.01, 0.03, 0.03, 0.04])
    values = np.column_stack([time * 10] * 3)
    values[5, 1] = np.nan
    kept, left, notes = _cleaned("velocity", time, values)
    assert kept.tolist() == [0.0, 0.01, 0.02, 0.03]
    assert left[:, 0] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert sorted(note.count for note in notes) == [1, 1, 1]


def test_quaternion_signs_norms_and_zeros() -> None:
    time = np.arange(100) * 0.01
    angle = 2.0 * time
    good = np.column_stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle])
    dirty = good * np.where(np.arange(100) % 3 == 0, -1.2, 1.0)[:, None]
    dirty[50] = 0.0
    kept, left, _ = _cleaned("attitude", time, dirty)
    assert len(kept) == 99
    assert np.allclose(left, np.delete(good, 50, axis=0))


def test_impossible_commands_are_dropped() -> None:
    values = np.full((10, 4), 0.5)
    values[4, 2] = 1.7
    values[5, 2] = 1.01
    kept, left, notes = _cleaned("command", np.arange(10) * 0.02, values)
    assert len(kept) == 9
    assert left.max() == 1.0
    assert notes[0].count == 1


def test_rotors_stamped_together_share_a_row() -> None:
    values = np.full((8, 4), np.nan)
    for row in range(8):
        values[row, row % 4] = 500.0 + row
    kept, left, notes = _cleaned("rotor_speed", np.repeat([0.0, 0.1], 4), values)
    assert kept.tolist() == [0.0, 0.1]
    assert left.tolist() == [[500, 501, 502, 503], [504, 505, 506, 507]]
    assert notes == ()


def test_motion_capture_that_goes_on_sending_its_last_pose_is_dropped() -> None:
    time = np.arange(500) * 0.01
    position = np.column_stack([2 * time, np.sin(3 * time), np.ones(500)])
    position += np.random.default_rng(0).normal(0, 3e-4, position.shape)
    position[200:230] = position[199]
    kept, _, notes = _cleaned("position", time, position)
    assert not np.isin(time[200:230], kept).any()
    assert len(kept) == 470
    assert notes[0].count == 30


def test_a_vehicle_at_rest_in_a_simulator_is_kept() -> None:
    time = np.arange(400) * 0.01
    height = np.where(time < 2, 0.1, 0.1 + 0.5 * (time - 2) ** 2)
    position = np.column_stack([0 * time, 0 * time, height])
    kept, _, notes = _cleaned("position", time, position)
    assert len(kept) == 400
    assert notes == ()


def test_markers_swapped_for_a_while_are_dropped() -> None:
    time = np.arange(600) * 0.01
    position = np.column_stack([2 * np.cos(time), 2 * np.sin(time), np.ones(600)])
    position += np.random.default_rng(0).normal(0, 3e-4, position.shape)
    position[300:330] += [0.15, 0.0, 0.1]
    kept, _, notes = _cleaned("position", time, position)
    assert not np.isin(time[300:330], kept).any()
    assert len(kept) == 570
    assert notes[0].code is NoteCode.AWAY_AND_BACK


def test_a_jump_that_stays_is_only_noted() -> None:
    time = np.arange(600) * 0.01
    position = np.column_stack([time, 0 * time, np.ones(600)])
    position[300:] += [0.5, 0.0, 0.0]
    kept, _, notes = _cleaned("position", time, position)
    assert len(kept) == 600
    assert notes[0].code is NoteCode.AWAY_FOR_GOOD
    assert notes[0].kind == "warning"
    assert notes[0].count == 1


def test_a_battery_of_no_volts_was_not_read():
    time = np.arange(50) * 0.1
    volts = np.full((50, 1), 3.9)
    volts[20:30] = 0.0
    kept, values, (note, *_) = clean("battery_voltage", "power", time, volts)
    assert (note.code, note.count) == (NoteCode.OUT_OF_RANGE, 10)
    assert len(kept) == 40
    assert values.min() == 3.9


TIME = np.arange(0, 10, 0.01)


def flight(stops: float, *, moves: bool) -> dict[str, Series]:
    """Fly a circle; attitude and body rate stop changing, and the position too unless it moves."""
    seen = TIME if moves else np.minimum(TIME, stops)
    angle = np.minimum(TIME, stops)
    position = np.column_stack([np.cos(seen), np.sin(seen), 1.0 + 0.0 * seen])
    half = 0.1 * np.sin(angle)
    attitude = np.column_stack([np.cos(half), np.sin(half), 0 * half, 0 * half])
    rate = np.column_stack([0.2 * np.cos(angle), 0 * angle, 0 * angle])
    signals = {"position": position, "attitude": attitude, "body_rate": rate}
    return {name: Series(TIME, values) for name, values in signals.items()}


def test_a_mission_ends_where_the_attitude_stops_changing() -> None:
    kept, notes = without_stale_end(flight(6.0, moves=True))
    assert [note.names for note in notes] == [("attitude",), ("body_rate",)]
    assert {note.code for note in notes} == {NoteCode.STALE}
    assert notes[0].numbers["seconds"] == pytest.approx(3.99, abs=0.015)
    (mission,) = find_missions(kept)
    assert mission.end == pytest.approx(6.0, abs=0.015)


@pytest.mark.parametrize(("stops", "moves"), [(6.0, False), (9.5, True), (20.0, True)])
def test_a_vehicle_at_rest_and_a_moment_without_change_are_left_alone(stops, moves) -> None:
    signals = flight(stops, moves=moves)
    kept, notes = without_stale_end(signals)
    assert notes == []
    assert kept == signals
    assert find_missions(kept)[0].end == pytest.approx(TIME[-1])


def test_a_last_pose_that_is_sent_for_good_is_no_pose_while_the_gyro_turns() -> None:
    signals = flight(6.0, moves=False)
    turning = np.column_stack([0.4 * np.cos(TIME), 0.4 * np.sin(TIME), 0 * TIME])
    kept, (note,) = without_stale_end(signals | {"body_rate": Series(TIME, turning)})
    assert note.names == ("attitude",)
    assert find_missions(kept)[0].end == pytest.approx(6.0, abs=0.015)
    noise = np.random.default_rng(2).normal(0.0, 0.02, (len(TIME), 3))
    assert without_stale_end(signals | {"body_rate": Series(TIME, noise)})[1] == []


def test_a_gyro_that_never_changes_measured_nothing_where_the_vehicle_moves() -> None:
    signals = flight(20.0, moves=True) | {"body_rate": Series(TIME, np.zeros((len(TIME), 3)))}
    kept, (note,) = without_stale_end(signals)
    assert (note.code, note.names) == (NoteCode.STALE, ("body_rate",))
    assert set(kept) == {"position", "attitude"}
    rest = {name: Series(TIME, 0 * s.values + s.values[0]) for name, s in signals.items()}
    assert without_stale_end(rest) == (rest, [])


@pytest.mark.parametrize(("digits", "code"), [(1, NoteCode.STAMPS_COARSE), (2, None)])
def test_stamps_of_too_few_digits_are_a_warning(digits, code) -> None:
    moving = np.column_stack([np.cos(TIME), np.sin(TIME), 1.0 + 0.0 * TIME])
    _, _, notes = clean("position", "rows", np.round(TIME, digits), moving)
    assert [note.code for note in notes if note.kind == "warning"] == ([code] if code else [])
    still = np.repeat(moving[::10], 10, axis=0)  # what a logger repeats was measured then
    _, _, notes = clean("position", "rows", np.floor(10 * TIME + 1e-6) / 10, still)
    assert NoteCode.STAMPED_TWICE in {note.code for note in notes}
    assert not any(note.kind == "warning" for note in notes)


@pytest.mark.parametrize("lost", [np.s_[:300], np.s_[:]])
def test_where_no_position_is_seen_nothing_is_taken_for_motion(lost) -> None:
    signals = flight(6.0, moves=True)
    position = signals["position"]
    unseen = np.where(TIME[:, None] < 3.0, position.values, np.nan)
    signals["position"] = Series(TIME[lost], unseen[lost])
    assert without_stale_end(signals) == (signals, [])


def written(path, stops: float):
    """Write a table of such a flight."""
    signals = flight(stops, moves=True)
    head = "t,px,py,pz,qw,qx,qy,qz,wx,wy,wz,thrust"
    table = np.column_stack([TIME, *(s.values for s in signals.values()), 0.5 + 0.0 * TIME])
    np.savetxt(path, table, delimiter=",", header=head, comments="", fmt="%.9f")
    return load_flight(path, cache=False)


def test_a_flight_of_which_too_little_is_left_is_read_but_not_fitted(tmp_path) -> None:
    short = written(tmp_path / "short.csv", 1.0)
    longer = written(tmp_path / "longer.csv", 6.0)
    settings = resolve_settings(Options([short.path], vehicle="crazyflie"))
    with pytest.raises(RecordingError, match="its attitude stops changing"):
        recordings_of(settings, [short])
    assert short.duration == pytest.approx(TIME[-1], abs=0.02)
    assert has_stale_attitude(short.series, short.notes)
    ((looked_at, then), _) = inspect_recordings([short.path, tmp_path / "longer.csv"], cache=False)
    assert all("attitude" in inlet.missing for inlet in looked_at.inlets)
    assert looked_at.coefficients == ()
    assert longer.duration == pytest.approx(6.0, abs=0.02)
    assert not has_stale_attitude(longer.series, longer.notes)
    assert not any("attitude" in inlet.missing for inlet in then.inlets)
    assert then.coefficients


def test_a_position_that_stays_while_the_vehicle_tilts_is_none(tmp_path) -> None:
    signals = flight(20.0, moves=True)
    assert not is_position_frozen(signals)
    still = signals["position"].values * [0.0, 0.0, 1.0]
    assert is_position_frozen(signals | {"position": Series(TIME, still)})
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(TIME), 1))
    spin = {"position": Series(TIME, still), "attitude": Series(TIME, level)}
    assert not is_position_frozen(spin)
    path = tmp_path / "still.csv"
    table = np.column_stack([TIME, still, signals["attitude"].values])
    np.savetxt(path, table, delimiter=",", header="t,px,py,pz,qw,qx,qy,qz", comments="")
    with pytest.raises(RecordingError, match="its position never changes along x and y"):
        load_flight(path, cache=False)
