"""The RMSE of several vehicles as a table: per flight, per lap and overall."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

from tuner.comparison.errors import FlightErrors, rmse_of
from tuner.comparison.table import Row, Table
from tuner.result import RMSE_UNITS, AxesRmse

OVERALL = "all"
#: A lap in which fewer poses were recorded than this is left out.
FEWEST_POSES = 10


def table_of(flown: Mapping[str, Mapping[str, FlightErrors]]) -> Table:
    """Return the table of vehicle -> flight -> errors."""
    rows = [
        row
        for stretch in zip(
            *(_rows(vehicle, errors) for vehicle, errors in flown.items()), strict=True
        )
        for row in stretch
    ]
    return Table(vehicles=tuple(flown), best=_best(rows), rows=tuple(rows))


def _rows(vehicle: str, flights: Mapping[str, FlightErrors]) -> list[Row]:
    rows = []
    for name, errors in flights.items():
        rows.append(_row(name, None, vehicle, errors.rmse, errors.crash_time))
        edges = [0.0, *errors.laps.tolist(), math.inf]
        if len(edges) > 2:
            laps = [errors.between(start, end) for start, end in itertools.pairwise(edges)]
            rows += [
                _row(name, number, vehicle, lap.rmse, errors.crash_time)
                for number, lap in enumerate(laps, start=1)
                if len(lap.position.time) >= FEWEST_POSES
            ]
    crashes = [e.crash_time for e in flights.values() if e.crash_time is not None]
    overall = rmse_of(list(flights.values()))
    rows.append(_row(OVERALL, None, vehicle, overall, min(crashes, default=None)))
    return rows


def _row(
    flight: str, lap: int | None, vehicle: str, rmse: AxesRmse, crash_time: float | None
) -> Row:
    return Row(flight=flight, lap=lap, vehicle=vehicle, rmse=rmse, crash_time=crash_time)


def _best(rows: Sequence[Row]) -> str | None:
    """Return the vehicle whose overall RMSE has the smallest product over the axes."""
    scores = {}
    for row in rows:
        if row.flight == OVERALL:
            values = [getattr(row.rmse, axis) for axis in RMSE_UNITS]
            known = [max(value, 1e-12) for value in values if value is not None]
            if known and row.crash_time is None:
                scores[row.vehicle] = sum(math.log(value) for value in known) / len(known)
    return min(scores, key=scores.__getitem__) if scores else None
