"""What a long run shows while it works: a moving line on a terminal, one line a stage elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tuner.cli.tables import console, print_settings

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from tuner.job.listener import Listener
    from tuner.search.iteration import Iteration
    from tuner.search.point_estimate import PointEstimate


SEARCHED = (
    "The search ended here. Which terms the flights call for, how far each value can be trusted, "
    "and how well held-out flights are predicted, follows."
)


@contextmanager
def listening(*, quiet: bool) -> Iterator[Listener]:
    """Yield a listener that shows a run on the terminal, or nothing."""
    from tuner.cli.results import estimates_table, folds_table
    from tuner.job.listener import SILENT, Listener

    if quiet:
        yield SILENT
        return
    screen = console()
    search = _MovingLine(screen) if screen.is_terminal else _StageLines(screen)

    def show_estimates(estimates: Sequence[PointEstimate]) -> None:
        search.table(estimates_table(estimates))
        search.message(SEARCHED)

    try:
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
    """One line at the foot of a terminal, written anew at each iteration."""

    def __init__(self, screen: Console) -> None:
        self._began = time.perf_counter()
        self._screen = screen
        self._status = screen.status("Reading the flights.")
        self._status.start()

    def show(self, iteration: Iteration, left: float) -> None:
        rest = "" if math.isnan(left) else f", about {left:.0f} s left"
        self._status.update(_line(iteration, time.perf_counter() - self._began) + rest)

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
            line = _line(self._last, time.perf_counter() - self._began)
            self._screen.print(line, markup=False, soft_wrap=True)
        self._last = None


def _line(iteration: Iteration, seconds: float) -> str:
    rmse = iteration.position_rmse
    position = "" if rmse is None else f"position RMSE {1000 * rmse:.2f} mm, "
    return (
        f"{iteration.stage}: iteration {iteration.number}, horizon {iteration.horizon:.3g} s, "
        f"{position}loss {iteration.loss:.4g}, {seconds:.0f} s so far"
    )
