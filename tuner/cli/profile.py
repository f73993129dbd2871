"""The files of ``tune --profile``: a table by stage, and a trace for Perfetto."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tuner.core.disk import write_text
from tuner.core.files import csv_text
from tuner.core.phrases import listed
from tuner.core.spans import JAX_STAGES, Recorder, Row, Span, beside_of, recording, table_of
from tuner.report.section import Table

TABLE_FILE = "profile.csv"
TRACE_FILE = "profile.json"
_MICRO = 1e6
_HERE, _BESIDE = 1, 2
"""Rows of the trace: this process's main thread, and other processes."""


@contextmanager
def profiling(wanted: bool, *, quiet: bool) -> Iterator[Callable[[Path], None]]:
    """Yield what takes the result folder that a profile of the block is written into, if wanted.

    The table is printed, too, unless ``quiet``.
    """
    folders: list[Path] = []
    if not wanted:
        yield folders.append
        return
    with recording() as recorder:
        yield folders.append
    seconds, processor = recorder.now(), time.process_time()
    rows = table_of(recorder.spans, seconds, processor)
    for folder in folders:
        cells = (
            (row.stage, *(f"{value:.3f}" for value in _seconds(row)), row.programs) for row in rows
        )
        write_text(folder / TABLE_FILE, csv_text(_HEADER, cells))
        write_text(folder / TRACE_FILE, json.dumps(trace_of(recorder.spans)))
        if not quiet:
            _print(rows, recorder, folder)


_COLUMNS = ("seconds", "processor", *JAX_STAGES.values(), "rest")
_HEADER = ("stage", *(f"{name} [s]" for name in _COLUMNS), "programs")


def _seconds(row: Row) -> tuple[float, ...]:
    return (row.seconds, row.processor, *row.jax.values(), row.rest)


def trace_of(spans: Sequence[Span]) -> dict[str, Any]:
    """Return spans in Chrome's trace format, which Perfetto reads: complete events, in µs."""
    names = {_HERE: "tune", _BESIDE: "beside it"}
    return {
        "displayTimeUnit": "ms",
        "traceEvents": [
            *(
                {"ph": "M", "name": "thread_name", "pid": 1, "tid": tid, "args": {"name": name}}
                for tid, name in names.items()
            ),
            *(
                {
                    "ph": "X",
                    "name": f"{span.name} {span.detail}".strip(),
                    "cat": "stage" if span.is_stage else span.name,
                    "pid": 1,
                    "tid": _BESIDE if span.beside else _HERE,
                    "ts": round(span.begin * _MICRO),
                    "dur": round(span.end * _MICRO) - round(span.begin * _MICRO),
                }
                for span in sorted(spans, key=lambda span: (span.begin, -span.end))
            ),
        ],
    }


def _print(rows: Sequence[Row], recorder: Recorder, folder: Path) -> None:
    from tuner.cli.results import console, rich_table

    screen = console()
    screen.print(rich_table(_table(rows)))
    beside = {name: f"{spent:.1f}" for name, spent in beside_of(recorder.spans).items()}
    parts = [f"{name} {seconds} s" for name, seconds in beside.items() if float(seconds)]
    if parts:
        screen.print(f"Beside it, by other threads and processes: {listed(parts)}.")
    for program in recorder.fallbacks:
        screen.print(f"Through XLA, not as a kernel: {program}.")
    screen.print(f"profile: {folder / TABLE_FILE}, {folder / TRACE_FILE}")


def _table(rows: Sequence[Row]) -> Table:
    columns = ("stage", *_COLUMNS, "programs")
    cells = [
        (
            row.stage,
            *(f"{value:.1f}" if value >= 0.05 else "" for value in _seconds(row)),
            str(row.programs or ""),
        )
        for row in rows
    ]
    sums = (f"{sum(column):.1f}" for column in zip(*map(_seconds, rows), strict=True))
    cells.append(("all", *sums, str(sum(row.programs for row in rows))))
    return Table(columns, cells, words=("stage",), fold="Where the seconds went")
