"""What to fly next, as ``next_flight.json`` holds it and as sentences."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from tuner.disk import write_text
from tuner.files import Part, csv_text, read_optional
from tuner.wording.phrases import listed

NEXT_FILE = "next_flight.json"
NEXT_TABLE = "next_flight.csv"
WORTH_FLYING = 0.9
"""An interval that a flight leaves wider than this share of what it was is not narrowed."""
HALVED = (0.45, 0.55)


class Proposal(Part):
    """A flight that could be flown.

    Attributes
    ----------
    name
        In words.
    trajectory
        As ``tune simulate`` takes it.
    shrinks
        Coefficient -> width of its interval after the flight over that before.
    volume
        Factor on the geometric mean of the half axes of the fitted ones' confidence ellipsoid.
    """

    name: str
    trajectory: dict[str, JsonValue]
    shrinks: dict[str, float]
    volume: float

    @property
    def mean(self) -> float:
        """Root mean square of the factors: what an A-optimal flight makes smallest."""
        return float(np.sqrt(np.mean(np.square(list(self.shrinks.values())))))


class Proposals(Part):
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
    flights
        Best first.
    sentences
        What to fly for each target, the greatest gain first.
    """

    schema_version: int = 1
    arena: tuple[float, float, float]
    seconds: float
    targets: list[str]
    all_known: bool
    flights: list[Proposal]
    sentences: list[str]


def in_words(
    rows: Sequence[Proposal], targets: Sequence[str], *, fixed: Collection[str] = ()
) -> list[str]:
    """Return a sentence on each flight worth flying, and one on what none would tell.

    Parameters
    ----------
    rows
        Flights.
    targets
        The coefficients that they are judged by.
    fixed
        Those among them that were not fitted.
    """
    labels = {name: f"{name} (fixed so far)" if name in fixed else name for name in targets}
    if not rows:
        return ["No flight that was tried stays in the air inside this arena."]
    by_flight: dict[str, list[tuple[float, str]]] = {}
    idle = []
    for target in targets:
        best = min(rows, key=lambda row: row.shrinks[target])
        share = best.shrinks[target]
        if share > WORTH_FLYING:
            idle.append(labels[target])
        else:
            by_flight.setdefault(best.name, []).append((share, labels[target]))
    said = []
    for name, gains in sorted(by_flight.items(), key=lambda item: min(item[1])):
        does = listed([_does(share, target) for share, target in sorted(gains)])
        said.append(f"{name[0].upper()}{name[1:]} would {does}.")
    if idle:
        said.append(
            f"No single flight in this arena would narrow the interval of {listed(idle)} by more "
            f"than {1 - WORTH_FLYING:.0%}."
        )
    return said


def _does(share: float, target: str) -> str:
    if HALVED[0] <= share <= HALVED[1]:
        return f"halve the interval of {target}"
    if share < HALVED[0]:
        return f"narrow the interval of {target} to {share:.0%} of what it is"
    return f"narrow the interval of {target} by {1 - share:.0%}"


def write_proposals(proposals: Proposals, folder: Path) -> None:
    """Write ``next_flight.json`` and, for other programs, ``next_flight.csv``."""
    write_text(folder / NEXT_FILE, proposals.model_dump_json(indent=1) + "\n")
    header = ("flight", "mean_shrink", "volume_shrink", *proposals.targets)
    rows = [
        [one.name, one.mean, one.volume, *(one.shrinks[name] for name in proposals.targets)]
        for one in proposals.flights
    ]
    write_text(folder / NEXT_TABLE, csv_text(header, rows))


def read_proposals(folder: Path) -> Proposals | None:
    """Read ``next_flight.json``; None where there is none."""
    return read_optional(Proposals, folder / NEXT_FILE)
