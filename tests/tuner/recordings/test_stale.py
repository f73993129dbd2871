"""What a logger goes on writing after its source has stopped is no measurement."""

import numpy as np
import pytest

from tuner.config import Options, settle
from tuner.core.errors import RecordingError
from tuner.recordings import inspect_recordings
from tuner.recordings.defects import is_stale, without_stale
from tuner.recordings.flight import Series
from tuner.recordings.loader import load_flight
from tuner.recordings.missions import find_missions
from tuner.recordings.notes import NoteCode
from tuner.search.job_flights import recordings_of

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
    kept, notes = without_stale(flight(6.0, moves=True))
    assert [note.names for note in notes] == [("attitude",), ("body_rate",)]
    assert {note.code for note in notes} == {NoteCode.STALE}
    assert notes[0].numbers["seconds"] == pytest.approx(3.99, abs=0.015)
    (mission,) = find_missions(kept)
    assert mission.end == pytest.approx(6.0, abs=0.015)


@pytest.mark.parametrize(("stops", "moves"), [(6.0, False), (9.5, True), (20.0, True)])
def test_a_vehicle_at_rest_and_a_moment_without_change_are_left_alone(stops, moves) -> None:
    signals = flight(stops, moves=moves)
    kept, notes = without_stale(signals)
    assert notes == []
    assert kept == signals
    assert find_missions(kept)[0].end == pytest.approx(TIME[-1])


def test_a_last_pose_that_is_sent_for_good_is_no_pose_while_the_gyro_turns() -> None:
    signals = flight(6.0, moves=False)
    turning = np.column_stack([0.4 * np.cos(TIME), 0.4 * np.sin(TIME), 0 * TIME])
    kept, (note,) = without_stale(signals | {"body_rate": Series(TIME, turning)})
    assert note.names == ("attitude",)
    assert find_missions(kept)[0].end == pytest.approx(6.0, abs=0.015)
    noise = np.random.default_rng(2).normal(0.0, 0.02, (len(TIME), 3))
    assert without_stale(signals | {"body_rate": Series(TIME, noise)})[1] == []


@pytest.mark.parametrize("lost", [np.s_[:300], np.s_[:]])
def test_where_no_position_is_seen_nothing_is_taken_for_motion(lost) -> None:
    signals = flight(6.0, moves=True)
    position = signals["position"]
    unseen = np.where(TIME[:, None] < 3.0, position.values, np.nan)
    signals["position"] = Series(TIME[lost], unseen[lost])
    assert without_stale(signals) == (signals, [])


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
    settings = settle(Options([short.path], vehicle="crazyflie"))
    with pytest.raises(RecordingError, match="its attitude stops changing"):
        recordings_of(settings, [short])
    assert short.duration == pytest.approx(TIME[-1], abs=0.02)
    assert is_stale(short.series, short.notes)
    ((looked_at, then), _) = inspect_recordings([short.path, tmp_path / "longer.csv"], cache=False)
    assert all("attitude" in inlet.missing for inlet in looked_at.inlets)
    assert looked_at.coefficients == ()
    assert longer.duration == pytest.approx(6.0, abs=0.02)
    assert not is_stale(longer.series, longer.notes)
    assert not any("attitude" in inlet.missing for inlet in then.inlets)
    assert then.coefficients
