"""Recordings become flights on a uniform clock; what is unknown in them stays unknown."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.core.errors import RecordingError
from tuner.recordings.flight import Flight, Series
from tuner.recordings.interpolation import GAP_S, with_gaps_filled
from tuner.recordings.loader import gap_notes, load_flight
from tuner.recordings.topics import load_topic_map

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
MISSIONS = {
    "circle_3mps": 36.0,
    "circle_4mps": 32.0,
    "diagonal_3mps": 32.0,
    "lemniscate_4mps": 36.0,
    "yaw_spin_3rps": 16.0,
}


@pytest.fixture(scope="module")
def circle() -> Flight:
    return load_flight(FLIGHTS / "circle_3mps.bag")


@pytest.mark.parametrize("name", MISSIONS)
def test_every_shipped_bag_loads(name: str) -> None:
    flight = load_flight(FLIGHTS / f"{name}.bag")
    assert flight.duration == pytest.approx(MISSIONS[name] - 0.01)
    assert np.allclose(np.diff(flight.time), 0.01)
    for signal in ("position", "attitude", "velocity", "body_rate", "command", "rate_setpoint"):
        assert flight.has(signal)
        assert np.isfinite(flight.signals[signal][2:-10]).all(), signal
    assert flight.yaw_rate_setpoint == (3.0 if name.startswith("yaw") else None)
    assert np.isfinite(flight.signals["rotor_speed"][2:-2, 0]).all()
    assert np.isnan(flight.signals["rotor_speed"][:, 1:]).all()
    assert flight.series["position"].time[0] == pytest.approx(-2.0, abs=0.02)
    assert len(flight.sha256) == 64


def test_reference_sample_k_sits_on_tick_k(circle: Flight) -> None:
    """The publisher's circle has a closed form, so that one tick too late is seen."""
    phase, windup, expected = 0.0, 0.0, []
    for _ in range(len(circle.time)):
        before = windup
        phase += 0.01 * windup * 2.1
        windup = min(1.0, windup + 0.001)
        expected.append([2 * np.cos(0.7 * phase), 2 * np.sin(0.7 * phase), before])
    position = circle.signals["reference_position"]
    assert np.abs(position[:, :2] - np.array(expected)[:, :2]).max() < 1e-5


def test_a_slower_clock_reads_the_reference_on_its_ticks_too(circle: Flight) -> None:
    full = circle.signals["reference_position"]
    half = load_flight(FLIGHTS / "circle_3mps.bag", rate=50.0).signals["reference_position"]
    assert np.array_equal(half, full[::2])


def test_initial_state_is_the_hover_before_the_mission(circle: Flight) -> None:
    start = circle.initial
    assert start.position == pytest.approx([2.0, 0.0, 1.1177], abs=5e-4)
    assert np.abs(start.velocity).max() < 0.01
    assert start.attitude == pytest.approx([1, 0, 0, 0], abs=3e-4)
    assert np.abs(start.body_rate).max() < 5e-3
    assert start.rotor_speed[0] == pytest.approx(630, abs=2)
    assert np.isnan(start.rotor_speed[1:]).all()
    assert start.command == pytest.approx([0.547] * 4, abs=1e-3)


def test_tachometer_artefacts_are_dropped_and_counted(circle: Flight) -> None:
    note = next(note for note in circle.notes if "rotor_speed" in note.names)
    assert note.topic == "/mavros/rpm"
    assert 5 <= note.count <= 40
    speed = circle.series["rotor_speed"].values[:, 0]
    assert np.abs(np.diff(speed)).max() < 100


def test_motion_capture_is_preferred_to_the_estimate(circle: Flight) -> None:
    assert len(circle.series["position"].time) > 3700  # 100 Hz, not the estimate's 50 Hz


def test_headerless_topic_falls_back_to_recording_time_with_a_note(circle: Flight) -> None:
    assert any(note.topic == "/trajectory_publisher/lap_completed" for note in circle.notes)
    assert circle.series["lap"].values[:, 0].tolist() == [1, 2, 3, 4, 5, 6, 7]


def test_missing_pose_names_the_namespace() -> None:
    lab = load_topic_map("thesis_lab")
    pose = {"position": lab.signals["position"], "attitude": lab.signals["attitude"]}
    moved = lab.model_copy(update={"signals": pose}).under("uav1")
    with pytest.raises(RecordingError, match="/uav1/optitrack/pose"):
        load_flight(FLIGHTS / "circle_3mps.bag", topics=moved)


@pytest.mark.parametrize("content", [b"", b"#ROSBAG V2.0\n", b"not a bag at all" * 100])
def test_unreadable_bag_is_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.bag"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"broken\.bag: ") as caught:
        load_flight(path)
    assert "\n" not in str(caught.value)


def test_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="no such file"):
        load_flight(tmp_path / "none.bag")


TIME = np.arange(0.0, 6.0, 0.01)


def circling(time: np.ndarray) -> np.ndarray:
    """Return positions on a circle of 2 m at 4 m/s."""
    angle = 2.0 * time
    return 2.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])


@given(st.sets(st.integers(1, len(TIME) - 2), max_size=30))
def test_lost_samples_of_a_circle_come_back(lost: set[int]) -> None:
    kept = np.array([i not in lost for i in range(len(TIME))])
    got = with_gaps_filled(Series(TIME[kept], circling(TIME)[kept]))
    np.testing.assert_allclose(got.time, TIME, atol=1e-9)
    alone = not any(i + 1 in lost for i in lost)
    error = np.abs(got.values - circling(TIME)).max()
    assert error < (1e-3 if alone else 0.02)  # held, it would be 4 cm for each
    np.testing.assert_array_equal(got.values[kept], circling(TIME)[kept])


def test_a_steady_series_is_left_alone() -> None:
    series = Series(TIME, circling(TIME))
    assert with_gaps_filled(series) is series


def test_a_step_stays_between_its_ends() -> None:
    values = np.where(TIME < 3.0, 0.0, 1.0)[:, None]
    kept = np.abs(TIME - 3.0) > 0.025
    got = with_gaps_filled(Series(TIME[kept], values[kept]))
    assert len(got.time) == len(TIME)
    assert np.all((got.values >= 0.0) & (got.values <= 1.0))


@pytest.mark.parametrize("gap", [2.0 * GAP_S, 1.0])
def test_long_gaps_and_lone_samples_stay(gap: float) -> None:
    kept = (TIME < 2.0) | (2.0 + gap <= TIME)
    assert len(with_gaps_filled(Series(TIME[kept], circling(TIME)[kept])).time) == kept.sum()
    assert len(with_gaps_filled(Series(TIME[:1], circling(TIME)[:1])).time) == 1


def test_an_unknown_sample_counts_as_lost() -> None:
    values = circling(TIME)
    values[100] = np.nan
    got = with_gaps_filled(Series(TIME, values))
    np.testing.assert_allclose(got.values, circling(TIME), atol=1e-3)
    unknown = Series(TIME, np.full((len(TIME), 3), np.nan))
    assert with_gaps_filled(unknown) is unknown


@pytest.mark.parametrize(
    ("hertz", "lost", "is_said"), [(2.0, 0.45, False), (2.0, 2.0, True), (100.0, 0.3, True)]
)
def test_a_signal_is_unknown_only_beyond_what_its_rate_leaves_open(
    hertz: float, lost: float, *, is_said: bool
) -> None:
    clock = np.arange(0.0, 20.0, 0.01)
    sampled = Series(np.arange(0.0, 20.0, 1.0 / hertz), np.ones((int(20 * hertz), 1)))
    values = np.where(clock < lost, np.nan, 16.0)[:, None]
    notes = [*gap_notes({"battery_voltage": values}, {"battery_voltage": sampled}, 100.0)]
    assert bool(notes) is is_said
