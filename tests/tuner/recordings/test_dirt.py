"""What goes wrong in real recordings: each defect is survived, and reported."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.tuner.recordings import making
from tuner.config import TrajectorySettings
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.yaml_section import build
from tuner.recordings.consistency import correct_frames
from tuner.recordings.flight import Flight, Series
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import Cause, Note, NoteCode, damage_sentence
from tuner.search.job_flights import load_flights

POSE = "/optitrack/pose"
GYRO = "/mavros/imu/data"
Change = Callable[[str, int, Any], list[tuple[int, Any]]]


@pytest.fixture(scope="module")
def clean(short: Path) -> Flight:
    return load_flight(short)


@pytest.fixture
def dirty(short: Path, tmp_path: Path) -> Callable[[Change], Flight]:
    """Load the short bag after each pose and each message of the gyro went through a change."""
    bag, topics = tmp_path / "dirty.bag", (POSE, GYRO)
    return lambda change: load_flight(making.rewrite(short, bag, change, of=topics))


def noted(flight: Flight, code: NoteCode, *names: str, topic: str = "") -> Note:
    """Return the one note with a code, of the signals that are named."""
    (note,) = (
        note
        for note in flight.notes
        if note.code is code and topic in note.topic and note.names[: len(names)] == names
    )
    return note


def near(
    got: Flight, expected: Flight, *, position: float = 1e-3, signal: str = "position"
) -> None:
    count = min(len(got.time), len(expected.time)) - 20
    difference = np.abs(got.signals[signal][:count] - expected.signals[signal][:count])
    assert np.nanmax(difference) < position
    assert np.isfinite(got.signals[signal][:count]).mean() > 0.9


def test_dropped_duplicated_and_late_messages(clean: Flight, dirty: Any) -> None:
    random = np.random.default_rng(0)
    held: list[tuple[int, Any]] = []

    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic != POSE:
            return [(time, message)]
        chance = random.random()
        if chance < 0.05:
            return []
        if chance < 0.10:
            return [(time, message), (time + 1000, copy.deepcopy(message))]
        if chance < 0.15 and not held:
            held.append((time, message))
            return []
        late = [(time + 2000, held.pop()[1])] if held else []
        return [(time, message), *late]

    got = dirty(change)
    near(got, clean, position=5e-3)
    assert noted(got, NoteCode.STAMPED_TWICE, "position", "attitude").count > 30
    assert noted(got, NoteCode.OUT_OF_ORDER, "position", "attitude").count > 30


def test_nan_and_quaternion_dirt(clean: Flight, dirty: Any) -> None:
    random = np.random.default_rng(0)

    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == POSE:
            chance = random.random()
            q = message.pose.orientation
            if chance < 0.02:
                message.pose.position.y = float("nan")
            elif chance < 0.4:
                q.w, q.x, q.y, q.z = -q.w, -q.x, -q.y, -q.z
            elif chance < 0.5:
                q.w, q.x, q.y, q.z = 1.3 * q.w, 1.3 * q.x, 1.3 * q.y, 1.3 * q.z
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=5e-3)
    near(got, clean, signal="attitude")
    assert noted(got, NoteCode.NOT_A_NUMBER, "position").count > 10
    assert noted(got, NoteCode.NO_UNIT_QUATERNION, "attitude").count > 100


def test_single_wrong_stamps_and_a_clock_that_was_set(clean: Flight, dirty: Any) -> None:
    random = np.random.default_rng(0)

    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == POSE:
            stamp = making.stamp_of(message)
            if random.random() < 0.01:
                making.stamped(message, 0)
            elif stamp > 1_664_800_009_000_000_000:
                making.stamped(message, stamp + 3_600_000_000_000)
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=5e-3)
    assert noted(got, NoteCode.STAMPS_REPLACED, topic=POSE).count > 5
    jump = noted(got, NoteCode.CLOCK_JUMPED).numbers["seconds"]
    assert jump == pytest.approx(3600.0, abs=0.1)


def test_a_topic_on_another_clock_is_moved(clean: Flight, dirty: Any) -> None:
    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == POSE:
            making.stamped(message, making.stamp_of(message) - 7_300_000_000)
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=5e-3)
    assert noted(got, NoteCode.OTHER_CLOCK, topic=POSE).count > 1000


def test_motion_capture_behind_the_gyro_is_found_by_correlation(clean: Flight, dirty: Any) -> None:
    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == POSE:
            making.stamped(message, making.stamp_of(message) + 80_000_000)
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=5e-3)
    assert noted(got, NoteCode.POSE_MOVED).numbers["seconds"] == pytest.approx(0.08, abs=1.5e-3)


@pytest.mark.parametrize("ticks", [0, 1_000_000_000], ids=["not set", "whole seconds"])
def test_unset_header_stamps_give_way_to_receive_times(
    ticks: int, clean: Flight, dirty: Any
) -> None:
    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == GYRO:
            making.stamped(message, making.stamp_of(message) // ticks * ticks if ticks else 0)
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=0.2, signal="body_rate")
    assert [n for n in got.notes if n.topic == GYRO and n.kind == "warning"]


def test_wrong_frame_and_order_are_turned(clean: Flight, dirty: Any) -> None:
    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == POSE:
            q = message.pose.orientation
            q.w, q.x, q.y, q.z = q.x, q.y, q.z, q.w
        if topic == GYRO:
            w = message.angular_velocity
            w.x, w.y, w.z = w.x, -w.y, -w.z
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=1e-9, signal="attitude")
    near(got, clean, position=1e-9, signal="body_rate")
    assert noted(got, NoteCode.FRAME_TURNED, "attitude", "scalar-last").count > 1000
    assert noted(got, NoteCode.FRAME_TURNED, "body_rate", "in FRD axes").count > 1000


@pytest.mark.parametrize(("per_metre", "name"), [(1e2, "in centimetres"), (1e3, "in millimetres")])
def test_a_position_in_another_unit_is_read_so(
    per_metre: float, name: str, clean: Flight, dirty: Any
) -> None:
    """As motion capture has it; nothing of it is taken for outliers or for a leap."""

    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic == POSE:
            p = message.pose.position
            p.x, p.y, p.z = per_metre * p.x, per_metre * p.y, per_metre * p.z
        return [(time, message)]

    got = dirty(change)
    near(got, clean, position=1e-9)
    note = noted(got, NoteCode.UNIT_READ, "position", name, topic=POSE)
    assert note.kind == "warning"
    assert [n for n in got.notes if n.topic == POSE and n.kind == "warning"] == [note]


def test_markers_lost_for_a_while(clean: Flight, dirty: Any) -> None:
    lost = range(1_664_800_008_000_000_000, 1_664_800_008_600_000_000)

    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        return [] if topic == POSE and time in lost else [(time, message)]

    got = dirty(change)
    near(got, clean)
    gap = np.isnan(got.signals["position"][:, 0])
    assert 55 <= gap.sum() <= 62
    assert not np.isnan(got.signals["body_rate"]).any()


def test_several_missions_in_one_bag(short: Path, tmp_path: Path) -> None:
    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        pause = 1_664_800_009_000_000_000 <= time < 1_664_800_011_000_000_000
        return [] if pause and topic == "/mavros/setpoint_raw/attitude" else [(time, message)]

    path = making.rewrite(short, tmp_path / "two.bag", change)
    first, second = load_flights(path)
    assert (first.name, second.name) == ("two", "two-2")
    assert first.duration == pytest.approx(4.99, abs=0.02)
    assert second.duration == pytest.approx(4.99, abs=0.02)
    assert second.series["position"].time[0] == pytest.approx(-2, abs=0.02)
    assert load_flight(path, mission=2).duration == second.duration
    with pytest.raises(RecordingError, match="holds no mission 3; give a number from 1 to 2"):
        load_flight(path, mission=3)


def test_take_off_and_landing_are_cut(short: Path, tmp_path: Path) -> None:
    """Set-points run from the ground on; the mission begins when the reference moves in the air."""
    start, stop = 1_664_800_000_000_000_000, 1_664_800_016_000_000_000

    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        since, until = (time - start) * 1e-9, (stop - time) * 1e-9
        up = min(1.0, max(0.0, since - 1.0), max(0.0, until - 1.0))
        if topic == POSE:
            message.pose.position.z *= up
        if topic == "/mavros/rc/out":
            message.channels = np.full(4, 1000, np.uint16) if up == 0 else message.channels
        return [(time, message)]

    got = load_flight(making.rewrite(short, tmp_path / "whole.bag", change))
    assert got.time[0] == 0
    assert got.signals["position"][:-1, 2].min() > 0.1
    assert got.duration == pytest.approx(12.0 - 1.1, abs=0.15)
    no_setpoints = making.rewrite(
        tmp_path / "whole.bag",
        tmp_path / "reference.bag",
        lambda topic, time, message: [] if "setpoint_raw" in topic else [(time, message)],
    )
    got = load_flight(no_setpoints)
    assert got.signals["reference_velocity"][0, 1] == pytest.approx(0.0014)
    assert got.duration == pytest.approx(12.0 - 1.1, abs=0.15)


def test_bag_cut_off_in_the_middle(short: Path, tmp_path: Path, clean: Flight) -> None:
    path = tmp_path / "cut.bag"
    path.write_bytes(short.read_bytes()[: int(short.stat().st_size * 0.7)])
    got = load_flight(path)
    near(got, clean, position=1e-5)
    assert 6 < got.duration < 10
    (damage,) = got.damage
    assert damage.cause is Cause.END_MISSING
    assert damage.salvaged is not None
    assert 4000 < damage.salvaged < 8000
    assert damage.bytes_lost is not None
    assert damage.bytes_lost < 1000
    assert damage.start == pytest.approx(got.duration, abs=0.1)
    assert "the end of the file is missing" in damage_sentence(damage)
    assert load_flight(path).damage == got.damage  # from the cache


def test_bag_that_was_never_closed(short: Path, tmp_path: Path, clean: Flight) -> None:
    raw = short.read_bytes()
    at = raw.index(b"index_pos=") + len(b"index_pos=")
    path = tmp_path / "active.bag"
    path.write_bytes(raw[:at] + bytes(8) + raw[at + 8 :])
    got = load_flight(path)
    near(got, clean, position=1e-5)
    assert got.duration == clean.duration
    (damage,) = got.damage
    assert damage.cause is Cause.NOT_CLOSED
    assert damage.salvaged is not None
    assert damage.salvaged > 8000
    assert damage.bytes_lost == 0


def test_a_record_that_is_cut_is_lost(short: Path, tmp_path: Path, clean: Flight) -> None:
    path = tmp_path / "cut_index.bag"
    path.write_bytes(short.read_bytes()[:-10])
    got = load_flight(path)
    near(got, clean, position=1e-5)
    (damage,) = got.damage
    assert damage.cause is Cause.INDEX_DAMAGED
    assert damage.bytes_lost is not None
    assert 0 < damage.bytes_lost < 1000


def test_damaged_chunk_costs_that_chunk_only(short: Path, tmp_path: Path, clean: Flight) -> None:
    path = tmp_path / "holed.bag"
    raw = bytearray(making.rewrite(short, path, chunk=1 << 16).read_bytes())
    size = raw.index(b"compression=", len(raw) // 2)
    raw[size : size + 16] = b"compression=zzzz"
    path.write_bytes(raw)
    got = load_flight(path)
    near(got, clean, position=1e-5)
    (damage,) = got.damage
    assert (damage.cause, damage.occurrences) == (Cause.CHUNKS_DAMAGED, 1)
    assert damage.bytes_lost == pytest.approx(1 << 16, rel=0.1)
    assert damage.lost is not None
    assert 50 < damage.lost < 500
    assert damage.start is not None
    assert damage.end is not None
    assert 0 < damage.start < damage.end < got.duration


@pytest.mark.parametrize("storage", making.StoragePlugin, ids=lambda storage: storage.name)
def test_ros2_cut_off(storage: Any, short: Path, tmp_path: Path, clean: Flight) -> None:
    folder = making.to_ros2(short, tmp_path / "whole", storage)
    (file,) = (path for path in folder.iterdir() if path.suffix != ".yaml")
    cut = tmp_path / f"cut{file.suffix}"
    cut.write_bytes(file.read_bytes()[: int(file.stat().st_size * 0.7)])
    got = load_flight(cut)
    near(got, clean, position=1e-5)
    (damage,) = got.damage
    assert damage.cause in (Cause.END_MISSING, Cause.DATABASE_DAMAGED)
    assert damage.start == pytest.approx(got.duration, abs=0.2)


def test_namespace_is_suggested_and_works(short: Path, tmp_path: Path, clean: Flight) -> None:
    path = making.rewrite(short, tmp_path / "uav.bag", rename=lambda topic: f"/uav1{topic}")
    with pytest.raises(RecordingError) as caught:
        load_flight(path, topics="mavros")
    message = str(caught.value)
    assert "no topic /mavros/local_position/pose; found /uav1/mavros/local_position/pose" in message
    assert message.endswith("use --namespace uav1")
    near(load_flight(path, namespace="uav1"), clean, position=1e-12)


def test_both_vehicles_of_a_bag_are_named(short: Path, tmp_path: Path) -> None:
    pose = "/mavros/local_position/pose"
    names = {pose: f"/uav1{pose}", POSE: f"/uav2{pose}"}
    path = making.rewrite(short, tmp_path / "two.bag", rename=lambda t: names.get(t, t))
    with pytest.raises(RecordingError, match=r"found /uav[12]/.* and /uav") as caught:
        load_flight(path, topics="mavros")
    assert str(caught.value).endswith(("uav1 or uav2", "uav2 or uav1"))


def test_side_car_names_the_trajectory_and_the_mission(short: Path, tmp_path: Path) -> None:
    path = making.rewrite(short, tmp_path / "side.bag")
    (tmp_path / "side.yaml").write_text(
        "trajectory: {name: circle, radius: 2.0, speed_scale: 2.1}\nstart: 6.0\nend: 11\n"
    )
    got = load_flight(path)
    assert got.trajectory is not None
    assert got.trajectory["name"] == "circle"
    assert got.trajectory["speed_scale"] == 2.1
    assert got.duration == pytest.approx(5.0, abs=0.02)
    (tmp_path / "side.yaml").write_text("trajectory: {name: cirlce}")
    misnamed = load_flight(path).trajectory
    assert misnamed is not None
    with pytest.raises(ConfigError, match=r"no trajectory 'cirlce'.*one of circle, ") as caught:
        build(TrajectorySettings, misnamed, "side.yaml")
    assert "\n" not in str(caught.value)


def test_degrees_per_second_are_noticed_however_noisy_the_gyro() -> None:
    time = np.arange(0.0, 20.0, 0.01)
    half = 0.15 * np.sin(2.0 * time)
    attitude = np.column_stack([np.cos(half), np.sin(half), 0.0 * half, 0.0 * half])
    turning = np.column_stack([0.6 * np.cos(2.0 * time), 0.0 * time, 0.0 * time])
    noise = np.random.default_rng(1).normal(0.0, [1.0, 0.1, 0.1], turning.shape)
    series = {
        "position": Series(time, np.zeros((len(time), 3))),
        "attitude": Series(time, attitude),
        "body_rate": Series(time, np.degrees(turning + noise)),
    }
    read, (note,) = correct_frames(series, {})
    assert (note.code, note.names) == (
        NoteCode.FRAME_TURNED,
        ("body_rate", "in degrees per second"),
    )
    np.testing.assert_allclose(read["body_rate"].values, turning + noise)
    unlike = Series(time, np.degrees(noise[::-1]) * 5.0)
    _, (*_, note) = correct_frames({**series, "body_rate": unlike}, {})
    assert note.code is NoteCode.BODY_RATE_DOUBTED
    milli = Series(time, 1e3 * np.degrees(turning + noise))
    read, (*_, note) = correct_frames({**series, "body_rate": milli}, {})
    assert note.code is NoteCode.BODY_RATE_DOUBTED
    np.testing.assert_array_equal(read["body_rate"].values, milli.values)
