"""The tables of benchmarks, and the page of results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal

from benchmarks.timing import Spread


@dataclass(frozen=True)
class Bar:
    """A required limit."""

    what: str
    measured: float | None
    limit: float
    sense: Literal["at least", "at most"]
    unit: str = ""

    @property
    def verdict(self) -> str:
        if self.measured is None:
            return "not measured"
        excess = self.measured - self.limit
        good = excess >= 0 if self.sense == "at least" else excess <= 0
        return "met" if good else "missed"

    def row(self) -> list[str]:
        shown = "" if self.measured is None else f"{figure(self.measured)}{self.unit}"
        return [self.what, shown, f"{self.sense} {figure(self.limit)}{self.unit}", self.verdict]


@dataclass(frozen=True)
class ResultSection:
    """One benchmark's part of the page."""

    title: str
    text: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    bars: Sequence[Bar] = field(default_factory=tuple)

    def markdown(self) -> str:
        return f"## {self.title}\n\n{self.text}\n\n{table(self.head, self.rows)}\n"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def sections_of(page: str) -> dict[str, str]:
    """Return title -> section of a page, heading included, in their order."""
    _, *parts = page.split("\n## ")
    return {part.partition("\n")[0]: f"## {part.strip()}\n" for part in parts}


def update_section(page: str, section: ResultSection) -> str:
    """Return a page with a section in the place of the one of its title, or at its end."""
    before, heading, rest = page.partition(f"## {section.title}\n")
    _, following, after = rest.partition("\n## ") if heading else ("", "", "")
    return f"{before.rstrip()}\n\n{section.markdown()}{following}{after}"


def update_bars(page: str, bars: Sequence[Bar]) -> str:
    """Return a page whose first table has these bars, in the place of those of their name."""
    head, heading, rest = page.partition("\n## ")
    rows = {bar.what: "| " + " | ".join(bar.row()) + " |" for bar in bars}
    lines = [
        rows.pop(line.split(" | ")[0].removeprefix("| "), line)
        for line in head.rstrip().splitlines()
    ]
    return "\n".join([*lines, *rows.values()]) + "\n" + heading + rest


def figure(value: float) -> str:
    """Return a number in three digits."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e5 else f"{value:.3g}"


def millions(rate: Spread | None) -> str:
    """Return a rate per second in millions, with its quartiles."""
    if rate is None:
        return "–"
    return f"{figure(rate.median / 1e6)} ({figure(rate.low / 1e6)}–{figure(rate.high / 1e6)})"


def seconds(time: Spread) -> str:
    return f"{figure(time.median)} ({figure(time.low)}–{figure(time.high)})"


TITLE = "History"
MAX_WORSE_RATIO = 1.2
"""Factor beyond which a figure counts as worse than the best before it, and not as chance."""
MARK = " ↓"
_WHEN, _VERSION, _NONE = "measured", "version", "–"
_FORMAT = "%Y-%m-%d %H:%M"

Line = Mapping[str, str]
"""Column -> figure, or when and of which version it was measured."""


def lines_of(page: str) -> list[Line]:
    """Return the lines of a page's history, the oldest first."""
    _, _, rest = page.partition(f"## {TITLE}\n")
    rows = [
        [cell.strip() for cell in row.strip("|").split("|")]
        for row in rest.partition("\n## ")[0].splitlines()
        if row.startswith("|")
    ]
    head = rows[0] if rows else []
    return [
        {name: cell for name, cell in zip(head, row, strict=True) if cell != _NONE}
        for row in rows[2:]
    ]


def updated_history(
    page: str, bars: Sequence[Bar], *, when: datetime, version: str, whole: bool
) -> ResultSection:
    """Return a page's history with what was measured now.

    Parameters
    ----------
    bars
        What was measured; those that could not be are left out.
    whole
        Whether everything was measured, which begins a line; a part joins the last line where that
        is of the same day and version.
    """
    lines = lines_of(page)
    now = {_WHEN: when.strftime(_FORMAT), _VERSION: version}
    if lines and not whole and _same_day(lines[-1], now):
        now |= lines.pop()
    for bar in bars:
        if bar.measured is not None:
            now[bar.what] = figure(bar.measured) + (MARK if _is_worse(bar, lines) else "")
    lines.append(now)
    head = list(dict.fromkeys(name for line in lines for name in line))
    return ResultSection(
        TITLE,
        "A line a measure, the newest last; times in UTC. Figures are those of the bars, in their "
        "units; one that is worse than the best above it by more than a factor "
        f"{MAX_WORSE_RATIO:g} is marked{MARK}. Machines and their load differ: ratios are worth "
        "more than seconds.",
        head,
        [[line.get(name, _NONE) for name in head] for line in lines],
    )


def _same_day(line: Line, other: Line) -> bool:
    return (line[_WHEN][:10], line[_VERSION]) == (other[_WHEN][:10], other[_VERSION])


def _is_worse(bar: Bar, lines: Sequence[Line]) -> bool:
    earlier = [float(line[bar.what].removesuffix(MARK)) for line in lines if bar.what in line]
    if not earlier or bar.measured is None:
        return False
    if bar.sense == "at least":
        return bar.measured * MAX_WORSE_RATIO < max(earlier)
    return bar.measured > MAX_WORSE_RATIO * min(earlier)
