"""Sizes of arrays, rounded up so that most recordings share compiled code."""

from __future__ import annotations

FINE = 16
"""For what costs time in proportion."""


def padded_size(count: int, steps: int = 4) -> int:
    """Return a size that is no smaller, of which there are ``steps`` between two powers of two.

    Compiled code belongs to the shapes it was compiled for. Sizes up to twice ``steps`` stay as
    they are; others grow by less than one part in ``steps``.
    """
    grain = max(1, (1 << (count - 1).bit_length()) // (2 * steps)) if count > 0 else 1
    return -(-count // grain) * grain
