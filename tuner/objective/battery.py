"""The battery's voltage as the motors meet it, from recordings that hold it.

A motor's speed goes with its voltage (thesis 10.4). Voltmeters are read some ten times a second
with some tens of millivolts of noise, a hundredth of which would be thrust if it were flown as it
stands. What the voltage itself does is a slow decline, and a sag with the load: the current of a
rotor goes with its power, the cube of its speed. The sag follows rotor speeds or motor commands,
which are recorded often and well, and one resistance per set of flights is all that is estimated of
it (a partially linear model, Speckman 1988); the decline is a smoothing spline whose stiffness is
chosen by generalised cross-validation (Craven and Wahba 1979).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from scipy.interpolate import make_smoothing_spline

from sim_jax.numeric import Scalar
from sim_jax.schedule import Schedule
from tuner.config import VehicleFile
from tuner.errors import RecordingError
from tuner.flights.flight import Array as Numbers
from tuner.flights.flight import Flight, Series
from tuner.objective.windows import Window
from tuner.padding import padded_size

VOLTAGE = "battery_voltage"
OFTEN = 20.0
"""Hz to which faster readings are averaged first."""
FEWEST = 5
"""Readings that a smoothing spline needs; fewer are joined by lines."""
TREND = 10.0
"""s, the load's sag is what varies faster than such a polynomial trend follows."""
SURE = 3.0
"""Standard errors by which a resistance differs from none."""


def with_reference_voltage(vehicle: VehicleFile, flights: Sequence[Flight]) -> VehicleFile:
    """Return a vehicle that has a reference voltage: its own, or the largest without load.

    Where no flight's voltage was recorded it stays as it is.
    """
    if vehicle.battery.reference_voltage is not None:
        return vehicle
    curves = [curve for curve in voltages_of(flights) if curve is not None]
    if not curves:
        return vehicle
    largest = max(float(curve.without_load.max()) for curve in curves)
    return vehicle.replace(battery=vehicle.battery.replace(reference_voltage=largest))


def require_voltage(flights: Sequence[Flight]) -> None:
    """Refuse flights whose battery's voltage was not recorded.

    Raises
    ------
    RecordingError
        Names the first.
    """
    for flight in flights:
        if not flight.has(VOLTAGE):
            raise RecordingError(
                flight.path,
                "holds no battery voltage, on which battery_exponent counts",
                "fix battery_exponent at zero and add the term battery_decline, or leave the "
                "flight out",
            )


def log_voltage_of(
    flights: Sequence[Flight], windows: Sequence[Window], schedule: Schedule
) -> Float[Array, "ticks F"] | None:
    """Return the logarithm of the voltage in V, smoothed, one a control tick.

    Parameters
    ----------
    flights, windows
        The F stretches that are flown, and the whole flight that each belongs to.
    schedule
        Its rate of position control is that of the ticks.

    Returns
    -------
    Array or None
        After a stretch's end the last value holds. NaN for a flight whose voltage was not recorded;
        None where no flight's was.
    """
    distinct = list({id(flight): flight for flight in flights}.values())
    curves = {
        id(flight): curve
        for flight, curve in zip(distinct, voltages_of(distinct), strict=True)
        if curve is not None
    }
    if not curves:
        return None
    rate = schedule.position_control_rate
    longest = max(window.flight.duration for window in windows)
    clock = np.arange(padded_size(int(np.ceil(longest * rate)) + 2)) / rate
    columns = []
    for flight, window in zip(flights, windows, strict=True):
        if id(flight) not in curves:
            columns.append(np.full(len(clock), np.nan))
            continue
        curve, lasts = curves[id(flight)], window.flight.duration
        volts = np.interp(window.begin + np.minimum(clock, lasts), curve.time, curve.volts)
        columns.append(np.log(volts))
    return jnp.asarray(np.stack(columns, axis=-1))


def relative_log_voltage(
    log_voltage: Float[Array, "ticks F"], reference: Scalar
) -> Float[Array, "ticks F"]:
    """Return the logarithm of the voltage over the reference voltage; zero where it is unknown."""
    unknown = jnp.isnan(log_voltage)
    return jnp.where(unknown, 0.0, jnp.where(unknown, 0.0, log_voltage) - jnp.log(reference))


@dataclass(frozen=True)
class Voltage:
    """A battery's voltage over a flight, without its meter's noise.

    Attributes
    ----------
    time
        (n,) s.
    volts, without_load
        (n,) V at the terminals, and what they would be if no rotor turned.
    """

    time: Numbers
    volts: Numbers
    without_load: Numbers


def voltages_of(flights: Sequence[Flight]) -> list[Voltage | None]:
    """Return each flight's voltage, None where it was not recorded.

    All flights share one resistance, in V per unit of load; where they do not show that the voltage
    falls with the load, the decline alone is smoothed.
    """
    readings = [
        _averaged(flight.series[VOLTAGE]) if flight.has(VOLTAGE) else None for flight in flights
    ]
    loads = _loads(flights)
    resistance = _resistance(
        [
            (reading, np.interp(reading.time, load.time, load.values[:, 0]))
            for reading, load in zip(readings, loads, strict=True)
            if reading is not None and load is not None
        ]
    )
    return [
        None if reading is None else _smoothed(reading, load, resistance)
        for reading, load in zip(readings, loads, strict=True)
    ]


def _loads(flights: Sequence[Flight]) -> list[Series | None]:
    """Return the mean cube of each flight's rotor speeds, or of its motor commands, over time.

    Rotor speeds where all rotors of all flights were recorded. Over the mean of all flights, so
    that a load (n, 1) is about one; None where a flight holds neither.
    """
    for signal in ("rotor_speed", "command"):
        cubes = [_mean_cube(flight, signal) for flight in flights]
        known = [cube for cube in cubes if cube is not None]
        if known and (signal == "command" or len(known) == len(flights)):
            mean = float(np.mean(np.concatenate([cube.values for cube in known])))
            return [cube and Series(cube.time, cube.values / mean) for cube in cubes]
    return [None] * len(flights)


def _mean_cube(flight: Flight, signal: str) -> Series | None:
    """Return the mean over the rotors (n, 1) of a signal's cube where all were recorded."""
    if not flight.has(signal):
        return None
    series = flight.series[signal]
    known = np.isfinite(series.values).all(axis=1)
    cubes = np.mean(np.abs(series.values[known]) ** 3, axis=1, keepdims=True)
    return Series(series.time[known], cubes) if cubes.sum() > 0.0 else None


def _resistance(pairs: Sequence[tuple[Series, Numbers]]) -> float:
    """Return by how many V the voltage falls per unit of load, from readings and the load there.

    Each flight's decline is a polynomial that both are cleared of; zero where the fall does not
    exceed its standard error for sure.
    """
    falls, varied = [np.empty(0)], [np.empty(0)]
    for reading, load in pairs:
        order = 1 + int(np.ceil(np.ptp(reading.time) / TREND)) if len(reading.time) > 1 else 0
        if len(reading.time) < order + FEWEST:
            continue
        middle, half = reading.time.mean(), max(np.ptp(reading.time) / 2.0, 1e-9)
        trend = np.polynomial.legendre.legvander((reading.time - middle) / half, order)
        both = np.stack([reading.values[:, 0], load], axis=1)
        left = both - trend @ np.linalg.lstsq(trend, both, rcond=None)[0]
        falls.append(-left[:, 0])
        varied.append(left[:, 1])
    fall, vary = np.concatenate(falls), np.concatenate(varied)
    information = float(vary @ vary)
    if not information > 0.0:
        return 0.0
    resistance = float(vary @ fall) / information
    error = np.sqrt(np.mean((fall - resistance * vary) ** 2) / information)
    return resistance if resistance > SURE * error else 0.0


def _smoothed(reading: Series, load: Series | None, resistance: float) -> Voltage:
    """Return a voltage without most of its noise, on the load's stamps where they count."""
    if load is None or resistance == 0.0:
        decline = _spline(reading.time, reading.values[:, 0])(reading.time)
        return Voltage(reading.time, decline, decline)
    sag = resistance * load.values[:, 0]
    without = reading.values[:, 0] + np.interp(reading.time, load.time, sag)
    decline = _spline(reading.time, without)(np.clip(load.time, reading.time[0], reading.time[-1]))
    return Voltage(load.time, decline - sag, decline)


def _spline(time: Numbers, values: Numbers) -> Callable[[Numbers], Numbers]:
    """Return the curve through noisy values, its stiffness chosen by cross-validation."""
    if len(time) < FEWEST:
        return lambda at: np.asarray(np.interp(at, time, values))
    spline = make_smoothing_spline(time, values)
    return lambda at: np.asarray(spline(at))


def _averaged(series: Series) -> Series:
    """Return the known readings (n, 1), the means of those that follow faster than `OFTEN`."""
    known = np.isfinite(series.values[:, 0]) & (series.values[:, 0] > 0)
    time, values = series.time[known], series.values[known, 0]
    bins = np.floor((time - time[0]) * OFTEN + 1e-6).astype(int)
    _, which, count = np.unique(bins, return_inverse=True, return_counts=True)
    time, values = (np.bincount(which, weights=samples) / count for samples in (time, values))
    return Series(time, values[:, None])
