"""Files made to hurt: refused with one line, quickly and in little memory."""

from __future__ import annotations

import bz2
import io
import json
import os
import sqlite3
import struct
import subprocess
import sys
import tracemalloc
import warnings
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from time import process_time

import lz4.frame
import numpy as np
import pyarrow
import pytest
from pyarrow import parquet
from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat

from tests.tuner.recordings import fuzz, making, ways
from tuner.core.errors import InputError
from tuner.ground.hovers import read_static_table
from tuner.ground.rig_data import open_table
from tuner.recordings.flight import Series
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.interpolation import with_gaps_filled
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import Cause, NoteCode
from tuner.recordings.ros.container import (
    MAX_CHUNK_BYTES,
    Chunk,
    DamagedError,
    FileBytes,
    block_of,
    read_wanted,
    unpack,
    zstd,
)
from tuner.recordings.ros.messages import Definitions, missing_fields
from tuner.recordings.ros.recording import unpacked_block
from tuner.recordings.ulog import parameters_of


@contextmanager
def bounded(*, seconds: float = 5.0, megabytes: float = 200.0) -> Iterator[None]:
    tracemalloc.start()
    started = process_time()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1] / 2**20
    finally:
        tracemalloc.stop()
    assert process_time() - started < seconds
    assert peak < megabytes


def refused(path: Path) -> str:
    """Return the line with which a recording is refused."""
    with bounded(), pytest.raises(InputError) as caught:
        load_flight(path, cache=False)
    assert "\n" not in str(caught.value)
    inspections, errors = inspect_recordings([path], cache=False)
    assert len(inspections) + len(errors) == 1
    return str(caught.value)


@pytest.mark.parametrize(
    ("first", "cases"), [(0, 8), pytest.param(8, 92, marks=[pytest.mark.slow, pytest.mark.long])]
)
def test_broken_files_are_read_or_refused(first: int, cases: int) -> None:
    asked = ["all", "--first", str(first), "--cases", str(cases)]
    run = subprocess.run(
        [sys.executable, "-m", "tests.tuner.recordings.fuzz", *asked],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[3],
        check=False,
        timeout=900,
    )
    assert run.returncode == 0, run.stdout + run.stderr
    results = [json.loads(line) for line in run.stdout.splitlines()]
    assert [result["format"] for result in results] == list(fuzz.FORMATS)
    for result in results:
        assert result["read"] + result["refused"] == cases
        assert min(result["read"], result["refused"]) > 0


@pytest.mark.parametrize("compression", ["bz2", "lz4", "zstd"])
def test_a_chunk_unpacks_to_what_it_claims_and_no_more(compression: str) -> None:
    bomb = bytes(100 << 20)
    packed = {
        "bz2": bz2.compress,
        "lz4": lz4.frame.compress,
        "zstd": zstd().compress,
    }[compression](bomb)
    del bomb
    with bounded(megabytes=20):
        assert len(unpack(compression, packed, 1000)) <= 1000
    with bounded(megabytes=20), pytest.raises(DamagedError, match="claims"):
        unpack(compression, packed, 1 << 30)


def _definitions(text: str) -> Definitions:
    definition = MessageDefinition(MessageDefinitionFormat.MSG, text)
    return Definitions(Path("x.bag"), {"a/msg/A": definition})


def _section(name: str, text: str) -> str:
    return f"{'=' * 80}\nMSG: {name}\n{text}\n"


@pytest.mark.parametrize(
    "text",
    [
        "a/A inner\n",
        "a/B b\n" + _section("a/B", "a/A a"),
        "a/B[256] b\n" + "".join(_section(f"a/{x}", f"a/{y}[256] y") for x, y in ["BC", "CB"]),
        "a/B[4000000000] b\n" + _section("a/B", "uint8 c\nstring d"),
        "a/A[] inner\n",
    ],
    ids=["itself", "in turn", "multiplied", "long", "sequence"],
)
def test_types_that_contain_themselves(text: str) -> None:
    with bounded():
        assert missing_fields(_definitions(text), "a/msg/A", ("nothing",)) == ("nothing",)


@pytest.mark.parametrize(
    "text", ["float64 " + "[" * 100_000, "(" * 100_000, "string s " + '"' * 9999, "x" * 300_000]
)
def test_definitions_that_keep_a_parser_busy(text: str) -> None:
    with bounded(), pytest.raises(InputError) as caught:
        _definitions(text).fields("a/msg/A")
    assert len(str(caught.value)) < 1000


def test_database_that_answers_forever(tmp_path: Path) -> None:
    path = tmp_path / "endless.db3"
    with sqlite3.connect(path) as database:
        database.executescript(
            """
            CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT);
            INSERT INTO topics VALUES (1, '/pose', 'geometry_msgs/msg/PoseStamped', 'cdr');
            CREATE VIEW messages AS
              WITH RECURSIVE c(x) AS (VALUES(1) UNION ALL SELECT x + 1 FROM c)
              SELECT x AS id, 1 AS topic_id, x AS timestamp, x'00' AS data FROM c;
            """
        )
    database.close()
    assert "is no ROS 2 recording" in refused(path)


def test_log_whose_formats_multiply(tmp_path: Path) -> None:
    def record(kind: str, content: bytes) -> bytes:
        return struct.pack("<HB", len(content), ord(kind)) + content

    formats = [f"f{i}:f{i + 1}[60000] x;".encode() for i in range(6)]
    path = tmp_path / "bomb.ulg"
    path.write_bytes(
        b"ULog\x01\x12\x35\x01"
        + bytes(8)
        + b"".join(record("F", text) for text in formats)
        + record("F", b"f6:uint8_t[60000] x;")
        + record("A", struct.pack("<BH", 0, 0) + b"f0")
    )
    assert "is absurd" in refused(path)


def test_log_that_ends_in_its_definitions(tmp_path: Path) -> None:
    path = tmp_path / "cut.ulg"
    path.write_bytes(b"ULog\x01\x12\x35\x01" + bytes(8) + b"\xff\xffX" + b"a" * 9)
    assert "it ends before its data" in refused(path)


def test_metadata_that_multiplies(tmp_path: Path) -> None:
    folder = making.to_ros2(making.CIRCLE, tmp_path / "b", making.StoragePlugin.MCAP, until=0.5)
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 9)]
    lines += ["rosbag2_bagfile_information: {relative_file_paths: *a8}"]
    (folder / "metadata.yaml").write_text("\n".join(lines))
    with bounded():
        inspections, errors = inspect_recordings([folder], cache=False)
    assert len(inspections) + len(errors) == 1


def test_messages_that_unpack_to_too_much_together() -> None:
    bomb = zstd().compress(bytes(100 << 20))
    with bounded(megabytes=500.0):
        block = unpacked_block(block_of([0] * 50, [bomb] * 50))
    assert int((block.end - block.start).sum()) <= MAX_CHUNK_BYTES
    few = unpacked_block(block_of([1, 2, 3], [zstd().compress(b"ab"), b"damaged", bomb[:9]]))
    assert (few.end - few.start).tolist() == [2, 0, 0]


def test_a_database_that_unpacks_to_too_much(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("tuner.recordings.ros.recording.MIN_UNPACK_LIMIT", 1 << 20)
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "x.db3.zstd").write_bytes(zstd().compress(bytes(64 << 20)))
    assert "x.db3.zstd unpacks to an absurd size" in refused(tmp_path / "b")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes there")
def test_database_whose_definitions_are_no_text(tmp_path: Path) -> None:
    path = tmp_path / "x.db3"
    with closing(sqlite3.connect(path)) as database:
        database.execute("CREATE TABLE messages (id INTEGER)")
    path.write_bytes(
        path.read_bytes().replace(b"CREATE TABLE messages (", b"CREATE TABLE messages \xff")
    )
    assert "x.db3: cannot be read" in refused(path)


@pytest.mark.parametrize("name", ["x.mcap", "x.db3.zstd"])
def test_a_pipe_in_a_folder_of_ros_2_is_not_waited_for(name: str, tmp_path: Path) -> None:
    folder = tmp_path / "b"
    folder.mkdir()
    os.mkfifo(folder / name)
    about = {"relative_file_paths": [name] * 1000}
    (folder / "metadata.yaml").write_text(json.dumps({"rosbag2_bagfile_information": about}))
    assert f"{name} is no file" in refused(folder)


def test_a_parquet_table_that_unpacks_to_too_much(tmp_path: Path) -> None:
    path = tmp_path / "bomb.parquet"
    schema = pyarrow.schema(
        [(name, pyarrow.float64()) for name in ("time", *"xyz", "qw", "qx", "qy", "qz")]
    )
    with parquet.ParquetWriter(path, schema, compression="zstd") as writer:
        zeros = pyarrow.array(np.zeros(1_000_000))
        for _ in range(8):
            writer.write_table(pyarrow.table([zeros] * len(schema), schema=schema))
    assert path.stat().st_size < 400_000
    assert "claims an absurd size" in refused(path)


def test_message_longer_than_its_chunk_or_shorter_than_its_type(tmp_path: Path) -> None:
    raw = bytearray(fuzz.FORMATS["bag"](tmp_path).read_bytes())
    at = raw.index(b"map", len(raw) // 2) - 4  # the length before a header's frame_id
    raw[at : at + 4] = b"\xff\xff\xff\xff"
    path = tmp_path / "long.bag"
    path.write_bytes(raw)
    with bounded():
        flight = load_flight(path, cache=False)
    (damage,) = flight.damage
    assert (damage.cause, damage.lost) == (Cause.MESSAGES_DAMAGED, 1)


def test_message_stamped_later_than_any_clock(tmp_path: Path) -> None:
    raw = bytearray(fuzz.FORMATS["mcap"](tmp_path).read_bytes())
    at = raw.index(struct.pack("<Q", 1_664_800_004_500_000_000)[3:]) - 3
    raw[at : at + 8] = b"\xff" * 8
    path = tmp_path / "late.mcap"
    path.write_bytes(raw[: 3 * len(raw) // 4])  # without the indexes, which hold the time as well
    with bounded():
        (inspection,), errors = inspect_recordings([path], cache=False)
    assert not errors
    assert Cause.END_MISSING in {damage.cause for damage in inspection.damage}


def test_index_of_a_chunk_that_names_other_connections() -> None:
    start = np.zeros(1, dtype=np.int64)
    with pytest.raises(DamagedError, match="points nowhere"):
        read_wanted(FileBytes(io.BytesIO(bytes(100))), Chunk(0, 100), {7: (start, start)}, [8])


def test_corrupt_numbers_warn_of_no_overflow(tmp_path: Path) -> None:
    cells = [f"{value:.9f}" for value in ways.flown()["wx"]]
    cells[700], cells[703] = "1e308", "-1e308"
    path = tmp_path / "corrupt.csv"
    path.write_text(ways.text(dict(ways.flown()) | {"wx": cells}))
    time = np.delete(np.arange(20) * 0.01, 10)
    tiny = Series(time, np.where(time > 0.05, 5e-324, 0.0)[:, None].cumsum(axis=0))
    with warnings.catch_warnings(action="error"):
        assert load_flight(path, cache=False).duration > 10.0
        assert len(with_gaps_filled(tiny).time) == 20


def test_table_with_a_line_without_end(tmp_path: Path) -> None:
    path = tmp_path / "long.csv"
    with path.open("wb") as stream:
        stream.write(b"time,x,y\n")
        for _ in range(40):
            stream.write(b"1," * (1 << 19))
    assert "long.csv: " in refused(path)


def test_table_whose_stamps_are_days_apart(tmp_path: Path) -> None:
    lines = ["time,x,y,z,qw,qx,qy,qz"]
    lines += [f"{t * 0.01},0,0,1,1,0,0,0" for t in range(500)]
    lines += ["1e300,0,0,1,1,0,0,0", "-8e9,0,0,1,1,0,0,0", "nan,0,0,1,1,0,0,0"]
    path = tmp_path / "days.csv"
    path.write_text("\n".join(lines))
    with bounded():
        flight = load_flight(path, cache=False)
    assert flight.duration == pytest.approx(5.0, abs=0.02)
    assert [note for note in flight.notes if note.code is NoteCode.FAR_IN_TIME]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes there")
def test_pipes_beside_recordings_are_not_waited_for(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    assert parameters_of(pipe) == {}
    with pytest.raises(InputError, match="cannot be read as a message definition"):
        Definitions(pipe, {}, (pipe,)).fields(f"{tmp_path.name}/msg/pipe")
    with pytest.raises(InputError, match=r"cannot be read \(it is no file\)"):
        read_static_table(pipe)
    with pytest.raises(InputError, match="is no file"):
        open_table(pipe)
