"""What a long run shows: a moving line on a terminal, plain lines when piped, tables at the end."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.table import Table

from tuner.cli.tables import console

if TYPE_CHECKING:
    from tuner.config import Settings
    from tuner.job.cross_validation import Fold
    from tuner.job.run import Listener
    from tuner.job.sensitivity import SensitivityResult
    from tuner.result import RunResult

AXES = ("x", "y", "z", "roll", "pitch", "yaw")


@contextmanager
def listening(*, quiet: bool) -> Iterator[Listener]:
    """Yield a listener that shows a run on the terminal, or nothing."""
    from tuner.job.run import SILENT, Listener

    if quiet:
        yield SILENT
        return
    screen, began = console(), time.perf_counter()
    live = screen.status("reading the flights") if screen.is_terminal else None
    if live is not None:
        live.start()

    def settled(settings: Settings) -> None:
        for name, origin in settings.origin.items():
            screen.print(f"{name}: {origin}")

    def iteration(  # noqa: PLR0917 (a listener's)
        stage: str, number: int, horizon: float, loss: float, rmse: float, left: float
    ) -> None:
        seconds = time.perf_counter() - began
        rest = "" if math.isnan(left) else f", some {left:.0f} s left"
        line = (
            f"{stage}: iteration {number}, horizon {horizon:.3g} s, position RMSE "
            f"{1000 * rmse:.2f} mm, loss {loss:.4g}, {seconds:.0f} s so far{rest}"
        )
        if live is None:
            screen.print(line)
        else:
            live.update(line)

    try:
        yield Listener(settled, iteration, screen.print, lambda folds: screen.print(_folds(folds)))
    finally:
        if live is not None:
            live.stop()


def print_run(folder: Path, result: RunResult) -> None:
    """Print the coefficients, the RMSE before and after, and where everything lies."""
    from tuner.wording.status import ending_sentence

    screen = console()
    screen.print(_coefficients(result))
    screen.print(_errors(result))
    search = result.search
    screen.print(
        f"{ending_sentence(search.message)} It took {search.evaluations} Jacobians and "
        f"{search.wall_time:.0f} s."
    )
    screen.print(
        f"written to {folder}/ (report.html, best_fit.yaml, result.json, metrics.csv, "
        "sensitivity.csv)",
        markup=False,
    )


def print_examined(found: SensitivityResult) -> None:
    """Print what is known of each coefficient, what to fly next, and where everything lies."""
    from tuner.wording.findings import one_line
    from tuner.wording.proposals import proposals_in_words
    from tuner.wording.verdicts import direction_in_words, judgement_in_words

    screen = console()
    table = Table(box=None, title="Coefficients", title_justify="left")
    table.add_column("coefficient")
    for name in ("value", "±", "unit"):
        table.add_column(name, justify="left" if name == "unit" else "right")
    table.add_column("+1 % moves position by")
    table.add_column("how well it is known")
    for name, one in found.knowledge.coefficients.items():
        error = "" if one.std_error is None else f"{one.std_error:.2g}"
        label = name if one.fitted else f"{name} (fixed)"
        told = judgement_in_words(one.verdict, one.reason)
        table.add_row(label, f"{one.value:.5g}", error, one.unit, _moves(found, name), told)
    screen.print(table)
    for finding in found.findings:
        screen.print(one_line(finding), markup=False)
    for direction in found.knowledge.directions[:1]:
        screen.print(f"Worst determined: {direction_in_words(direction)}")
    for sentence in proposals_in_words(found.proposals) if found.proposals else ():
        screen.print(sentence)
    screen.print(f"written to {found.folder}/ (report.html, sensitivity.csv, correlation.csv, …)")


def _moves(found: SensitivityResult, name: str) -> str:
    """Return the largest RMS change of a position axis, and where."""
    changes = [
        (output.change[name], output.axis, output.flight)
        for output in found.knowledge.outputs
        if output.channel == "position" and name in output.change
    ]
    if not changes:
        return ""
    change, axis, flight = max(changes)
    return f"{1000 * change:.3g} mm ({axis}, {flight})"


def _coefficients(result: RunResult) -> Table:
    table = Table(box=None, title="Coefficients", title_justify="left")
    table.add_column("coefficient")
    for name in ("initial", "best", "±", "unit"):
        table.add_column(name, justify="left" if name == "unit" else "right")
    table.add_column("how well it is known")
    for name, one in result.coefficients.items():
        error = "" if one.std_error is None else f"{one.std_error:.2g}"
        table.add_row(name, f"{one.initial:.5g}", f"{one.best:.5g}", error, one.unit, one.note)
    return table


def _errors(result: RunResult) -> Table:
    table = Table(box=None, title="RMSE before → after", title_justify="left")
    table.add_column("flight")
    for axis in AXES:
        unit = "m" if axis in ("x", "y", "z") else "deg"
        table.add_column(f"{axis} {unit}", justify="right")
    for flight in result.flights:
        cells = []
        for axis in AXES:
            before, after = getattr(flight.rmse_initial, axis), getattr(flight.rmse_best, axis)
            cells.append(f"{_number(before)} → {_number(after)}")
        held = " (held out)" if flight.split == "holdout" else ""
        table.add_row(flight.name + held, *cells)
    return table


def _folds(folds: Sequence[Fold]) -> Table:
    table = Table(box=None, title="Each flight predicted by the others", title_justify="left")
    table.add_column("left out")
    for axis in AXES:
        unit = "m" if axis in ("x", "y", "z") else "deg"
        table.add_column(f"{axis} {unit}", justify="right")
    for fold in folds:
        cells = [
            "impossible" if fold.rmse is None else _number(getattr(fold.rmse, axis))
            for axis in AXES
        ]
        table.add_row(fold.left_out, *cells)
    return table


def _number(value: float | None) -> str:
    return "crash" if value is None else f"{value:.4f}" if value < 0.1 else f"{value:.3f}"
