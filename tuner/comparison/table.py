"""The RMSE of several coefficient sets: per flight, per lap and overall, the lowest marked."""

from __future__ import annotations

from tuner.files import Part, ResultFile
from tuner.result import RMSE_UNITS, AxesRmse


class Row(Part):
    """The RMSE of one vehicle over one stretch.

    Attributes
    ----------
    flight
        Its name, or ``all``.
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


class Table(ResultFile):
    """The rows of all stretches and vehicles, and which vehicle is closest to the recordings.

    ``best`` is None where each vehicle crashed on some flight. A run writes one of its initial and
    best coefficients.
    """

    FILE = "laps.json"

    units: dict[str, str] = RMSE_UNITS
    vehicles: tuple[str, ...]
    best: str | None
    rows: tuple[Row, ...]

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
        for axis in RMSE_UNITS:
            known = [
                (value, row.vehicle)
                for row in self.rows
                if (row.flight, row.lap) == (flight, lap)
                and (value := getattr(row.rmse, axis)) is not None
            ]
            if known:
                winners[axis] = min(known)[1]
        return winners
