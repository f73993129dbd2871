"""A section of a report: words, tables and charts, apart from where they are shown."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Literal

import numpy as np
from numpy.typing import NDArray


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
class PageSection:
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


#: Distinct with every common kind of colour blindness (Okabe and Ito, "Color universal design").
#: The first stands out against light and dark alike.
PALETTE = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
GREY = "#8a8a8a"

MIN_DRAWN = 1e-3
"""mm or degrees below which an error is drawn as this on a logarithmic axis."""

Scale = Literal["linear", "log"]
Dash = Literal["solid", "dot", "dash"]


@dataclass(frozen=True)
class LineStyle:
    """The style of a line; colour alone never distinguishes two."""

    colour: str
    dash: Dash = "solid"
    width: float = 1.5
    marks: bool = False


RECORDED = LineStyle(GREY, width=4.0)
INITIAL = LineStyle(PALETTE[1], dash="dot")
FITTED = LineStyle(PALETTE[0])


@dataclass(frozen=True)
class Line:
    """A curve, or points alone where ``joined`` is false."""

    name: str
    x: Sequence[float | None]
    y: Sequence[float | None]
    look: LineStyle
    joined: bool = True
    text: Sequence[str] = ()


@dataclass(frozen=True)
class Bars:
    """Horizontal bars, one a label; several of these in a panel are stacked."""

    name: str
    labels: Sequence[str]
    values: Sequence[float | None]
    colour: str
    text: Sequence[str] = ()


@dataclass(frozen=True)
class HeatMap:
    """A table of colours.

    Attributes
    ----------
    columns, rows
        Labels, or for columns the middles of intervals.
    values
        (rows, columns).
    text
        What each cell says when pointed at.
    digits
        With how many decimals each value is written into its cell; None writes nothing.
    diverging
        Whether zero lies in the middle: then the colours go from −1 to 1.
    ticks
        Colour-bar position -> label, for logarithms.
    """

    columns: Sequence[str] | Sequence[float]
    rows: Sequence[str]
    values: Sequence[Sequence[float | None]]
    bar: str
    text: Sequence[Sequence[str]] = ()
    digits: int | None = None
    diverging: bool = False
    ticks: dict[float, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    marks: Sequence[Line | Bars | HeatMap]
    y_title: str = ""
    y_scale: Scale = "linear"
    x_scale: Scale = "linear"
    equal: bool = False
    levels: Sequence[tuple[float, str]] = ()
    """Horizontal lines and what they mean."""
    x_labels: Sequence[str] = ()
    """Of the places 0, 1, … along the x axis of a page, in place of numbers."""


@dataclass(frozen=True)
class Chart:
    """A figure: panels above each other with one x axis.

    Attributes
    ----------
    key
        Name of its file under ``plots/``.
    title, caption
        What it is, and how to read it.
    height
        Pixels on the page.
    fold
        On the page it is folded under this word; empty shows it.
    clock
        Charts with one of these share their time axis; empty shares none.
    """

    key: str
    title: str
    panels: Sequence[Panel]
    x_title: str = ""
    caption: str = ""
    height: int = 420
    fold: str = ""
    clock: str = ""

    @property
    def is_worth_drawing(self) -> bool:
        """Whether a panel has more than one point."""
        return any(sum(map(_size, panel.marks)) > 1 for panel in self.panels)


def _size(mark: Line | Bars | HeatMap) -> int:
    if isinstance(mark, Line):
        return sum(value is not None for value in mark.y)
    return len(mark.labels) if isinstance(mark, Bars) else len(mark.rows) * len(mark.columns)


def rounded(values: NDArray[np.float64], digits: int) -> list[float | None]:
    """Return a curve for the page, None where it is not finite."""
    return [round(v, digits) if isfinite(v) else None for v in np.asarray(values, float).tolist()]


def charts_json(charts: Sequence[Chart]) -> str:
    """Return charts as the page's script reads them; without ``<``, so that no element ends."""
    return json.dumps(charts, default=vars, allow_nan=False).replace("<", "\\u003c")
