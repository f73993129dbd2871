"""A recording format is two places: a reader and a topic map, here both made for the test."""

from __future__ import annotations

import importlib
from pathlib import Path

import numpy as np
import pytest

from tests.tuner.recordings import making
from tuner.recordings import formats
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.loader import load_flight

MODULE = '''
"""NumPy's structured arrays as recordings."""

import numpy as np

from tuner.recordings.formats import Reader
from tuner.recordings.recording import TABLE_TOPIC, ReadResult, TabularRecording, TopicSamples


class StructuredArray(TabularRecording):
    def __init__(self, path):
        self._rows = np.load(path)
        super().__init__(path, "numpy", self._rows.dtype.names)

    def read(self, wanted, clocks=()):
        clock = self.clock(clocks)
        time = (self._rows[clock.field] * clock.nanoseconds).astype(np.int64)
        fields = {name: self._rows[name].astype(float) for name in wanted[TABLE_TOPIC]}
        return ReadResult({TABLE_TOPIC: TopicSamples(time, time, fields)})


READER = Reader(
    "numpy",
    ".npy",
    lambda path, start: start.startswith(b"\\x93NUMPY"),
    lambda path, _: StructuredArray(path),
    tabular=True,
)
'''

TOPIC_MAP = """
name: structured
format: numpy
time: {field: time, unit: ns}
signals:
  position: [x, y, z]
  attitude: [qw, qx, qy, qz]
  rotor_speed: {fields: [rpm], rotor: rotor, unit: rpm}
  battery_voltage: voltage
"""


def test_a_new_format_is_read_all_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "structured_array_reader.py").write_text(MODULE)
    monkeypatch.syspath_prepend(tmp_path)
    reader = importlib.import_module("structured_array_reader").READER
    monkeypatch.setattr(formats, "READERS", (*formats.READERS, reader))
    (tmp_path / "map.yaml").write_text(TOPIC_MAP)
    names = ("time", "x", "y", "z", "qw", "qx", "qy", "qz", "rpm", "rotor")
    rows = making.to_frame(making.CIRCLE)[list(names)].to_records(index=False)
    path = tmp_path / "circle.npy"
    np.save(path, np.array(rows))

    flight = load_flight(path, topics=tmp_path / "map.yaml")
    original = load_flight(making.CIRCLE)
    assert not flight.has("battery_voltage")  # no such column
    for name in ("position", "attitude", "rotor_speed"):
        read, known = (f.series[name].values[:, 0] for f in (flight, original))
        assert len(read) > 0.9 * len(known)
        assert np.isin(read, known).mean() > 0.9  # the mission may begin and end elsewhere
    (inspection,), errors = inspect_recordings([path], topics=tmp_path / "map.yaml", cache=False)
    assert (inspection.format, errors) == ("numpy", ())
    assert inspection.missions
