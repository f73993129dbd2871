"""A section of a report: words, tables and charts, apart from where they are shown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tuner.report.chart import Chart


@dataclass(frozen=True)
class Cell:
    """A cell of a table, or a point of a list.

    Attributes
    ----------
    small
        Quieter, below it.
    look
        Class of the page's style: ``worse``, ``well``, ``weak``, ``not`` or ``kept``.
    link
        Where it leads: a file of the result folder.
    """

    text: str
    small: str = ""
    look: str = ""
    link: str = ""


@dataclass(frozen=True)
class Table:
    """Rows under titles.

    Attributes
    ----------
    columns
        Titles; each row has as many cells.
    rows
        Cells, or their text.
    words
        Titles of the columns that hold words; the others hold numbers.
    fold
        Under this word it is folded; empty shows it.
    """

    columns: Sequence[str]
    rows: Sequence[Sequence[Cell | str]]
    words: Sequence[str] = ()
    fold: str = ""


@dataclass(frozen=True)
class Section:
    """One part of a report.

    Attributes
    ----------
    key
        Its anchor.
    tables, charts
        Below those; charts that name a fold of theirs are folded under it.
    """

    key: str
    title: str
    sentences: Sequence[str] = ()
    points: Sequence[Cell] = ()
    tables: Sequence[Table] = ()
    charts: Sequence[Chart] = ()
    note: str = ""
    folded: bool = False

    @property
    def shown(self) -> Sequence[Chart]:
        """Charts that are not folded."""
        return [chart for chart in self.charts if not chart.fold]

    @property
    def folds(self) -> dict[str, list[Chart]]:
        """Fold -> its charts."""
        folds: dict[str, list[Chart]] = {}
        for chart in self.charts:
            if chart.fold:
                folds.setdefault(chart.fold, []).append(chart)
        return folds


def figures(value: float | None) -> str:
    """Write a number to five significant figures."""
    return "–" if value is None else f"{value:.5g}"


def short(value: float | None) -> str:
    """Write a number to two significant figures, nothing where there is none."""
    return "" if value is None else f"{value:.2g}"
