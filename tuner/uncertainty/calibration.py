"""How often intervals held the truth where it was known: what a benchmark measured.

`benchmarks.calibration` draws truths, flies and fits them, and writes the file.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from tuner.core.files import Part

FILE = Path(__file__).with_name("calibration.json")
LEVELS = ("50", "80", "95")
"""Per cent that intervals are meant to hold."""


class Held(Part):
    """How often the intervals of one kind of flight held the truth.

    Attributes
    ----------
    flights
        What they had beside measurement noise.
    sets, intervals
        How many sets were flown, and how many intervals of coefficients looked at.
    coverage
        Level in per cent -> share that held the truth.
    least
        That of the coefficient whose 95 % intervals held it least often.
    """

    flights: str
    sets: int
    intervals: int
    coverage: dict[str, float]
    least: float


class Calibration(Part):
    """What was measured of every kind of flight, and when."""

    date: str
    kinds: tuple[Held, ...]


@lru_cache(maxsize=1)
def calibration() -> Calibration:
    """Return what was measured."""
    return Calibration.model_validate_json(FILE.read_text(encoding="utf-8"))
