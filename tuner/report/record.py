"""How a search went and how laps are met, as files of the result folder that the page reads."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import JsonValue

from tuner.disk import write_text
from tuner.files import Part, read_optional
from tuner.findings import Finding
from tuner.result import AxesRmse

if TYPE_CHECKING:
    from tuner.comparison.errors import FlightErrors
    from tuner.search.fitted import Fitted

SEARCH_FILE = "search.json"
LAPS_FILE = "laps.json"
ABOUT_FILE = "about.json"


class Move(Part):
    """One iteration of the search, see `tuner.search.fitted.Iteration`."""

    stage: str
    number: int
    loss: float
    position_rmse: float | None
    accepted: bool
    horizon: float


class Start(Part):
    """Where one start came from and ended; coefficients in their units."""

    origin: str
    loss: float | None
    start: dict[str, float]
    end: dict[str, float]


class SearchRecord(Part):
    """The content of ``search.json``."""

    schema_version: int = 1
    iterations: list[Move]
    starts: list[Start]

    def write(self, folder: Path) -> None:
        """Write ``search.json``."""
        write_text(folder / SEARCH_FILE, self.model_dump_json(indent=1) + "\n")


class LapRow(Part):
    """How closely one vehicle meets a flight, or one lap of it."""

    flight: str
    lap: int | None
    vehicle: Literal["initial", "best"]
    rmse: AxesRmse
    crash_time: float | None


class LapTable(Part):
    """The content of ``laps.json``, a comparison of the initial and the best vehicle."""

    schema_version: int = 1
    rows: list[LapRow]


class Recording(Part):
    """A flight that an examination read."""

    name: str
    path: str
    sha256: str
    duration: float


class About(Part):
    """The content of ``about.json``: what an examination without a fit was made of."""

    schema_version: int = 1
    command: str
    vehicle: str
    versions: dict[str, str]
    settings: dict[str, JsonValue]
    findings: list[Finding]
    flights: list[Recording]


def write_about(folder: Path, about: About) -> None:
    """Write ``about.json``."""
    write_text(folder / ABOUT_FILE, about.model_dump_json(indent=1) + "\n")


def read_about(folder: Path) -> About | None:
    """Read ``about.json``; None where there is none."""
    return read_optional(About, folder / ABOUT_FILE)


def write_search(folder: Path, fitted: Fitted) -> None:
    """Write ``search.json`` of a finished search."""
    record = SearchRecord(
        iterations=[
            Move(
                stage=iteration.stage,
                number=iteration.number,
                loss=iteration.loss,
                position_rmse=iteration.position_rmse if iteration.position_rmse >= 0 else None,
                accepted=iteration.accepted,
                horizon=iteration.horizon,
            )
            for iteration in fitted.iterations
        ],
        starts=[
            Start(
                origin=outcome.origin,
                loss=outcome.loss if abs(outcome.loss) < float("inf") else None,
                start=_values(fitted, outcome.start),
                end=_values(fitted, outcome.vector),
            )
            for outcome in fitted.outcomes
        ],
    )
    record.write(folder)


def _values(fitted: Fitted, vector: object) -> dict[str, float]:
    import jax.numpy as jnp  # noqa: PLC0415 (a page is rendered without it)

    values = fitted.objective.space.values(jnp.asarray(vector))
    return {name: float(value) for name, value in values.items()}


def write_laps(
    folder: Path, initial: Mapping[str, FlightErrors], best: Mapping[str, FlightErrors]
) -> None:
    """Write ``laps.json``: the RMSE of both vehicles per flight, per lap and overall."""
    from tuner.comparison.table import table_of  # noqa: PLC0415
    from tuner.comparison.write import write_table  # noqa: PLC0415

    write_table(table_of({"initial": initial, "best": best}), folder / LAPS_FILE)


def read_search(folder: Path) -> SearchRecord | None:
    """Read ``search.json``; None where there is none."""
    return read_optional(SearchRecord, folder / SEARCH_FILE)


def read_laps(folder: Path) -> LapTable | None:
    """Read ``laps.json``; None where there is none."""
    return read_optional(LapTable, folder / LAPS_FILE)
