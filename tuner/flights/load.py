"""A recording file into a `Flight`: read, map, clean, find the mission, resample."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np

from tuner.errors import RecordingError
from tuner.flights.clean import clean
from tuner.flights.clock import Grid, fit_grid
from tuner.flights.extract import Raw, extract, locate, require_pose
from tuner.flights.flight import SIGNALS, Array, Flight, Note, Series
from tuner.flights.initial import initial_state
from tuner.flights.mission import mission_span, yaw_spin
from tuner.flights.recording import Recording, digest
from tuner.flights.resample import resample
from tuner.flights.topics import TopicMap, load_topic_map, shipped_maps

logger = logging.getLogger(__name__)

#: Seconds before the mission that the series keep.
BEFORE = 2.0


def load_flight(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
) -> Flight:
    """Read the mission of a recording.

    Parameters
    ----------
    path
        The recording.
    topics
        Topic map, its file, or the name of a shipped one; None takes the shipped map that finds
        most signals.
    namespace
        Prefix of the recorded topics that the map does not have, as ``uav1``.
    rate
        Hz of the uniform clock.

    Raises
    ------
    RecordingError
        The file cannot be read, or it holds no pose or no mission.
    ConfigError
        The topic map is wrong.
    """
    path = Path(path)
    recording = open_recording(path)
    chosen, note = _choose_map(recording, topics, namespace)
    places = locate(recording, chosen)
    require_pose(recording, chosen, places)
    raw, notes = extract(recording, places)
    return _flight(path, raw, (note, *notes), rate)


def open_recording(path: Path) -> Recording:
    """Open a recording with the reader of its format."""
    if not path.exists():
        raise RecordingError(path, "no such file", "check the path")
    if path.suffix == ".bag":
        from tuner.flights.ros1 import Ros1Bag  # noqa: PLC0415 (each format's library on demand)

        return Ros1Bag(path)
    raise RecordingError(path, f"unknown kind of recording '{path.suffix}'", "known are .bag")


def _choose_map(
    recording: Recording, topics: str | Path | TopicMap | None, namespace: str
) -> tuple[TopicMap, Note]:
    if topics is not None:
        chosen = topics if isinstance(topics, TopicMap) else load_topic_map(topics)
        chosen = chosen.under(namespace)
    else:
        suited = [m.under(namespace) for m in shipped_maps() if m.format == recording.format]
        chosen = max(suited, key=lambda candidate: len(locate(recording, candidate)))
    found = len(locate(recording, chosen))
    return chosen, Note("info", "", f"topic map '{chosen.name}' finds {found} signals", found)


def _flight(path: Path, raw: dict[str, Raw], notes: tuple[Note, ...], rate: float) -> Flight:
    epoch = int(raw["position"].time[0])
    series = {}
    said = list(notes)
    for signal, data in raw.items():
        seconds = np.asarray((data.time - epoch) * 1e-9, dtype=np.float64)
        time, values, found = clean(signal, data.topic, seconds, data.values)
        said.extend(found)
        if len(time):
            series[signal] = Series(time, values)
    for needed in ("position", "attitude"):
        if needed not in series:
            topic = raw[needed].topic if needed in raw else needed
            raise RecordingError(path, f"no usable {needed} in {topic}", "inspect the recording")

    start, end = mission_span(series)
    grid = _mission_grid(series, rate)
    start = grid.tick_nearest(start) if grid else start
    count = int(np.floor((end - start) * rate + 1e-6)) + 1
    if count < 2:
        raise RecordingError(path, "no mission in it: it ends where it starts", "inspect it")
    clock = np.arange(count) / rate
    series = {name: _from_start(data, start, end) for name, data in series.items()}
    ticks = Grid(grid.origin - start, rate, grid.drift, grid.spread) if grid else None
    return Flight(
        name=path.stem,
        path=str(path),
        sha256=digest(path),
        rate=rate,
        time=clock,
        signals={name: _on_clock(name, data, clock, ticks) for name, data in series.items()},
        series=series,
        initial=initial_state(series),
        yaw_rate_setpoint=(
            yaw_spin(series["rate_setpoint"], 0.0, end - start)
            if "rate_setpoint" in series
            else None
        ),
        notes=tuple(said),
    )


def _mission_grid(series: dict[str, Series], rate: float) -> Grid | None:
    """Fit the uniform clock to the reference or, where there is none, to the set-points."""
    for name in ("reference_position", "rate_setpoint", "thrust_setpoint"):
        if name in series:
            grid = fit_grid(series[name].time, rate)
            if grid is not None:
                return grid
    return None


def _from_start(series: Series, start: float, end: float) -> Series:
    kept = (series.time >= start - BEFORE) & (series.time <= end + 1e-6)
    return Series(series.time[kept] - start, series.values[kept])


def _on_clock(signal: str, series: Series, clock: Array, grid: Grid | None) -> Array:
    if grid is not None and SIGNALS[signal][2] == "hold" and len(series.time) > 1:
        series = Series(grid.snap(series.time), series.values)
    return resample(signal, series, clock)
