"""Profiles of the likelihood, as ``profiles.json`` holds them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tuner.disk import write_text
from tuner.files import Part, csv_text, read_optional

PROFILES_FILE = "profiles.json"
PROFILES_TABLE = "profiles.csv"
THRESHOLD = 3.841459
"""Rise of χ² that a true value stays below in 95 of 100 experiments, one degree of freedom."""


class Profile(Part):
    """One coefficient's.

    Attributes
    ----------
    name, unit
        Which.
    values
        At which it was held.
    rise
        χ² above its lowest, the others fitted again, over the square by which the standard error
        is widened for residuals that are no white noise; None where that failed.
    quadratic
        What the standard error says it would be.
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


def write_profiles(found: Sequence[Profile], folder: Path) -> None:
    """Write ``profiles.json`` and, for other programs, ``profiles.csv``."""
    text = Profiles(profiles=list(found)).model_dump_json(indent=1) + "\n"
    write_text(folder / PROFILES_FILE, text)
    rows = [
        [one.name, value, rise, quadratic]
        for one in found
        for value, rise, quadratic in zip(one.values, one.rise, one.quadratic, strict=True)
    ]
    header = ("coefficient", "value", "chi_square_rise", "quadratic")
    write_text(folder / PROFILES_TABLE, csv_text(header, rows))


def read_profiles(folder: Path) -> Profiles | None:
    """Read ``profiles.json``; None where there is none."""
    return read_optional(Profiles, folder / PROFILES_FILE)
