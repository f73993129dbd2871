"""PX4's messages, of its logs and in ROS 2, become signals in the project's frames."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin

from tests.tuner.recordings import making
from tuner.config import resolve_settings
from tuner.core.errors import RecordingError
from tuner.findings.findings import Code, one_line
from tuner.job.recording_verdict import RecordingVerdict, in_words, verdict_of
from tuner.options import Options
from tuner.recordings.flight import Flight
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import NoteCode
from tuner.recordings.ulog import logger_settings, logging_advice
from tuner.search.job_flights import read_recordings, with_logged_parameters
from tuner.vehicle import ControllerFile
from tuner.vehicle.motor_orders import motor_order_of

PARAMETERS = {
    "MC_ROLLRATE_P": 0.15,
    "MC_ROLLRATE_I": 0.2,
    "MC_PITCHRATE_D": 0.0036,
    "MC_YAWRATE_FF": 0.05,
    "MC_RR_INT_LIM": 0.3,
    "IMU_GYRO_RATEMAX": 800,
    "IMU_GYRO_CUTOFF": 80.0,
    "IMU_DGYRO_CUTOFF": 0.0,
    "THR_MDL_FAC": 0.3,
    "MC_AIRMODE": 1,
    "SDLOG_PROFILE": 1,
}
AS_BETAFLIGHT = {"CA_ROTOR_COUNT": 4} | {
    f"CA_ROTOR{i}_P{axis}": float(value)
    for i, place in enumerate([(-1, 1), (1, 1), (-1, -1), (1, -1)])
    for axis, value in zip("XY", place, strict=True)
}
"""Rear right, front right, rear left, front left: x is forward, y right."""


@pytest.fixture(scope="module")
def messages(short: Path) -> dict[str, making.Column]:
    return making.px4_messages(short)


def log(
    messages: dict[str, making.Column], path: Path, parameters: dict[str, float] | None = None
) -> Path:
    boot = int(next(iter(messages.values())).time[0]) - 5_000_000_000
    return making.to_ulog(messages, path, boot=boot, parameters=parameters)


def test_the_rate_loop_is_the_logs(messages, tmp_path: Path) -> None:
    path = log(messages, tmp_path / "log.ulg", PARAMETERS)
    settings, (finding,) = with_logged_parameters(resolve_settings(Options([str(path)])))
    flew = settings.controller
    assert (flew.rate.roll.p, flew.rate.roll.i, flew.rate.pitch.d) == (0.15, 0.2, 0.0036)
    assert (flew.rate.yaw.ff, flew.rate.rate, flew.physics.rate) == (0.05, 800, 800)
    assert (flew.filters.gyro_cutoff, flew.filters.dgyro_cutoff) == (80.0, None)
    assert (flew.mixer.thrust_factor, flew.mixer.airmode) == (0.3, 1)
    assert flew.position == ControllerFile().position
    line = one_line(finding)
    assert "rate.roll.p 0.15 (MC_ROLLRATE_P; the file has 0.18)" in line
    assert "filters.dgyro_cutoff no filter (IMU_DGYRO_CUTOFF; the file has 20)" in line
    assert "integrator_limit" not in line
    assert finding.level == "info"
    named, (finding,) = with_logged_parameters(
        resolve_settings(Options([str(path)], controller="hovergames"))
    )
    assert (named.controller, finding.level) == (flew, "warning")


def test_logs_that_differ_are_named(messages, tmp_path: Path) -> None:
    paths = [
        log(messages, tmp_path / f"{name}.ulg", PARAMETERS | {"MC_ROLLRATE_P": gain})
        for name, gain in (("a", 0.15), ("b", 0.18))
    ]
    _, findings = with_logged_parameters(resolve_settings(Options([str(path) for path in paths])))
    (differ,) = [finding for finding in findings if finding.code is Code.LOGS_DIFFER]
    assert differ.names == ("MC_ROLLRATE_P",)


def test_parameters_are_those_at_arming_and_later_changes_are_named(messages, tmp_path) -> None:
    def record(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    def changed(name: bytes, value: float) -> bytes:
        key = b"float " + name
        return record("P", struct.pack("<B", len(key)) + key + struct.pack("<f", value))

    def armed(seconds: int, value: int) -> bytes:
        return record("D", struct.pack("<HQB", 99, seconds * 1_000_000, value))

    text = log(messages, tmp_path / "log.ulg", PARAMETERS).read_bytes()
    data = text.index(record("A", struct.pack("<BH", 0, 0) + next(iter(messages)).encode()))
    kind = record("F", b"actuator_armed:uint64_t timestamp;bool armed;")
    before = armed(1, 0) + changed(b"MC_ROLLRATE_P", 0.25) + armed(2, 1)
    before = record("A", struct.pack("<BH", 0, 99) + b"actuator_armed") + before
    path, kinds = tmp_path / "tuned.ulg", text[:16] + kind + text[16:data]
    path.write_bytes(kinds + before + text[data:] + changed(b"MC_ROLLRATE_I", 0.5))
    settings, (_, differ) = with_logged_parameters(resolve_settings(Options([str(path)])))
    assert (settings.controller.rate.roll.p, settings.controller.rate.roll.i) == (0.25, 0.2)
    assert (differ.code, differ.names) == (Code.LOGS_DIFFER, ("MC_ROLLRATE_I",))
    path.write_bytes(text + changed(b"MC_ROLLRATE_P", 0.25))  # does not tell when it was armed
    settings, (_, differ) = with_logged_parameters(resolve_settings(Options([str(path)])))
    assert (settings.controller.rate.roll.p, differ.names) == (0.15, ("MC_ROLLRATE_P",))


def test_parameters_that_no_controller_has_change_nothing(messages, tmp_path: Path) -> None:
    path = log(messages, tmp_path / "log.ulg", {"IMU_GYRO_CUTOFF": 1e9, "MC_ROLLRATE_P": np.nan})
    settings = resolve_settings(Options([str(path)]))
    assert with_logged_parameters(settings) == (settings, ())


def test_flights_of_px4s_own_loops_enter_below_them(messages, tmp_path: Path) -> None:
    path = log(messages, tmp_path / "log.ulg")
    (recording,), (finding,) = read_recordings(resolve_settings(Options([str(path)])))
    assert (recording.inlet, finding.code) == ("body_rate", Code.PX4_LOOPS)
    (tmp_path / "job.yaml").write_text("inlet: reference\n")
    asked = resolve_settings(Options([str(path)], config=str(tmp_path / "job.yaml")))
    ((recording,), _) = read_recordings(asked)
    assert recording.inlet == "reference"


@pytest.mark.parametrize(
    ("parameters", "rotors"),
    [
        ({"CA_ROTOR_COUNT": 6}, "6 rotors, by its CA_ROTOR_COUNT"),
        ({"MAV_TYPE": 14, "SYS_CTRL_ALLOC": 0, "CA_ROTOR_COUNT": 4}, "8 rotors, by its MAV_TYPE"),
        ({"MAV_TYPE": 13, "CA_ROTOR_COUNT": 4}, None),
        ({"MAV_TYPE": 2, "CA_ROTOR_COUNT": 0}, None),
        ({"MAV_TYPE": np.nan, "CA_ROTOR_COUNT": np.nan}, None),
    ],
)
def test_logs_of_other_than_four_rotors_are_refused(
    messages, tmp_path: Path, parameters: dict[str, float], rotors: str | None
) -> None:
    """Four of six motors were read, and fitted as a quadrotor's."""
    path = log(messages, tmp_path / "log.ulg", parameters)
    if rotors is None:
        load_flight(path)
        return
    with pytest.raises(RecordingError, match=f"is of a vehicle of {rotors}"):
        load_flight(path)


def test_motors_are_in_the_order_of_the_logs_geometry(messages, tmp_path: Path) -> None:
    assert motor_order_of(AS_BETAFLIGHT) == (2, 3, 4, 1)
    assert motor_order_of(AS_BETAFLIGHT | {"SYS_CTRL_ALLOC": 0.0}) is None
    assert motor_order_of({}) is None
    usual = load_flight(log(messages, tmp_path / "usual.ulg"))
    other = load_flight(log(messages, tmp_path / "other.ulg", AS_BETAFLIGHT))
    command = other.series["command"].values
    assert np.array_equal(command, usual.series["command"].values[:, [1, 2, 3, 0]])
    (note,) = [note for note in other.notes if note.code is NoteCode.MOTOR_ORDER_GIVEN]
    assert note.names == ("betaflight",)


def verdict(path: Path) -> RecordingVerdict:
    (inspection,), _ = inspect_recordings([path])
    return verdict_of(inspection)


def test_inspect_answers_first(messages, tmp_path: Path) -> None:
    seen = verdict(log(messages, tmp_path / "log.ulg", PARAMETERS))
    assert (seen.fits, seen.inlets) == (True, ("body_rate",))
    assert seen.not_shown == ("estimate_latency",)
    assert [advice.message for advice in seen.logging] == [
        "vehicle_angular_velocity",
        "actuator_motors",
        "vehicle_acceleration",
    ]
    assert seen.settings == "SDLOG_PROFILE 25 instead of 1"
    lines = in_words(seen)
    assert lines[0] == "can be fitted, through the inlet body_rate"
    assert any("actuator_motors: 50 Hz, 200 Hz would show what the motors" in x for x in lines)
    assert any("rate.roll.p 0.15 (MC_ROLLRATE_P; the file has 0.18)" in line for line in lines)


def test_inspect_says_what_tune_says_of_a_log_that_cannot_be_fitted(
    messages, tmp_path: Path
) -> None:
    pose = {n: messages[n] for n in ("vehicle_local_position", "vehicle_attitude")}
    path = log(pose, tmp_path / "log.ulg")
    line, *more = in_words(verdict(path))
    assert line.startswith("cannot be fitted: holds a pose alone, and neither a reference")
    assert "  actuator_motors: not logged, 200 Hz would show what the motors" in "\n".join(more)
    slow = {n: messages[n] for n in messages if n.startswith(("vehicle_a", "actuator"))}
    del slow["vehicle_attitude"]
    line, *_ = in_words(verdict(log(slow, tmp_path / "slow.ulg")))
    assert "is too slow to be fitted without one: body_rate at 100 Hz" in line


def test_what_to_log_more_of() -> None:
    everything = dict.fromkeys(
        ("vehicle_angular_velocity", "actuator_motors", "vehicle_acceleration", "esc_status",
         "vehicle_rates_setpoint", "vehicle_attitude", "vehicle_local_position"), 250.0,
    )  # fmt: skip
    assert logging_advice(everything) == ()
    assert logger_settings((), {}) == ""
    (advice,) = logging_advice(everything | {"vehicle_local_position": 10.0})
    assert logger_settings((advice,), {"SDLOG_PROFILE": 25.0}) == (
        "lines 'vehicle_local_position 20' in etc/logging/logger_topics.txt on the SD card"
    )
    (advice,) = logging_advice(everything | {"vehicle_attitude": 20.0})
    assert logger_settings((advice,), {}) == "SDLOG_PROFILE 17 instead of 1"


@pytest.fixture(scope="module")
def pose(short: Path) -> making.Column:
    topic = "/optitrack/pose"
    return making.columns_of(short, {topic: list(making.LAB[topic])})[topic]


@pytest.fixture(scope="module")
def truth(short: Path) -> Flight:
    return load_flight(short)


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
    boot = boot_of(messages)
    folder = making.to_px4_ros2(beside, tmp_path / driver, boot=boot, poses={driver: pose})
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
    folder = making.to_px4_ros2(
        {}, tmp_path / driver, poses={driver: pose}, storage=StoragePlugin.SQLITE3
    )
    making.without_definitions(folder)
    position = load_flight(folder).series["position"].values
    assert np.abs(position[:100] - pose.values[:100, :3]).max() < 0.01


def test_px4s_messages_without_definitions_are_asked_for(messages, tmp_path: Path) -> None:
    few = {n: messages[n] for n in ("vehicle_local_position", "vehicle_attitude")}
    folder = making.to_px4_ros2(
        few, tmp_path / "old", boot=boot_of(messages), storage=StoragePlugin.SQLITE3
    )
    making.without_definitions(folder)
    with pytest.raises(RecordingError, match="not the definition of its type px4_msgs") as caught:
        load_flight(folder)
    assert "under 'messages' in a topic map" in str(caught.value)
    assert "\n" not in str(caught.value)
