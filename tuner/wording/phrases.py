"""Parts of sentences: lists of names, percentages, quantities with their units."""

from __future__ import annotations

from collections.abc import Sequence


def listed(words: Sequence[str]) -> str:
    """Return words with commas and a last "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def percent(share: float) -> str:
    """Return a share as a percentage, of two digits below one hundred percent."""
    return f"{100 * share:.2g} %" if share < 1 else f"{100 * share:.0f} %"


def quantity(value: float, unit: str | None) -> str:
    """Return a number of two digits with its unit: seconds in ms, a share (None) in percent."""
    if unit is None:
        return percent(value)
    if unit == "s":
        value, unit = 1e3 * value, "ms"
    return f"{value:.2g} {unit}".strip()
