"""Records of flights' errors, in ``result.json`` and in a table by vehicle and stretch."""

from __future__ import annotations

import math

from tuner.core.files import FiniteOrNone, Part, ResultFile

RMSE_UNITS = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
AXES = {"position": ("x", "y", "z"), "attitude": ("roll", "pitch", "yaw")}


class AxesRmse(Part):
    """RMSE of position along world x, y, z in m, and of roll, pitch, yaw in degrees.

    None stands for a flight that crashed or an axis that was not recorded.
    """

    x: FiniteOrNone
    y: FiniteOrNone
    z: FiniteOrNone
    roll: FiniteOrNone
    pitch: FiniteOrNone
    yaw: FiniteOrNone

    def norm_or_none(self, signal: str) -> float | None:
        """Return the norm over the axes of position or attitude; None if an axis lacks its RMSE."""
        parts = [getattr(self, axis) for axis in AXES[signal]]
        return None if None in parts else math.hypot(*parts)

    def norm(self, signal: str) -> float:
        """Return the same; infinite instead of None."""
        together = self.norm_or_none(signal)
        return math.inf if together is None else together


class PredictedErrors(Part):
    """Mean errors of open-loop predictions of a flight, ``seconds`` after they begin.

    They are means of the Euclidean distance in position (m), velocity (m/s) and body rate (rad/s),
    and of the angle between the attitudes (rad). Each prediction begins at the recorded, filtered
    state (`tuner.recordings.states`); nothing is fitted to it.
    """

    seconds: float
    position: FiniteOrNone
    velocity: FiniteOrNone
    attitude: FiniteOrNone
    body_rate: FiniteOrNone


class RmseRow(Part):
    """The RMSE of one vehicle over one stretch.

    Attributes
    ----------
    flight
        Its name, or ``all``.
    lap
        From 1; None for the whole flight. The last may be incomplete.
    vehicle
        Its label.
    rmse
        m and degrees.
    crash_time
        s at which the simulated vehicle crashed; None if it did not.
    """

    flight: str
    lap: int | None
    vehicle: str
    rmse: AxesRmse
    crash_time: float | None


class RmseTable(ResultFile):
    """The rows of all stretches and vehicles, and the vehicle closest to the recordings.

    ``best`` is None if each vehicle crashed on some flight. A run writes a table of its initial and
    best coefficients.
    """

    FILE = "laps.json"

    units: dict[str, str] = RMSE_UNITS
    vehicles: tuple[str, ...]
    best: str | None
    rows: tuple[RmseRow, ...]

    def of(self, vehicle: str, flight: str, lap: int | None = None) -> AxesRmse:
        """Return the RMSE of a vehicle over a stretch."""
        return next(
            row.rmse
            for row in self.rows
            if (row.vehicle, row.flight, row.lap) == (vehicle, flight, lap)
        )

    def winners(self, flight: str, lap: int | None) -> dict[str, str]:
        """Return axis -> vehicle with the lowest RMSE over a stretch."""
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
