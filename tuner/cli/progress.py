"""What a long run shows while it works: a moving line on a terminal, one line a stage elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.text import Text

from tuner.cli.tables import console, print_settings
from tuner.core.spans import watching
from tuner.wording.phrases import as_sentence

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tuner.search.iteration import Iteration
    from tuner.search.listener import Listener
    from tuner.search.point_estimate import PointEstimate


SEARCHED = (
    "The search ended here. Which terms the flights call for, how far each value can be trusted, "
    "and how well held-out flights are predicted, follows."
)


STARTING = "Starting"
DOING = {
    "reading": "Reading the flights",
    "check": "Checking the flights, and compiling their simulation",
    "search": "Searching, and compiling its first steps",
    "selection of terms": "Trying terms beyond the motor model",
    "disturbances": "Estimating what disturbed the flights",
    "examination": "Examining how well each coefficient is known",
    "balance": "Balancing the recorded motion and the rotor speeds",
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
"""Stage of a run, as `tuner.core.spans` has it -> what is done in it."""


@contextmanager
def listening(*, quiet: bool) -> Iterator[Listener]:
    """Yield a listener that shows a run on the terminal, or nothing."""
    from tuner.cli.results import estimates_table, folds_table
    from tuner.search.listener import SILENT, Listener

    if quiet:
        yield SILENT
        return
    screen = console()
    search = _MovingLine(screen) if screen.is_terminal else _StageLines(screen)

    def show_estimates(estimates: Sequence[PointEstimate]) -> None:
        search.table(estimates_table(estimates))
        search.message(SEARCHED)

    try:
        with watching(search.stage):
            yield Listener(
                on_settings=lambda settings: print_settings(settings, screen),
                on_iteration=search.show,
                on_estimates=show_estimates,
                on_message=search.message,
                on_folds=lambda folds: search.table(folds_table(folds)),
            )
    finally:
        search.close()


class _MovingLine:
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
        self._doing = DOING.get(name, as_sentence(name)) if name else STARTING

    def show(self, iteration: Iteration, _left: float) -> None:
        self._doing = _iteration(iteration)

    def message(self, text: str) -> None:
        self._screen.print(text, markup=False)

    def table(self, table: Table) -> None:
        self._screen.print(table)

    def close(self) -> None:
        self._status.stop()


class _StageLines:
    """One line for each stage of the search, printed when the stage has ended."""

    def __init__(self, screen: Console) -> None:
        self._began = time.perf_counter()
        self._screen = screen
        self._last: Iteration | None = None

    def stage(self, _name: str) -> None:
        """Nothing: what is done next is a message, and a stage is printed at its end."""

    def show(self, iteration: Iteration, _left: float) -> None:
        if self._last is not None and self._last.stage != iteration.stage:
            self.close()
        self._last = iteration

    def message(self, text: str) -> None:
        self.close()
        self._screen.print(text, markup=False, soft_wrap=True)

    def table(self, table: Table) -> None:
        self.close()
        self._screen.print(table)

    def close(self) -> None:
        if self._last is not None:
            seconds = time.perf_counter() - self._began
            line = f"{_iteration(self._last)}, {seconds:.0f} s so far"
            self._screen.print(line, markup=False, soft_wrap=True)
        self._last = None


def _iteration(iteration: Iteration) -> str:
    rmse = iteration.position_rmse
    position = "" if rmse is None else f"position RMSE {1000 * rmse:.2f} mm, "
    return (
        f"{iteration.stage}: iteration {iteration.number}, horizon {iteration.horizon:.3g} s, "
        f"{position}loss {iteration.loss:.4g}"
    )
