"""The content of ``profiles.json``: profiles of the likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tuner.disk import write_text
from tuner.files import Part, csv_text, read_optional

PROFILES_FILE = "profiles.json"
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
    rise: list[float | None]
    quadratic: list[float]
    interval: tuple[float | None, float | None]


class Profiles(Part):
    """The content of ``profiles.json``."""

    schema_version: int = 1
    profiles: list[Profile]


def write_profiles(profiles: Sequence[Profile], folder: Path) -> None:
    """Write ``profiles.json`` and, for other programs, ``profiles.csv``."""
    text = Profiles(profiles=list(profiles)).model_dump_json(indent=1) + "\n"
    write_text(folder / PROFILES_FILE, text)
    rows = [
        [profile.name, *row]
        for profile in profiles
        for row in zip(profile.values, profile.rise, profile.quadratic, strict=True)
    ]
    header = ("coefficient", "value", "chi_square_rise", "quadratic")
    write_text(folder / PROFILES_TABLE, csv_text(header, rows))


def read_profiles(folder: Path) -> Profiles | None:
    """Read ``profiles.json``; None where there is none."""
    return read_optional(Profiles, folder / PROFILES_FILE)
