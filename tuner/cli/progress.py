"""Progress of a run, live on a terminal or a line for each stage, and the files of ``--profile``.

A profile is a table by stage, and a trace for Perfetto.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.text import Text

from tuner.cli.results import console
from tuner.core.disk import write_text
from tuner.core.files import csv_text
from tuner.core.phrases import as_sentence, listed
from tuner.core.spans import (
    JAX_STAGES,
    Recorder,
    Span,
    StageTime,
    beside_of,
    recording,
    stage_table,
    watching,
)
from tuner.report.section import Table

if TYPE_CHECKING:
    from rich.console import Console

    from tuner.config import Settings
    from tuner.search.listener import Iteration, Listener, PointEstimate


SEARCH_ENDED = (
    "The search ended here. Which terms the flights call for, how far each value can be trusted, "
    "and how well held-out flights are predicted, follows."
)


STARTING = "Starting"
STAGE_PHRASES = {
    "reading": "Reading the flights",
    "check": "Checking the flights, and compiling their simulation",
    "search": "Searching, and compiling its first steps",
    "selection of terms": "Trying terms beyond the motor model",
    "disturbances": "Estimating what disturbed the flights",
    "examination": "Examining how well each coefficient is known",
    "validation": "Simulating each flight",
    "cross-validation": "Fitting without each flight in turn",
    "bootstrap": "Fitting to flights drawn with replacement",
    "ground measurements": "Comparing flights with ground measurements",
    "results": "Writing the results",
    "effective coefficients": "Looking for effective coefficients",
    "what to log": "Looking for what to log next time",
    "knowledge": "Writing how well each coefficient is known",
    "next flight": "Simulating what could be flown next",
    "exports": "Exporting",
    "page": "Drawing the page",
}
"""Stage of a run, as `tuner.core.spans` has it -> its description."""


@contextmanager
def progress_on_terminal(*, quiet: bool, verbose: bool = False) -> Iterator[Listener]:
    """Yield a listener that shows a run on the terminal, or nothing; each message if verbose."""
    from tuner.cli.results import estimates_table, folds_table, line_width
    from tuner.findings.findings import shorten_finding
    from tuner.search.listener import SILENT, Listener

    if quiet:
        yield SILENT
        return
    screen = console()
    width = line_width(screen) - 2
    search = _LiveLine(screen) if screen.is_terminal else _StageLines(screen)

    def show_estimates(estimates: Sequence[PointEstimate]) -> None:
        search.table(estimates_table(estimates))
        search.line(SEARCH_ENDED)

    def show_settings(settings: Settings) -> None:
        for name, origin in settings.origin.items():
            search.line(f"{name}: {origin}")

    shown = Listener(
        on_iteration=lambda iteration, _: search.show(iteration),
        on_doubt=lambda finding: search.line(f"! {shorten_finding(finding, width)}"),
        on_stop=search.line,
    )
    if verbose:
        shown = replace(
            shown,
            on_settings=show_settings,
            on_doubt=lambda _: None,  # which all messages hold
            on_estimates=show_estimates,
            on_message=search.line,
            on_folds=lambda folds: search.table(folds_table(folds)),
        )
    try:
        with watching(search.stage):
            yield shown
    finally:
        search.close()


class _LiveLine:
    """One line at the foot of a terminal: what runs now, and for how long.

    How long it will still take depends on what the flights call for, and is not said.
    """

    def __init__(self, screen: Console) -> None:
        self._began = time.perf_counter()
        self._screen = screen
        self._doing = STARTING
        self._status = screen.status(self)
        self._status.start()

    def __rich__(self) -> Text:
        return Text(f"{self._doing}, {time.perf_counter() - self._began:.0f} s so far")

    def stage(self, name: str) -> None:
        self._doing = STAGE_PHRASES.get(name, as_sentence(name)) if name else STARTING

    def show(self, iteration: Iteration) -> None:
        self._doing = _iteration(iteration)

    def line(self, text: str) -> None:
        self._screen.print(text)

    def table(self, table: object) -> None:
        self._screen.print(table)

    def close(self) -> None:
        self._status.stop()


class _StageLines:
    """One line for each stage: printed as it begins, that of a search with its last iteration."""

    def __init__(self, screen: Console) -> None:
        self._began = time.perf_counter()
        self._screen = screen
        self._named: set[str] = set()
        self._last: Iteration | None = None

    def stage(self, name: str) -> None:
        if name in STAGE_PHRASES and name not in self._named:
            self._named.add(name)
            self.line(STAGE_PHRASES[name])

    def show(self, iteration: Iteration) -> None:
        self._last = iteration

    def line(self, text: str) -> None:
        self.close()
        seconds = time.perf_counter() - self._began
        self._screen.print(f"{seconds:5.0f} s  {text}", soft_wrap=True)

    def table(self, table: object) -> None:
        self.close()
        self._screen.print(table)

    def close(self) -> None:
        last, self._last = self._last, None
        if last is not None:
            self.line(f"Searched: {_iteration(last)}")


def _iteration(iteration: Iteration) -> str:
    rmse = iteration.position_rmse
    position = "" if rmse is None else f"position RMSE {1000 * rmse:.2f} mm, "
    return (
        f"{iteration.stage}: iteration {iteration.number}, horizon {iteration.horizon:.3g} s, "
        f"{position}loss {iteration.loss:.4g}"
    )


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
    rows = stage_table(recorder.spans, seconds, processor)
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


def _seconds(row: StageTime) -> tuple[float, ...]:
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


def _print(rows: Sequence[StageTime], recorder: Recorder, folder: Path) -> None:
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


def _table(rows: Sequence[StageTime]) -> Table:
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
