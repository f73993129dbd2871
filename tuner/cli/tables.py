"""Results as tables on the terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.table import Table as DrawnTable
from rich.text import Text

from tuner.core.phrases import printable
from tuner.evaluate.records import RMSE_UNITS
from tuner.report.section import Cell, Table

if TYPE_CHECKING:
    from tuner.config import Settings
    from tuner.evaluate.records import Row
    from tuner.evaluate.records import Table as Comparison
    from tuner.evaluate.simulation_files import Summary
    from tuner.exporters.export import Exported
    from tuner.vehicle.scaling_laws import Estimate


#: Columns that a table may take, if need be beyond the terminal's, so that no number is cut.
WIDTH = 140


class _Screen(Console):
    """A terminal on which a text that others wrote is a text, neither markup nor control codes."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


def console(width: int = WIDTH) -> Console:
    """Return a console of at least so many columns, so that no number is cut."""
    fitting = _Screen(highlight=False, markup=False)
    if fitting.width >= width:
        return fitting
    return _Screen(highlight=False, markup=False, width=width)


STYLE_OF_LOOK = {
    "well": "green",
    "weak": "yellow",
    "not": "red",
    "worse": "red",
    "failure": "red",
    "best": "bold",
}
"""Class of the page's style -> of the terminal's."""


def rich_table(table: Table) -> DrawnTable:
    """Return a table as the terminal draws it: words on the left, numbers on the right."""
    made = DrawnTable(box=None, title=table.fold or None, title_justify="left", pad_edge=False)
    for name in table.columns:
        made.add_column(name.strip(), justify="left" if name in table.words else "right")
    for row in table.rows:
        made.add_row(*map(_cell, row))
    return made


def _cell(of: Cell | str) -> Text:
    if isinstance(of, str):
        return Text(of)
    text = f"{of.text}: {of.small}" if of.look and of.small else of.text
    return Text(text, STYLE_OF_LOOK.get(of.look, ""))


def print_flights(summaries: Sequence[Summary], path: Path) -> None:
    """Print one line a simulated flight, and where they were written."""
    measures = ("top speed m/s", "off reference x m", "y", "z", "crashed")
    rows = [
        (
            *(f"{value:.6g}" for value in summary.coefficients.values()),
            f"{summary.top_speed:.2f}",
            *(f"{axis:.3f}" for axis in summary.tracking_rmse),
            "no" if summary.crash_time is None else f"at {summary.crash_time:.2f} s",
        )
        for summary in summaries
    ]
    screen = console()
    screen.print(rich_table(Table((*summaries[0].coefficients, *measures), rows)))
    screen.print(f"written to {path}")


def print_export(done: Exported) -> None:
    """Print the gates of an export, its notes, and its file."""
    screen = console()
    for gate in done.gates:
        met = "yes" if gate.passed else "NO "
        name = (
            gate.name if gate.ran else f"{gate.name} (not looked at: it needs a run's recordings)"
        )
        screen.print(f"{met if gate.ran else '---'}  {name}")
        for objection in gate.objections:
            screen.print(f"     {objection}")
    for note in done.notes:
        screen.print(f"note: {note}")
    screen.print(f"written to {done.path} and read back")


def print_estimates(estimates: Mapping[str, Estimate], path: Path) -> None:
    """Print a vehicle's coefficients by scaling laws, how crude each is, and where they lie."""
    from tuner.vehicle import COEFFICIENTS

    rows = [
        (name, f"{of.value:.4g}", f"{of.error:.0%}", COEFFICIENTS[name].unit, of.source)
        for name, of in estimates.items()
    ]
    columns = ("coefficient", "value", "±", "unit", "source")
    screen = console()
    screen.print(rich_table(Table(columns, rows, words=("coefficient", "unit", "source"))))
    screen.print(f"written to {path} and {path.stem}.job.yaml")


def print_comparison(
    comparison: Comparison, settings: Settings, *, laps: bool, written: Sequence[Path]
) -> None:
    """Print the RMSE of every vehicle and flight, the lowest in bold and starred."""
    screen = console()
    screen.print(f"controller: {settings.origin['controller']}")
    columns = ("flight", "vehicle", *(f"{axis} {unit}" for axis, unit in RMSE_UNITS.items()))
    rows = [_cells(row, comparison) for row in comparison.rows if laps or row.lap is None]
    screen.print(rich_table(Table(columns, rows, words=("flight", "vehicle"))))
    screen.print(f"best over all flights: {comparison.best or 'none, all of them crashed'}")
    for path in written:
        screen.print(f"written to {path}")


def _cells(row: Row, comparison: Comparison) -> list[Cell | str]:
    stretch = "all flights" if row.flight == "all" else row.flight
    first = stretch if row.lap is None else f"{stretch} lap {row.lap}"
    if row.crash_time is not None:
        return [first, row.vehicle, f"crashed at {row.crash_time:.2f} s"]
    winners = comparison.winners(row.flight, row.lap)
    cells: list[Cell | str] = []
    for axis, value in row.rmse:
        best = winners.get(axis) == row.vehicle and len(comparison.vehicles) > 1
        text = "-" if value is None else f"{value:.4f}"
        cells.append(Cell(f"{text}*", look="best") if best else f"{text} ")
    return [first, row.vehicle, *cells]
