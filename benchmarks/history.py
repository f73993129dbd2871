"""The history of the bars, a line per measurement, so that a regression shows.

The page itself is the record: its lines are read, one is added, and all are written again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

from benchmarks.table import Bar, Section, figure

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
) -> Section:
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
    return Section(
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
    known = [float(line[bar.what].removesuffix(MARK)) for line in lines if bar.what in line]
    if not known or bar.measured is None:
        return False
    if bar.sense == "at least":
        return bar.measured * MAX_WORSE_RATIO < max(known)
    return bar.measured > MAX_WORSE_RATIO * min(known)
