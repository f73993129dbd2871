"""The tables of benchmarks, and the page of results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
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
class Section:
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


def update_section(page: str, section: Section) -> str:
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
