"""What becomes of one flight in each of the ways in which people write it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.tuner.flights import ways
from tuner.errors import RecordingError
from tuner.flights import Flight, load_flight
from tuner.flights.notes import NoteCode
from tuner.wording.notes import note_in_words

COLUMNS = {
    "position": ("x", "y", "z"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "body_rate": ("wx", "wy", "wz"),
    "acceleration": ("ax", "ay", "az"),
    "rotor_speed": tuple(f"rotor_speed_{i}" for i in range(1, 5)),
    "command": tuple(f"command_{i}" for i in range(1, 5)),
}


def assert_same(flight: Flight, signals: tuple[str, ...] = tuple(COLUMNS)) -> None:
    """Check that a flight holds what was flown, to the digits that were written."""
    truth = ways.flown()
    assert flight.duration == pytest.approx(14.0, abs=0.05)
    for name in signals:
        expected = np.column_stack([truth[column] for column in COLUMNS[name]])
        got = flight.series[name]
        again = np.column_stack(
            [np.interp(truth["time"], got.time, column) for column in got.values.T]
        )
        size = np.abs(expected).max()
        inside = slice(5, -5)
        assert np.abs(again - expected)[inside].max() < 2e-3 * size, name


def read(folder: Path, content: str) -> Flight:
    path = folder / "flight.csv"
    path.write_text(content)
    return load_flight(path)


@pytest.mark.parametrize("way", ways.TIMES)
def test_time_in(way: str, tmp_path: Path) -> None:
    flight = read(tmp_path, ways.with_time(ways.TIMES[way]))
    assert_same(flight)
    said = [note_in_words(n) for n in flight.notes if n.code is NoteCode.UNIT_READ]
    unit = way.split(" ", maxsplit=1)[0]
    told = unit in ("milliseconds", "microseconds", "nanoseconds")
    assert said == ([f"time is in {unit}, which the topic map does not say: read so"] * told)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: [f"{(v + ways.EPOCH) * 1e-9:.6e}" for v in t], "has too few digits"),
        (lambda t: [f"{(v + ways.EPOCH) * 1e-9:.0f}" for v in t], "has too few digits"),
        (lambda t: [f"day {v}" for v in t], "neither a number nor a date"),
        (lambda t: t * 1e3, "no step of a flight"),
    ],
)
def test_time_that_cannot_be_told_is_named(change, message: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=message) as caught:
        read(tmp_path, ways.with_time(change))
    assert "\n" not in str(caught.value)


def test_quick_microseconds_are_no_slow_milliseconds(tmp_path: Path) -> None:
    """At 4 kHz their step is that of milliseconds at 4 Hz; gravity knows better."""
    truth = ways.flown()
    fine = np.arange(0.0, 14.0, 1 / 4000)
    names = (*COLUMNS["position"], *COLUMNS["attitude"])
    columns = {name: np.interp(fine, truth["time"], truth[name]) for name in names}
    table = {"time": np.rint(1e6 * fine), **columns}
    flight = read(tmp_path, ways.text(table, digits=6))
    assert_same(flight, ("position", "attitude"))
    assert NoteCode.TIME_READ in {note.code for note in flight.notes}
