"""The same flight comes out of every format."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tests.tuner.recordings import making
from tuner.core.errors import RecordingError
from tuner.recordings.flight import Flight
from tuner.recordings.formats import open_recording
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import Cause
from tuner.recordings.ros.mcap import records


@pytest.fixture(scope="module")
def circle(short: Path) -> Flight:
    return load_flight(short)


def assert_same(got: Flight, expected: Flight, *, without: tuple[str, ...] = ()) -> None:
    assert set(got.signals) == set(expected.signals) - set(without)
    assert len(got.time) == len(expected.time)
    for name, values in got.signals.items():
        wanted = expected.signals[name]
        assert np.array_equal(np.isnan(values), np.isnan(wanted)), name
        size = max(1.0, float(np.nanmax(np.abs(wanted))))
        assert np.nanmax(np.abs(values - wanted)) < 1e-6 * size, name
    for name, series in got.series.items():
        assert np.allclose(series.time, expected.series[name].time, atol=1e-9), name
    assert got.initial.position == pytest.approx(expected.initial.position, abs=1e-6)
    assert got.initial.attitude == pytest.approx(expected.initial.attitude, abs=1e-6)


@pytest.mark.parametrize(
    ("storage", "mode"),
    [
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
    ],
    ids=["file", "message", "chunk"],
)
def test_compressed_ros2(
    storage: StoragePlugin, mode: CompressionMode, tmp_path: Path, short: Path, circle: Flight
) -> None:
    folder = making.to_ros2(short, tmp_path / "circle", storage, mode)
    assert_same(load_flight(folder), circle)


@pytest.mark.parametrize("storage", StoragePlugin, ids=lambda storage: storage.name)
def test_bare_file_and_folder_without_metadata(
    storage: StoragePlugin, tmp_path: Path, short: Path, circle: Flight
) -> None:
    folder = making.to_ros2(short, tmp_path / "circle", storage)
    assert_same(load_flight(folder), circle)
    (folder / "metadata.yaml").unlink()
    (bare,) = folder.iterdir()
    assert_same(load_flight(bare), circle)
    got = load_flight(folder)
    assert_same(got, circle)
    assert [damage.cause for damage in got.damage] == [Cause.METADATA_MISSING]


def test_mcap_without_chunks_and_summary(tmp_path: Path, short: Path, circle: Flight) -> None:
    folder = making.to_ros2(short, tmp_path / "circle", StoragePlugin.MCAP)
    (whole,) = folder.glob("*.mcap")
    content = whole.read_bytes()
    parts = [content[:8]]
    for op, begin, end in records(content[8:-8], 0):
        if op in (0x01, 0x03, 0x04):  # header, schema, channel
            parts.append(content[8:-8][begin - 9 : end])
        elif op == 0x06:  # a chunk, of which the records begin behind its head
            chunk = content[8:-8][begin:end]
            name = int.from_bytes(chunk[28:32], "little")
            parts.append(chunk[32 + name + 8 :])
    path = tmp_path / "loose.mcap"
    path.write_bytes(b"".join(parts))
    got = load_flight(path)
    assert_same(got, circle)
    (damage,) = got.damage
    with Reader(short) as reader:
        count = reader.message_count
    assert (damage.cause, damage.salvaged, damage.bytes_lost) == (Cause.END_MISSING, count, 0)
    end = struct.pack("<BQI", 0x0F, 4, 0) + struct.pack("<BQQQI", 0x02, 20, 0, 0, 0) + content[:8]
    path.write_bytes(b"".join(parts) + end)  # closed, which is all that a writer must do
    assert not load_flight(path).damage


def test_mcap_without_indexes(tmp_path: Path, short: Path, circle: Flight) -> None:
    folder = making.to_ros2(short, tmp_path / "circle", StoragePlugin.MCAP)
    (whole,) = folder.glob("*.mcap")
    content = whole.read_bytes()
    kept = [
        content[8:-8][begin - 9 : end]
        for op, begin, end in records(content[8:-8], 0)
        if op not in (0x07, 0x08)
    ]
    path = tmp_path / "bare.mcap"
    path.write_bytes(content[:8] + b"".join(kept) + content[:8])
    got = load_flight(path)
    assert_same(got, circle)
    assert not got.damage


@pytest.mark.parametrize("compression", ["none", "bz2", "lz4"])
def test_compressed_bag(compression: str, tmp_path: Path, short: Path, circle: Flight) -> None:
    path = making.rewrite(short, tmp_path / "packed.bag", compression=compression)
    assert f"compression={compression}".encode() in path.read_bytes()
    assert_same(load_flight(path), circle)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_table(suffix: str, tmp_path: Path, short: Path, circle: Flight) -> None:
    path = tmp_path / f"circle{suffix}"
    if suffix == ".csv":
        making.to_csv(short, path)
    else:
        frame = making.to_frame(short)
        frame["time"] = frame["time"].astype("datetime64[ns]")
        frame.to_parquet(path)
    (tmp_path / "lab.yaml").write_text(making.LAB_TABLE)
    got = load_flight(path, topics=tmp_path / "lab.yaml")
    assert_same(got, circle)


def test_px4_log_and_bridge(tmp_path: Path, short: Path) -> None:
    """PX4's stamps are whole microseconds, so the bag is compared with its stamps cut to them."""

    def cut(topic: str, time: int, message: object) -> list[tuple[int, object]]:
        if topic.endswith("lap_completed"):
            return []
        whole = making.stamp_of(message) // 1000 * 1000
        return [(time, making.stamped(message, whole))]

    bag = making.rewrite(short, tmp_path / "cut.bag", cut)
    expected = load_flight(bag)
    messages = making.px4_messages(bag)
    boot = int(messages["vehicle_attitude"].time[0]) - 5_000_000_000
    for got in (
        load_flight(making.to_ulog(messages, tmp_path / "log.ulg", boot=boot)),
        load_flight(making.to_px4_ros2(messages, tmp_path / "bridge", boot=boot)),
    ):
        # PX4 estimates position and velocity together, on one clock.
        assert got.has("velocity")
        signals = {k: v for k, v in got.signals.items() if k != "velocity"}
        series = {k: v for k, v in got.series.items() if k != "velocity"}
        same = Flight(**{**vars(got), "signals": signals, "series": series})
        assert_same(same, expected, without=("velocity",))
        assert not [note for note in got.notes if note.kind == "warning"]


def test_decoding_agrees_with_rosbags_bit_for_bit(short: Path) -> None:
    expected = making.columns_of(short, {t: list(f) for t, f in making.LAB.items()})
    wanted = {topic: tuple(fields) for topic, fields in making.LAB.items()}
    contents = open_recording(short).read(wanted)
    for topic, column in expected.items():
        samples = contents.samples[topic]
        stamps = samples.receive if samples.stamp is None else samples.stamp
        assert np.array_equal(stamps, column.time), topic
        got = np.column_stack([samples.fields[name] for name in making.LAB[topic]])
        assert np.array_equal(got, column.values), topic


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\x1f\x8b\x08" + b"x" * 50, "is packed"),
        (b"\x00\x01\x02\x03" * 50, "is of no known format"),
        (b"one column\n1\n2\n", "is of no known format"),
        (b"a,b\n1,2\n", "no column that is a time among a, b"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "thing.dat"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=message) as caught:
        load_flight(path)
    assert "\n" not in str(caught.value)
