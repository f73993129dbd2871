"""The five shipped recordings become flights whose every sample is where it belongs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tuner.core.errors import RecordingError
from tuner.recordings import load_flight
from tuner.recordings.topics import load_topic_map

FLIGHTS = Path(__file__).parents[3] / "reference_flights"
MISSIONS = {
    "circle_3mps": 36.0,
    "circle_4mps": 32.0,
    "diagonal_3mps": 32.0,
    "lemniscate_4mps": 36.0,
    "yaw_spin_3rps": 16.0,
}


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


def test_reference_sample_k_sits_on_tick_k() -> None:
    """The publisher's circle has a closed form, so that one tick too late is seen."""
    flight = load_flight(FLIGHTS / "circle_3mps.bag")
    phase, windup, expected = 0.0, 0.0, []
    for _ in range(len(flight.time)):
        before = windup
        phase += 0.01 * windup * 2.1
        windup = min(1.0, windup + 0.001)
        expected.append([2 * np.cos(0.7 * phase), 2 * np.sin(0.7 * phase), before])
    position = flight.signals["reference_position"]
    assert np.abs(position[:, :2] - np.array(expected)[:, :2]).max() < 1e-5


def test_a_slower_clock_reads_the_reference_on_its_ticks_too() -> None:
    full = load_flight(FLIGHTS / "circle_3mps.bag").signals["reference_position"]
    half = load_flight(FLIGHTS / "circle_3mps.bag", rate=50.0).signals["reference_position"]
    assert np.array_equal(half, full[::2])


def test_initial_state_is_the_hover_before_the_mission() -> None:
    start = load_flight(FLIGHTS / "circle_3mps.bag").initial
    assert start.position == pytest.approx([2.0, 0.0, 1.1177], abs=5e-4)
    assert np.abs(start.velocity).max() < 0.01
    assert start.attitude == pytest.approx([1, 0, 0, 0], abs=3e-4)
    assert np.abs(start.body_rate).max() < 5e-3
    assert start.rotor_speed[0] == pytest.approx(630, abs=2)
    assert np.isnan(start.rotor_speed[1:]).all()
    assert start.command == pytest.approx([0.547] * 4, abs=1e-3)


def test_tachometer_artefacts_are_dropped_and_counted() -> None:
    flight = load_flight(FLIGHTS / "circle_3mps.bag")
    note = next(note for note in flight.notes if "rotor_speed" in note.names)
    assert note.topic == "/mavros/rpm"
    assert 5 <= note.count <= 40
    speed = flight.series["rotor_speed"].values[:, 0]
    assert np.abs(np.diff(speed)).max() < 100


def test_motion_capture_is_preferred_to_the_estimate() -> None:
    flight = load_flight(FLIGHTS / "circle_3mps.bag")
    assert len(flight.series["position"].time) > 3700  # 100 Hz, not the estimate's 50 Hz


def test_headerless_topic_falls_back_to_recording_time_with_a_note() -> None:
    flight = load_flight(FLIGHTS / "circle_3mps.bag")
    assert any(note.topic == "/trajectory_publisher/lap_completed" for note in flight.notes)
    assert flight.series["lap"].values[:, 0].tolist() == [1, 2, 3, 4, 5, 6, 7]


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
