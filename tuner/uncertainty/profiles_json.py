"""The content of ``profiles.json``: profiles of the likelihood."""

from __future__ import annotations

from pathlib import Path

from tuner.core.disk import write_text
from tuner.core.files import FiniteOrNone, Part, ResultFile, csv_text

PROFILES_TABLE = "profiles.csv"
THRESHOLD = 3.841459
"""Rise of χ² (one degree of freedom) at the true value that 95 % of experiments stay below."""


class Profile(Part):
    """Profile of one coefficient.

    Attributes
    ----------
    name, unit
        Of the coefficient.
    values
        At which it was fixed.
    rise
        χ² above its lowest, the others fitted again, over the square by which the standard error
        is widened for residuals that are no white noise; None where that failed.
    quadratic
        The rise that the standard error predicts.
    interval
        Where the rise passes `THRESHOLD`; None where it does not within the values.
    """

    name: str
    unit: str
    values: list[float]
    rise: list[FiniteOrNone]
    quadratic: list[float]
    interval: tuple[float | None, float | None]


class Profiles(ResultFile):
    """The content of ``profiles.json``."""

    FILE = "profiles.json"

    profiles: list[Profile]

    def write(self, folder: Path) -> None:
        """Write ``profiles.json`` and, for other programs, ``profiles.csv``."""
        super().write(folder)
        rows = [
            [profile.name, *row]
            for profile in self.profiles
            for row in zip(profile.values, profile.rise, profile.quadratic, strict=True)
        ]
        header = ("coefficient", "value", "chi_square_rise", "quadratic")
        write_text(folder / PROFILES_TABLE, csv_text(header, rows))
