"""Parts of sentences: codes with their texts, lists of names, quantities with their units."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Self

MIN_ERROR = 1e-9
"""Least error whose first digit is shown."""


class CodeWithText(StrEnum):
    """Codes, each with its text: what was noticed, and what to do about it."""

    text: Any
    remedy: Any

    def __new__(cls, value: str, text: Any = None, remedy: Any = "") -> Self:
        """Keep the texts beside the code."""
        if text is None:
            raise TypeError(f"{value} has no text")
        code = str.__new__(cls, value)
        code._value_, code.text, code.remedy = value, text, remedy
        return code


#: What moves a terminal's cursor, colours it or turns its writing around -> a picture of it.
_PICTURES = {code: 0x2400 + code for code in range(32) if chr(code) not in "\n\t"}
_UNPRINTED = ((0x7F, 0xA0), (0x202A, 0x202F), (0x2066, 0x206A), (0xD800, 0xE000))
_PICTURES |= {code: 0xFFFD for bounds in _UNPRINTED for code in range(*bounds)}


def printable(text: str) -> str:
    """Return a text, which a recording or a name may have chosen, as a terminal may show it."""
    return text.translate(_PICTURES)


def listed(words: Sequence[str]) -> str:
    """Return words with commas and a last "and"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def metres(value: float) -> str:
    """Return a length in m, cm or mm."""
    if value >= 1.0:
        return f"{value:.3g} m"
    return f"{100 * value:.2g} cm" if value >= 0.01 else f"{1000 * value:.2g} mm"


def percent(share: float) -> str:
    """Return a share as a percentage, of two digits below one hundred percent."""
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"


def quantity(value: float, unit: str | None) -> str:
    """Return a number of two digits with its unit: below 0.1 s in ms, a share (None) in percent."""
    if unit is None:
        return percent(value)
    if unit == "s" and value < 0.0995:
        value, unit = 1e3 * value, "ms"
    return f"{value:.2g} {unit}".strip()


def with_error(value: float, error: float) -> str:
    """Return "value ± error", both to the first digit of the error."""
    digits = max(-math.floor(math.log10(max(error, MIN_ERROR))), 0)
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def clause(sentence: str) -> str:
    """Return a sentence as a clause of another: without its capital and its full stop."""
    return sentence[:1].lower() + sentence[1:].removesuffix(".")


def as_sentence(clause: str) -> str:
    """Return a clause as a sentence; a first word that is a name keeps its small letter."""
    first = clause.partition(" ")[0]
    return f"{clause[:1].upper() if first.isalpha() else clause[:1]}{clause[1:]}."


def shorten(text: str, width: int) -> str:
    """Return a text of no more than so many characters, cut at a word where it was longer."""
    if len(text) <= width:
        return text
    return f"{text[: max(width - 1, 1)].rpartition(' ')[0] or text[: width - 1]}…"


def listed_within(words: Sequence[str], width: int) -> str:
    """Return as many words as fit, with commas, and how many more there are."""
    for count in range(len(words), 0, -1):
        more = len(words) - count
        text = ", ".join(words[:count]) + (f" and {more} more" if more else "")
        if len(text) <= width:
            return text
    return f"{len(words)} in all"
