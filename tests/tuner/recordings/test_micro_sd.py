"""Crazyflie micro-SD logs: what was written is read, and what is broken is salvaged or refused."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tuner.recordings.micro_sd import log_of, write_micro_sd
from tuner.core.errors import RecordingError
from tuner.recordings.formats import open_recording
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.interpolation import body_rate_of, correlation, smooth
from tuner.recordings.loader import load_flight
from tuner.recordings.micro_sd import MicroSdRecording
from tuner.recordings.notes import Cause

REAL = Path(os.environ.get("TUNE_REAL_FLIGHTS", Path(__file__).parents[4] / "shared" / "flights"))
LEE = sorted((REAL / "crazyswarm").glob("log???"))  # log25 falls after 0.7 s in the air

RANGES = {
    "b": st.integers(-128, 127),
    "H": st.integers(0, 65_535),
    "I": st.integers(0, 2**32 - 1),
    "f": st.floats(width=32, allow_nan=False),
    "e": st.floats(width=16, allow_nan=False),
}


@st.composite
def logs(draw: st.DrawFn) -> tuple[dict[str, tuple[dict[str, str], list]], list[str], int]:
    names = draw(st.lists(st.sampled_from(["fixed", "est", "gps"]), min_size=1, unique=True))
    version = draw(st.sampled_from([1, 2]))
    stamps = st.integers(0, 2**32 - 1)
    events = {}
    for name in names:
        kinds = draw(st.lists(st.sampled_from(sorted(RANGES)), max_size=4))
        variables = {f"{name}.v{i}": kind for i, kind in enumerate(kinds)}
        row = st.tuples(stamps, st.tuples(*(RANGES[kind] for kind in kinds)))
        events[name] = (variables, draw(st.lists(row, max_size=6)))
    order = draw(st.permutations([name for name, (_, rows) in events.items() for _ in rows]))
    return events, order, version


@given(logs())
def test_what_was_written_is_read(tmp_path_factory: pytest.TempPathFactory, log: tuple) -> None:
    events, order, version = log
    path = tmp_path_factory.getbasetemp() / "log00"
    write_micro_sd(path, events, order=order, version=version)
    recording = open_recording(path)
    assert {topic.name: topic.count for topic in recording.topics} == {
        name: len(rows) for name, (_, rows) in events.items()
    }
    contents = recording.read({name: tuple(v) for name, (v, _) in events.items()})
    assert not contents.damage
    for name, (variables, rows) in events.items():
        samples = contents.samples[name]
        unit = 1_000_000 if version == 1 else 1000
        assert samples.receive.tolist() == [time * unit for time, _ in rows]
        for place, variable in enumerate(variables):
            assert samples.fields[variable].tolist() == [values[place] for _, values in rows]


def short(path: Path) -> Path:
    time = np.arange(500) / 250
    column = np.sin(time)
    return log_of(time, {"gyro.x": ("f", column), "motor.m1": ("H", 3e4 + 1e4 * column)}, path)


@pytest.mark.parametrize("lost", [1, 3, 4, 7, 100])
def test_a_log_whose_end_is_missing_is_read_up_to_there(tmp_path: Path, lost: int) -> None:
    path = short(tmp_path / "log00")
    path.write_bytes(path.read_bytes()[:-lost])
    contents = open_recording(path).read({"fixedFrequency": ("gyro.x",)})
    samples = contents.samples["fixedFrequency"]
    assert 493 < len(samples.receive) <= 500
    np.testing.assert_allclose(samples.fields["gyro.x"], np.sin(samples.receive * 1e-9), atol=1e-6)
    assert [damage.cause for damage in contents.damage] == [Cause.END_MISSING]


def test_a_log_that_its_checksum_contradicts_is_said_to_be_damaged(tmp_path: Path) -> None:
    path = short(tmp_path / "log00")
    raw = bytearray(path.read_bytes())
    raw[-12] ^= 1
    path.write_bytes(raw)
    contents = open_recording(path).read({"fixedFrequency": ("gyro.x",)})
    assert [damage.cause for damage in contents.damage] == [Cause.LOG_DAMAGED]


@pytest.mark.parametrize(
    ("header", "what"),
    [
        (struct.pack("<BHH", 0xBC, 2, 0), "0 event types"),
        (struct.pack("<BHH", 0xBC, 2, 60_000), "60000 event types"),
        (struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"a" * 5000, "a name without an end"),
        (struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"a\0\xff\xff", "65535 variables"),
        (struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"a\0\x01\0x(Z)\0", "the variable 'x'"),
        (struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"a\0\x02\0x(f)\0x(f)\0", "the variable 'x'"),
        (struct.pack("<BHHH", 0xBC, 2, 1, 7) + b"a\0", "an end inside it"),
    ],
)
def test_an_absurd_header_is_refused(tmp_path: Path, header: bytes, what: str) -> None:
    path = tmp_path / "log00"
    path.write_bytes(header)
    with pytest.raises(RecordingError, match=f"its header has {what}"):
        MicroSdRecording(path)


@pytest.mark.skipif(not LEE, reason=f"no real flights in {REAL}")
@pytest.mark.parametrize("path", LEE, ids=lambda path: path.name)
def test_real_logs_are_read_in_the_units_and_axes_of_a_flight(path: Path) -> None:
    (inspection,), errors = inspect_recordings([path], cache=False)
    assert not errors
    assert inspection.topic_map == "crazyflie_micro_sd"
    assert "drift" not in inspection.clock  # 252 Hz are no drifting 300 Hz
    flight = load_flight(path, cache=False)
    assert 4 < flight.duration < 20
    turning = smooth(body_rate_of(flight.signals["attitude"]), 0.1)
    assert correlation(turning[:, :2], smooth(flight.signals["body_rate"], 0.1)[:, :2]) > 0.7
    thrust = np.nanmedian(flight.signals["commanded_thrust"])
    assert 0.2 < thrust < 0.5  # N as commanded, of 32 to 42 g
    if flight.has("acceleration"):
        assert np.nanmedian(flight.signals["acceleration"][:, 2]) == pytest.approx(9.8, abs=0.6)
