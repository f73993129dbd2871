"""PX4 in ROS 2: the bridge's messages on PX4's clock, motion capture on the host's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from tests.tuner.recordings import making
from tuner.core.errors import RecordingError
from tuner.job.recording_verdict import verdict_of
from tuner.recordings import Flight, inspect_recordings, load_flight
from tuner.recordings.notes import NoteCode


@pytest.fixture(scope="module")
def messages() -> dict[str, making.Column]:
    return making.px4_messages(making.CIRCLE)


@pytest.fixture(scope="module")
def pose() -> making.Column:
    topic = "/optitrack/pose"
    return making.columns_of(making.CIRCLE, {topic: list(making.LAB[topic])})[topic]


@pytest.fixture(scope="module")
def truth() -> Flight:
    return load_flight(making.CIRCLE)


def boot_of(messages: dict[str, making.Column]) -> int:
    return int(messages["vehicle_attitude"].time[0]) - 5_000_000_000


def near(flight: Flight, truth: Flight, *names: str) -> None:
    for name in names:
        got, expected = flight.series[name], truth.signals[name]
        known = np.isfinite(expected).all(axis=1)
        again = np.column_stack([np.interp(truth.time, got.time, c) for c in got.values.T])
        size = np.abs(expected[known]).max()
        assert np.abs(again - expected)[known][20:-20].max() < 0.01 * size, name


@pytest.mark.parametrize("driver", making.MOCAPS)
def test_motion_capture_beside_the_bridge(
    driver: str, messages, pose, truth, tmp_path: Path
) -> None:
    beside = {n: m for n, m in messages.items() if n != "vehicle_attitude"}
    folder = making.to_px4_and_mocap(
        beside, pose, driver, tmp_path / driver, boot=boot_of(messages)
    )
    flight = load_flight(folder)
    near(flight, truth, "position", "attitude", "body_rate", "rate_setpoint", "command")
    assert flight.signals["position"].shape == truth.signals["position"].shape
    clocks = [note for note in flight.notes if note.code is NoteCode.OTHER_CLOCK]
    assert {note.topic for note in clocks} == {making.MOCAPS[driver][0]}
    (inspection,), _ = inspect_recordings([folder])
    assert verdict_of(inspection).inlets == ("body_rate",)


def test_the_bridges_odometry_alone(messages, truth, tmp_path: Path) -> None:
    local, attitude = messages["vehicle_local_position"], messages["vehicle_attitude"]
    rates = messages["vehicle_angular_velocity"]
    gyro = np.column_stack([np.interp(local.time, rates.time, c) for c in rates.values.T])
    values = np.hstack([local.values[:, :3], attitude.values, local.values[:, 3:], gyro])
    commands = messages["actuator_outputs"]
    sent = {
        "vehicle_odometry": making.Column(local.time, values),
        "vehicle_rates_setpoint": messages["vehicle_rates_setpoint"],
        "actuator_motors": making.Column(commands.time, commands.values / 1000 - 1),
        "esc_status": messages["esc_status"],
    }
    folder = making.to_px4_ros2(sent, tmp_path / "odometry", boot=boot_of(messages))
    flight = load_flight(folder)
    near(flight, truth, "position", "attitude", "rate_setpoint", "thrust_setpoint", "command")
    assert flight.has("velocity")
    assert np.nanmax(np.abs(flight.signals["body_rate"])) < 1.5
    assert not [note for note in flight.notes if note.kind == "warning"]


@pytest.mark.parametrize("driver", ["mocap4r2", "motion_capture_tracking"])
def test_databases_without_definitions_know_motion_capture(
    driver: str, pose, tmp_path: Path
) -> None:
    folder = making.to_px4_and_mocap(
        {}, pose, driver, tmp_path / driver, boot=0, storage=StoragePlugin.SQLITE3
    )
    making.without_definitions(folder)
    position = load_flight(folder).series["position"].values
    assert np.abs(position[:100] - pose.values[:100, :3]).max() < 0.01


def test_px4s_messages_without_definitions_are_asked_for(messages, pose, tmp_path: Path) -> None:
    few = {n: messages[n] for n in ("vehicle_local_position", "vehicle_attitude")}
    folder = making.to_px4_and_mocap(
        few, making.Column(pose.time[:0], pose.values[:0]), "vrpn_mocap", tmp_path / "old",
        boot=boot_of(messages), storage=StoragePlugin.SQLITE3,
    )  # fmt: skip
    making.without_definitions(folder)
    with pytest.raises(RecordingError, match="not the definition of its type px4_msgs") as caught:
        load_flight(folder)
    assert "under 'messages' in a topic map" in str(caught.value)
    assert "\n" not in str(caught.value)
