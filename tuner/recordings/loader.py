"""A recording file into `Flight`s: each mission on its uniform clock, kept in the cache."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import logging
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tuner.core.disk import exists, readable
from tuner.core.errors import RecordingError
from tuner.recordings.cache import cached, digest, load, store
from tuner.recordings.clocks import Grid, fit_grid
from tuner.recordings.content import Content, Settings, given_map, read_content
from tuner.recordings.flight import SIGNALS, Array, Flight, InitialState, Series
from tuner.recordings.interpolation import longest_gap, resample, without_gaps
from tuner.recordings.missions import Mission, yaw_spin
from tuner.recordings.notes import Cause, Damage, Note, NoteCode
from tuner.recordings.states import initial_state
from tuner.recordings.topics import Sidecar, TopicMap, read_sidecar

#: Seconds before the mission that the series keep.
BEFORE = 2.0
#: Seconds after it within which samples still help to interpolate its end.
AFTER = 0.2
#: Longer missions, on the uniform clock, come of broken stamps.
MOST_TICKS = 2_000_000
_ABOUT = b"flights"


def make_flight(
    path: Path, content: Content, index: int, *, sha256: str, sidecar: Sidecar, rate: float
) -> Flight:
    """Put one mission of a recording on its uniform clock.

    Raises
    ------
    RecordingError
        The mission is shorter than two ticks.
    """
    mission = content.missions[index]
    series = content.series
    grid = _mission_grid(series, mission, rate)
    start = grid.tick_nearest(mission.start) if grid else mission.start
    count = math.floor((mission.end - start) * rate + 1e-6) + 1
    if count < 2:
        raise RecordingError(path, "its mission ends where it starts", "inspect the recording")
    if count > MOST_TICKS:
        what = f"its mission lasts {(mission.end - start) / 3600:.0f} h"
        raise RecordingError(path, what, "give 'start' and 'end' in a side-car")
    clock = np.arange(count) / rate
    # Beyond the last tick, so that it has a sample on either side.
    around = {name: _from_start(data, start, mission.end + AFTER) for name, data in series.items()}
    until = mission.end - start + 1e-6
    mission_series = {name: data.between(-np.inf, until) for name, data in around.items()}
    mission_series = {name: data for name, data in mission_series.items() if len(data.time)}
    ticks = dataclasses.replace(grid, origin=grid.origin - start) if grid else None
    notes = list(content.notes)
    if grid is not None and grid.drift:
        notes.append(Note(NoteCode.CLOCK_DRIFTS, "info", numbers={"drift": grid.drift}))
    if len(content.missions) > 1:
        of, number = len(content.missions), {"number": index + 1}
        notes.append(Note(NoteCode.ONE_OF_SEVERAL, "info", count=of, numbers=number))
    if not mission.fitted:
        notes.append(Note(NoteCode.NOT_CHOSEN, "info"))
    signals = {name: _on_clock(name, around[name], clock, ticks) for name in mission_series}
    notes.extend(gaps_in(signals, mission_series, rate))
    spin = yaw_spin(mission_series.get("rate_setpoint"), 0.0, float(clock[-1]))
    return Flight(
        name=path.stem if index == 0 else f"{path.stem}-{index + 1}",
        path=str(path),
        sha256=sha256,
        rate=rate,
        time=clock,
        signals=signals,
        series=mission_series,
        initial=initial_state(around),
        yaw_rate_setpoint=None if spin is None else spin.yaw_rate,
        level_held=spin is not None and spin.level_held,
        trajectory=sidecar.trajectory,
        notes=tuple(notes),
        damage=tuple(part.later(-start) for part in content.damage),
    )


def gaps_in(signals: Mapping[str, Array], series: Mapping[str, Series], rate: float) -> list[Note]:
    """Say where a signal is unknown for longer than at the ends of its recording."""
    notes = []
    for name, values in signals.items():
        if SIGNALS[name][2] == "hold":
            continue
        known = np.isfinite(values).any(axis=1)
        unknown = int((~known).sum())
        if unknown > longest_gap(series[name].time) * rate:
            edges = np.diff(np.concatenate([[0], ~known, [0]]).astype(np.int8))
            runs = np.flatnonzero(edges < 0) - np.flatnonzero(edges > 0)
            times = {"seconds": unknown / rate, "longest": float(runs.max() / rate)}
            notes.append(Note(NoteCode.SIGNAL_UNKNOWN, count=unknown, numbers=times, names=(name,)))
    return notes


def _mission_grid(series: Mapping[str, Series], mission: Mission, rate: float) -> Grid | None:
    """Fit the uniform clock to the reference or, where there is none, to the set-points."""
    for name in ("reference_position", "rate_setpoint", "thrust_setpoint"):
        if name in series:
            time = series[name].time
            near = time[(time >= mission.start - BEFORE) & (time <= mission.end)]
            grid = fit_grid(near, rate)
            if grid is not None:
                return grid
    return None


def _from_start(series: Series, start: float, end: float) -> Series:
    kept = series.between(start - BEFORE, end + 1e-6)
    return Series(kept.time - start, kept.values)


def _on_clock(signal: str, series: Series, clock: Array, grid: Grid | None) -> Array:
    if grid is not None and SIGNALS[signal][2] == "hold" and len(series.time) > 1:
        series = Series(grid.snap(series.time), series.values)
    if signal.startswith("reference_"):
        series = without_gaps(series)
    return resample(signal, series, clock)


def reading_key(
    path: Path, settings: Settings, sidecar: Sidecar, given: TopicMap | None
) -> tuple[str, ...]:
    """Return what a recording's reading depends on, beside the readers themselves."""
    messages = [digest(file) for file in given.messages if file.exists()] if given else []
    inputs = (settings.namespace, settings.rate, sidecar, given, messages)
    return (digest(path), path.name, *(repr(value) for value in inputs))


def load_flights(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
    cache: bool = True,
) -> tuple[Flight, ...]:
    """Read every mission of a recording; see `load_flight`."""
    path = Path(path)
    settings = Settings(topics, namespace, rate)
    if not exists(path):
        raise RecordingError(path, "no such file", "check the path")
    sidecar = read_sidecar(path)
    given = given_map(path, settings, sidecar)
    kept = None
    if cache:
        kept = cached("flights", *reading_key(path, settings, sidecar, given))
        content = load(kept)
        flights = from_parquet(content) if content is not None else None
        if flights is not None:
            # The same content may lie elsewhere now.
            return tuple(dataclasses.replace(flight, path=str(path)) for flight in flights)
    flights = _read_flights(path, settings, sidecar, given)
    if kept is not None:
        store(kept, to_parquet(flights))
    return flights


def _read_flights(
    path: Path, settings: Settings, sidecar: Sidecar, given: TopicMap | None
) -> tuple[Flight, ...]:
    with readable(path):
        content = read_content(path, settings, sidecar, given)
    if not content.missions:
        raise RecordingError(
            path,
            "nothing flies in it: no mission was found",
            "inspect it, or give 'start' and 'end' in a side-car",
        )
    return _flights_of(path, content, settings, sidecar)


def _flights_of(
    path: Path, content: Content, settings: Settings, sidecar: Sidecar
) -> tuple[Flight, ...]:
    sha256 = digest(path)
    return tuple(
        make_flight(path, content, i, sha256=sha256, sidecar=sidecar, rate=settings.rate)
        for i in range(len(content.missions))
    )


def keep_flights(
    path: Path, content: Content, settings: Settings, sidecar: Sidecar, given: TopicMap | None
) -> None:
    """Keep the flights of a recording that was read to be inspected: a long one takes a while.

    Parameters
    ----------
    path, settings, sidecar, given
        As of `read_content`, which returned the content.
    content
        What it holds.
    """
    kept = cached("flights", *reading_key(path, settings, sidecar, given))
    with contextlib.suppress(RecordingError):
        store(kept, to_parquet(_flights_of(path, content, settings, sidecar)))


def load_flight(
    path: str | Path,
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    rate: float = 100.0,
    mission: int = 1,
    cache: bool = True,
) -> Flight:
    """Read one mission of a recording.

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
    mission
        Which mission, from 1, of a recording that holds several.
    cache
        Keep what was read in the user's cache, and take it from there.

    Raises
    ------
    RecordingError
        The file cannot be read, or it holds no pose or no such mission.
    ConfigError
        The topic map or the side-car is wrong.
    """
    flights = load_flights(path, topics=topics, namespace=namespace, rate=rate, cache=cache)
    if not 1 <= mission <= len(flights):
        raise RecordingError(
            path, f"holds {len(flights)} missions, not {mission}", "name one of those"
        )
    return flights[mission - 1]


logger = logging.getLogger(__name__)


def to_parquet(flights: Sequence[Flight]) -> bytes:
    """Return flights as the bytes of a Parquet file."""
    import pyarrow as pa  # noqa: PLC0415 (a third of a second)
    from pyarrow import parquet  # noqa: PLC0415

    layout: list[tuple[int, str, str, int, int]] = []
    parts: list[Array] = []
    for i, flight in enumerate(flights):
        for name, values in flight.signals.items():
            layout.append((i, "signal", name, *values.shape))
            parts.append(values.ravel())
        for name, series in flight.series.items():
            layout.append((i, "series", name, *series.values.shape))
            parts += [series.time, series.values.ravel()]
    numbers = np.concatenate(parts) if parts else np.empty(0)
    about = {"flights": [_about(flight) for flight in flights], "layout": layout}
    # From the buffer itself: pyarrow's own conversion would load pandas, half a second.
    column = pa.Array.from_buffers(pa.float64(), len(numbers), [None, pa.py_buffer(numbers)])
    table = pa.Table.from_arrays(
        [column], names=["values"], metadata={_ABOUT: json.dumps(about).encode()}
    )
    sink = io.BytesIO()
    parquet.write_table(table, sink, compression="zstd", use_dictionary=False)
    return sink.getvalue()


def from_parquet(content: bytes) -> tuple[Flight, ...] | None:
    """Return the flights in a Parquet file made by `to_parquet`; None if it is damaged."""
    from pyarrow import parquet  # noqa: PLC0415

    try:
        # not `read_table`, whose data sets load pandas
        table = parquet.ParquetFile(io.BytesIO(content)).read(use_threads=False)
        about = json.loads(table.schema.metadata[_ABOUT])
        numbers = np.array(np.from_dlpack(table.column("values").combine_chunks()))
        signals: list[dict[str, Array]] = [{} for _ in about["flights"]]
        series: list[dict[str, Series]] = [{} for _ in about["flights"]]
        at = 0
        for i, kind, name, rows, columns in about["layout"]:
            time = numbers[at : at + rows] if kind == "series" else numbers[at:at]
            at += len(time)
            values = numbers[at : at + rows * columns].reshape(rows, columns)
            at += rows * columns
            if kind == "signal":
                signals[i][name] = values
            else:
                series[i][name] = Series(time, values)
        return tuple(
            _flight(details, columns_of_flight, raw)
            for details, columns_of_flight, raw in zip(
                about["flights"], signals, series, strict=True
            )
        )
    except Exception as err:  # a damaged cache is read anew, whatever is wrong with it
        logger.info("a cached flight is damaged: %s", err)
        return None


def _about(flight: Flight) -> dict[str, Any]:
    return {
        "name": flight.name,
        "path": flight.path,
        "sha256": flight.sha256,
        "rate": flight.rate,
        "count": len(flight.time),
        "initial": {
            field.name: getattr(flight.initial, field.name).tolist()
            for field in dataclasses.fields(flight.initial)
        },
        "yaw_rate_setpoint": flight.yaw_rate_setpoint,
        "level_held": flight.level_held,
        "trajectory": flight.trajectory,
        "notes": [dataclasses.asdict(note) for note in flight.notes],
        "damage": [dataclasses.asdict(damage) for damage in flight.damage],
    }


def _flight(
    about: Mapping[str, Any], signals: Mapping[str, Array], series: Mapping[str, Series]
) -> Flight:
    return Flight(
        name=about["name"],
        path=about["path"],
        sha256=about["sha256"],
        rate=about["rate"],
        time=np.arange(about["count"]) / about["rate"],
        signals=signals,
        series=series,
        initial=InitialState(
            **{name: np.array(values) for name, values in about["initial"].items()}
        ),
        yaw_rate_setpoint=about["yaw_rate_setpoint"],
        level_held=about["level_held"],
        trajectory=about["trajectory"],
        notes=tuple(Note.read(note) for note in about["notes"]),
        damage=tuple(
            Damage(**{**damage, "cause": Cause(damage["cause"])}) for damage in about["damage"]
        ),
    )
