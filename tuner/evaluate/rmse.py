"""Errors of a simulation at the recorded stamps, simulated minus recorded, and their RMSE."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array
from tuner.evaluate.forces import Forces
from tuner.evaluate.records import RMSE_UNITS, AxesRmse
from tuner.recordings.flight import Flight

Pose = Literal["position", "attitude"]


@dataclass(frozen=True)
class SignalErrors:
    """One recorded signal and the error of its simulation.

    Attributes
    ----------
    time
        (n,) s since the mission's start.
    recorded
        (n, 3) m, world, or degrees of roll, pitch, yaw.
    error
        (n, 3) simulated minus recorded in the same unit; angles within ±180 degrees.
    """

    time: Array
    recorded: Array
    error: Array

    def between(self, start: float, end: float) -> SignalErrors:
        """Return the samples from ``start`` in s to before ``end``."""
        inside = (self.time >= start) & (self.time < end)
        return SignalErrors(self.time[inside], self.recorded[inside], self.error[inside])

    @property
    def simulated(self) -> Array:
        """(n, 3) simulated values; angles are near the recorded ones rather than within ±180."""
        return self.recorded + self.error


@dataclass(frozen=True)
class FlightErrors:
    """The errors of one flight with one vehicle.

    Attributes
    ----------
    position
        In m.
    attitude
        In degrees of roll, pitch, yaw.
    laps
        (k,) s at which laps were completed.
    crash_time
        s; None for a flight that did not crash.
    forces
        Force and moment of each term along the simulation, until a crash.
    """

    position: SignalErrors
    attitude: SignalErrors
    laps: Array
    crash_time: float | None
    forces: Forces | None = None

    def between(self, start: float, end: float) -> FlightErrors:
        """Return the errors from ``start`` in s to before ``end``."""
        position, attitude = self.position.between(start, end), self.attitude.between(start, end)
        return FlightErrors(position, attitude, self.laps, self.crash_time)

    @property
    def rmse(self) -> AxesRmse:
        """The RMSE of all six axes; None for a crash."""
        return rmse_of([self])


def rmse_of(flights: Sequence[FlightErrors]) -> AxesRmse:
    """Return the RMSE over all samples of some flights; None if one crashed."""
    if any(flight.crash_time is not None for flight in flights):
        return AxesRmse(**dict.fromkeys(RMSE_UNITS))
    values = [
        *_root_mean_square(np.concatenate([flight.position.error for flight in flights])),
        *_root_mean_square(np.concatenate([flight.attitude.error for flight in flights])),
    ]
    return AxesRmse(**dict(zip(RMSE_UNITS, values, strict=True)))


def _root_mean_square(errors: Array) -> list[float | None]:
    columns = [column[np.isfinite(column)] for column in errors.T]
    return [float(np.sqrt(np.mean(c**2))) if len(c) else None for c in columns]


def concatenate(parts: Sequence[SignalErrors]) -> SignalErrors:
    """Return the errors of successive stretches of one signal as one."""
    return SignalErrors(
        *(
            np.concatenate([getattr(part, field) for part in parts])
            for field in ("time", "recorded", "error")
        )
    )


def wrap_degrees(degrees: Array) -> Array:
    """Return angles in degrees, wrapped to ±180."""
    return (degrees + 180.0) % 360.0 - 180.0


def laps_of(flight: Flight) -> Array:
    """Return the (k,) times in s at which the lap counter rose within the mission."""
    series = flight.series.get("lap")
    if series is None:
        return np.zeros(0)
    count = series.values[:, 0]
    rises: NDArray[np.bool_] = np.diff(count, prepend=0.0) > 0
    inside = rises & (series.time > 0) & (series.time <= flight.duration)
    return series.time[inside]
