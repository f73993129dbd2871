"""The content of ``next_flight.json``: which flight would narrow which interval."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import JsonValue

from tuner.core.disk import write_text
from tuner.core.files import Part, ResultFile, csv_text

NEXT_FLIGHT_TABLE = "next_flight.csv"


class Proposal(Part):
    """A flight that could be flown, and by how much it would narrow the intervals.

    Attributes
    ----------
    name
        Its shape, size and speed in words.
    trajectory
        The options of ``tune simulate`` for it.
    shrinks
        Coefficient -> width of its interval after the flight over that before.
    volume
        Factor on the geometric mean of the half axes of the fitted coefficients' confidence
        ellipsoid.
    """

    name: str
    trajectory: dict[str, JsonValue]
    shrinks: dict[str, float]
    volume: float

    @property
    def mean(self) -> float:
        """Root mean square of the factors, which an A-optimal flight minimises."""
        return float(np.sqrt(np.mean(np.square(list(self.shrinks.values())))))


class Proposals(ResultFile):
    """The content of ``next_flight.json``.

    Attributes
    ----------
    arena
        m along x, y and up.
    seconds
        How long each flight would last.
    targets
        The fitted coefficients that are not well known yet; if there are none, as ``all_known``
        says, the fixed ones that would not be, were they fitted; else all fitted ones.
    fixed_targets
        Those of the targets that were not fitted.
    flights
        Best first.
    """

    FILE = "next_flight.json"

    schema_version: int = 2
    arena: tuple[float, float, float]
    seconds: float
    targets: list[str]
    fixed_targets: list[str]
    all_known: bool
    flights: list[Proposal]

    def write(self, folder: Path) -> None:
        """Write ``next_flight.json`` and, for other programs, ``next_flight.csv``."""
        super().write(folder)
        header = ("flight", "mean_shrink", "volume_shrink", *self.targets)
        rows = [
            [flight.name, flight.mean, flight.volume, *map(flight.shrinks.get, self.targets)]
            for flight in self.flights
        ]
        write_text(folder / NEXT_FLIGHT_TABLE, csv_text(header, rows))
