"""The registry as a table for people."""

from __future__ import annotations

from tuner.vehicle.coefficient import Coefficient, Written
from tuner.vehicle.registry import COEFFICIENTS

_HEADER = ("coefficient", "unit", "meaning", "vehicle file", "fitted", "SDF", "PX4", "source")


def markdown_table() -> str:
    """Return the coefficients of a vehicle file as a Markdown table, a row each."""
    rows = [_HEADER, ("---",) * len(_HEADER), *map(_cells, COEFFICIENTS.values())]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _cells(row: Coefficient) -> tuple[str, ...]:
    return (
        f"`{row.name}`",
        row.unit or "–",
        row.meaning.replace("|", "\\|"),
        f"`{'.'.join(part for part in row.place if part)}`",
        "by default" if row.free else "if freed",
        _entry(row, "sdf"),
        _entry(row, "px4"),
        row.source.replace("<", "`<").replace(">", ">`"),
    )


def _entry(row: Coefficient, target: str) -> str:
    entry = row.exported_as.get(target)
    return f"`{entry.tag}`" if isinstance(entry, Written) else "–"
