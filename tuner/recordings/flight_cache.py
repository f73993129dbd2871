"""Flights as Parquet: all numbers in one column, their layout and the rest in the metadata."""

from __future__ import annotations

import dataclasses
import io
import json
import logging
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tuner.recordings.damage import Cause, Damage
from tuner.recordings.flight import Array, Flight, InitialState, Series
from tuner.recordings.notes import Note

logger = logging.getLogger(__name__)

_ABOUT = b"flights"


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
