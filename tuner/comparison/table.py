"""The RMSE of several coefficient sets: per flight, per lap and overall, the lowest marked."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tuner.comparison.errors import FlightErrors, rmse_of
from tuner.result import AxesRmse

UNITS = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
OVERALL = "all"
#: A lap in which fewer poses were recorded than this is left out.
FEWEST_POSES = 10


@dataclass(frozen=True)
class Row:
    """The RMSE of one vehicle over one stretch.

    Attributes
    ----------
    flight
        Its name, or `OVERALL`.
    lap
        From 1; None for the whole flight. The last may be incomplete.
    vehicle
        As the user calls it.
    rmse
        m and degrees.
    crash_time
        s at which the simulated vehicle crashed; None if it flew.
    """

    flight: str
    lap: int | None
    vehicle: str
    rmse: AxesRmse
    crash_time: float | None


@dataclass(frozen=True)
class Table:
    """The rows of all stretches and vehicles, and which vehicle is closest to the recordings.

    ``best`` is None where each vehicle crashed on some flight.
    """

    rows: tuple[Row, ...]
    vehicles: tuple[str, ...]
    best: str | None

    def of(self, vehicle: str, flight: str, lap: int | None = None) -> AxesRmse:
        """Return the RMSE of a vehicle over a stretch."""
        return next(
            row.rmse
            for row in self.rows
            if (row.vehicle, row.flight, row.lap) == (vehicle, flight, lap)
        )

    def winners(self, flight: str, lap: int | None) -> dict[str, str]:
        """Return axis to the vehicle with the lowest RMSE over a stretch."""
        winners = {}
        for axis in UNITS:
            known = [
                (value, row.vehicle)
                for row in self.rows
                if (row.flight, row.lap) == (flight, lap)
                and (value := getattr(row.rmse, axis)) is not None
            ]
            if known:
                winners[axis] = min(known)[1]
        return winners


def table_of(flown: Mapping[str, Mapping[str, FlightErrors]]) -> Table:
    """Return the table of vehicle -> flight -> errors."""
    rows = [
        row
        for stretch in zip(
            *(_rows(vehicle, errors) for vehicle, errors in flown.items()), strict=True
        )
        for row in stretch
    ]
    vehicles = tuple(flown)
    return Table(tuple(rows), vehicles, _best(rows))


def _rows(vehicle: str, flights: Mapping[str, FlightErrors]) -> list[Row]:
    rows = []
    for name, errors in flights.items():
        rows.append(Row(name, None, vehicle, errors.rmse, errors.crash_time))
        edges = [0.0, *errors.laps.tolist(), math.inf]
        if len(edges) > 2:
            laps = [errors.between(start, end) for start, end in itertools.pairwise(edges)]
            rows += [
                Row(name, number, vehicle, lap.rmse, errors.crash_time)
                for number, lap in enumerate(laps, start=1)
                if len(lap.position.time) >= FEWEST_POSES
            ]
    crashes = [e.crash_time for e in flights.values() if e.crash_time is not None]
    overall = rmse_of(list(flights.values()))
    rows.append(Row(OVERALL, None, vehicle, overall, min(crashes, default=None)))
    return rows


def _best(rows: Sequence[Row]) -> str | None:
    """Return the vehicle whose overall RMSE has the smallest product over the axes."""
    scores = {}
    for row in rows:
        if row.flight == OVERALL:
            values = [getattr(row.rmse, axis) for axis in UNITS]
            known = [max(value, 1e-12) for value in values if value is not None]
            if known and row.crash_time is None:
                scores[row.vehicle] = sum(math.log(value) for value in known) / len(known)
    return min(scores, key=scores.__getitem__) if scores else None
