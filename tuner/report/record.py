"""How a search went and what an examination was made of, as files that the page reads."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import JsonValue

from tuner.files import FiniteOrNone, Part, ResultFile
from tuner.findings import Finding
from tuner.search.iteration import Iteration

if TYPE_CHECKING:
    from tuner.search.fitted import Fitted


class Start(Part):
    """Where one start came from and ended; coefficients in their units."""

    origin: str
    loss: FiniteOrNone
    start: dict[str, float]
    end: dict[str, float]


class SearchRecord(ResultFile):
    """The content of ``search.json``."""

    FILE = "search.json"

    iterations: list[Iteration]
    starts: list[Start]


class Recording(Part):
    """A flight that an examination read."""

    name: str
    path: str
    sha256: str
    duration: float


class About(ResultFile):
    """The content of ``about.json``: what an examination without a fit was made of."""

    FILE = "about.json"

    command: str
    vehicle: str
    versions: dict[str, str]
    settings: dict[str, JsonValue]
    findings: list[Finding]
    flights: list[Recording]


def write_search(folder: Path, fitted: Fitted) -> None:
    """Write ``search.json`` of a finished search."""
    numbers = fitted.objective.space.numbers
    SearchRecord(
        iterations=list(fitted.iterations),
        starts=[
            Start(
                origin=outcome.origin,
                loss=outcome.loss,
                start=numbers(outcome.start),
                end=numbers(outcome.vector),
            )
            for outcome in fitted.outcomes
        ],
    ).write(folder)
