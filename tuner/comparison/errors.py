"""Simulated minus recorded, for whole flights of the reference loop, at the recorded stamps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from sim_jax.crash import AIRBORNE, Limits
from sim_jax.rollout import rollout
from tuner.config import ControllerFile, VehicleFile
from tuner.flights.flight import Array, Flight
from tuner.model import model_of, schedule_of
from tuner.objective.segments import segments_of
from tuner.result import AxesRmse
from tuner.simulation.table import roll_pitch_yaw

#: Closer to the simulator's floor than this, in m, a recording does not end at the floor.
CLEARANCE = 0.3


@dataclass(frozen=True)
class FlightErrors:
    """One flight, flown with one vehicle.

    Attributes
    ----------
    name
        Of the flight.
    position_time, position
        (n,) s since the mission's start and (n, 3) m, world.
    attitude_time, attitude
        (m,) s and (m, 3) degrees of roll, pitch, yaw, each within ±180.
    laps
        (k,) s at which laps were completed.
    crash_time
        s; None for a flight that did not crash.
    """

    name: str
    position_time: Array
    position: Array
    attitude_time: Array
    attitude: Array
    laps: Array
    crash_time: float | None

    def between(self, start: float, end: float) -> FlightErrors:
        """Return the errors of a stretch of the flight."""
        positions = (self.position_time >= start) & (self.position_time < end)
        attitudes = (self.attitude_time >= start) & (self.attitude_time < end)
        return FlightErrors(
            self.name,
            self.position_time[positions],
            self.position[positions],
            self.attitude_time[attitudes],
            self.attitude[attitudes],
            self.laps,
            self.crash_time,
        )

    def later(self, seconds: float) -> FlightErrors:
        """Return the same errors on a clock that began so many s earlier."""
        return replace(
            self,
            position_time=self.position_time + seconds,
            attitude_time=self.attitude_time + seconds,
        )

    @property
    def rmse(self) -> AxesRmse:
        """The thesis's six; None throughout for a crash."""
        return rmse_of([self])


def rmse_of(flights: Sequence[FlightErrors]) -> AxesRmse:
    """Return the RMSE over all samples of some flights, None throughout if one crashed."""
    axes = ("x", "y", "z", "roll", "pitch", "yaw")
    if any(flight.crash_time is not None for flight in flights):
        return AxesRmse(**dict.fromkeys(axes))
    values = [
        *_root_mean_square(np.concatenate([flight.position for flight in flights])),
        *_root_mean_square(np.concatenate([flight.attitude for flight in flights])),
    ]
    return AxesRmse(**dict(zip(axes, values, strict=True)))


def _root_mean_square(errors: Array) -> list[float | None]:
    columns = [column[np.isfinite(column)] for column in errors.T]
    return [float(np.sqrt(np.mean(c**2))) if len(c) else None for c in columns]


class Comparison:
    """Recordings laid out once, to be flown with any number of vehicles.

    Parameters
    ----------
    flights
        Each with a reference.
    controller
        What flew.
    time_offsets
        Flight name -> s by which its pose stamps are late.

    Raises
    ------
    RecordingError
        A flight holds no reference.
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        controller: ControllerFile,
        time_offsets: Mapping[str, float] | None = None,
    ) -> None:
        self._flights = tuple(flights)
        self._controller = controller
        self._offsets = dict(time_offsets or {})
        segments = segments_of(flights, noise={})
        self._inlet, self._start = segments.inlet, segments.start
        self._schedule = schedule_of(controller)
        longest = max(flight.duration for flight in flights)
        self._samples = math.ceil(longest * self._schedule.log_rate) + 2
        self._limits = limits_of(flights)

    def fly(self, vehicle: VehicleFile) -> dict[str, FlightErrors]:
        """Return flight name to its errors with a vehicle."""
        model = model_of(vehicle, self._controller)
        flown = eqx.filter_jit(rollout)(
            model.vehicle,
            model.controller,
            self._schedule,
            self._inlet,
            self._start,
            samples=self._samples,
            limits=self._limits,
        )
        motion = flown.log.motion
        position = np.moveaxis(np.asarray(motion.position.stacked(), dtype=np.float64), 0, 1)
        attitude = np.moveaxis(np.asarray(motion.attitude.stacked(), dtype=np.float64), 0, 1)
        crashes = np.asarray(flown.crash_time, dtype=np.float64)
        return {
            flight.name: simulated_minus_recorded(
                flight,
                (position[..., segment], attitude[..., segment]),
                rate=self._schedule.log_rate,
                late=self._offsets.get(flight.name, 0.0),
                crash_time=float(crashes[segment]),
            )
            for segment, flight in enumerate(self._flights)
        }


def simulated_minus_recorded(
    flight: Flight,
    simulated: tuple[Array, Array],
    *,
    rate: float,
    late: float,
    crash_time: float,
) -> FlightErrors:
    """Return the errors of a simulated flight at the recorded stamps.

    Parameters
    ----------
    flight
        The recording.
    simulated
        (n, 3) positions and (n, 4) attitudes at a rate in Hz.
    rate
        Hz.
    late
        s by which the recorded poses' stamps are late.
    crash_time
        s, infinite if it flew on.
    """
    position, attitude = simulated
    clock = np.arange(len(position)) / rate
    place_time, place = _recorded(flight, "position")
    turn_time, turn = _recorded(flight, "attitude")
    places = [np.interp(place_time - late, clock, column) for column in position.T]
    between = np.column_stack([np.interp(turn_time - late, clock, column) for column in attitude.T])
    return FlightErrors(
        name=flight.name,
        position_time=place_time,
        position=np.column_stack(places) - place,
        attitude_time=turn_time,
        attitude=short_way(roll_pitch_yaw(between) - roll_pitch_yaw(turn)),
        laps=laps_of(flight),
        crash_time=crash_time if crash_time <= flight.duration else None,
    )


def joined(name: str, parts: Sequence[FlightErrors], laps: Array) -> FlightErrors:
    """Return the errors of stretches of one flight, behind each other."""
    crashes = [part.crash_time for part in parts if part.crash_time is not None]
    return FlightErrors(
        name=name,
        position_time=np.concatenate([part.position_time for part in parts]),
        position=np.concatenate([part.position for part in parts]),
        attitude_time=np.concatenate([part.attitude_time for part in parts]),
        attitude=np.concatenate([part.attitude for part in parts]),
        laps=laps,
        crash_time=min(crashes, default=None),
    )


def short_way(degrees: Array) -> Array:
    """Return angles in degrees within ±180."""
    return (degrees + 180.0) % 360.0 - 180.0


def _recorded(flight: Flight, signal: str) -> tuple[Array, Array]:
    """Return the stamps within the mission and the complete samples at them."""
    series = flight.series[signal]
    used = (series.time >= 0) & (series.time <= flight.duration)
    used &= np.isfinite(series.values).all(axis=1)
    return series.time[used], series.values[used]


def laps_of(flight: Flight) -> Array:
    """Return the (k,) times in s at which the lap counter rose within the mission."""
    series = flight.series.get("lap")
    if series is None:
        return np.zeros(0)
    count = series.values[:, 0]
    rises: NDArray[np.bool_] = np.diff(count, prepend=0.0) > 0
    inside = rises & (series.time > 0) & (series.time <= flight.duration)
    return series.time[inside]


def limits_of(flights: Sequence[Flight]) -> Limits:
    """Return the space in which these flights count as flying.

    The simulator's own arena, unless a recording itself comes near its floor or leaves it.
    """
    arena = Limits()
    for flight in flights:
        places = _recorded(flight, "position")[1]
        low = places[:, 2].min() < arena.floor + CLEARANCE
        if low or np.abs(places).max() > arena.half_width / 2:
            return AIRBORNE
    return arena
