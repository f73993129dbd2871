"""How closely the simulation meets the recordings: per flight, axis and lap, before and after."""

from __future__ import annotations

from dataclasses import dataclass

from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.result import RMSE_UNITS, AxesRmse


@dataclass(frozen=True)
class Row:
    """A flight or lap; per axis the RMSE before and after, None for a crash."""

    name: str
    pairs: list[tuple[float | None, float | None]]


def errors(contents: Contents) -> Section | None:
    """Return the RMSE before and after, of flights and of laps."""
    if contents.run is None or not contents.run.result.flights:
        return None
    rows = [
        Row(
            flight.name + (" (held out)" if flight.split == "holdout" else ""),
            _pairs(flight.rmse_initial, flight.rmse_best),
        )
        for flight in contents.run.result.flights
    ]
    values = {"axes": RMSE_UNITS, "rows": rows, "laps": _laps(contents)}
    return Section("errors", "RMSE of each flight", values)


def _pairs(before: AxesRmse, after: AxesRmse) -> list[tuple[float | None, float | None]]:
    return [(getattr(before, axis), getattr(after, axis)) for axis in RMSE_UNITS]


def _laps(contents: Contents) -> list[Row]:
    if contents.laps is None:
        return []
    by_lap = {(row.flight, row.lap, row.vehicle): row.rmse for row in contents.laps.rows}
    return [
        Row(
            f"{flight}, lap {lap}",
            _pairs(by_lap[flight, lap, "initial"], by_lap[flight, lap, "best"]),
        )
        for flight, lap in dict.fromkeys(
            (row.flight, row.lap) for row in contents.laps.rows if row.lap is not None
        )
    ]
