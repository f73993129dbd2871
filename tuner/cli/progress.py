"""Progress of a run: a live line on a terminal, one line per stage elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

from rich.text import Text

from tuner.cli.results import console
from tuner.core.phrases import as_sentence
from tuner.core.spans import watching

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
    from tuner.cli.results import WIDTH, estimates_table, folds_table
    from tuner.findings.findings import shorten_finding
    from tuner.search.listener import SILENT, Listener

    if quiet:
        yield SILENT
        return
    screen = console()
    search = _LiveLine(screen) if screen.is_terminal else _StageLines(screen)

    def show_estimates(estimates: Sequence[PointEstimate]) -> None:
        search.table(estimates_table(estimates))
        search.line(SEARCH_ENDED)

    def show_settings(settings: Settings) -> None:
        for name, origin in settings.origin.items():
            search.line(f"{name}: {origin}")

    shown = Listener(
        on_iteration=lambda iteration, _: search.show(iteration),
        on_doubt=lambda finding: search.line(f"! {shorten_finding(finding, WIDTH - 2)}"),
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
