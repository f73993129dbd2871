"""The battery in a simulation: its reference voltage, and the recorded voltage tick by tick."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from sim_jax.numeric import Array, Scalar
from sim_jax.schedule import Schedule
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array as Numbers
from tuner.core.numerics import finite_rows, robust_sd
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight, Series
from tuner.vehicle import VehicleFile

VOLTAGE = "battery_voltage"
MAX_READING_RATE_HZ = 20.0
"""Rate to which faster readings are averaged: the voltage varies more slowly."""
MIN_SPLINE_READINGS = 5
"""Readings that a smoothing spline needs; fewer are joined by lines."""
TREND_PERIOD_S = 10.0
"""Period of the polynomial trend of the discharge: faster variations are the load's sag."""
IDLE_SPEED_RATIO = 0.1
"""Rotor speed at no command over that at full command, of armed motors (thesis 5.2)."""
ROTOR_LAG_S = 0.03
"""Approximate time constant of rotors, which the sag follows."""
SPIKE_SD = 3.0
"""Robust standard deviations of a load from commands beyond which a reading is left out of the
resistance: rotors do not follow a saturated command as they follow others."""


@dataclass(frozen=True)
class Voltage:
    """A battery's voltage over a flight, without its meter's noise.

    Attributes
    ----------
    time
        (n,) s.
    volts, without_load
        (n,) V at the terminals, and without load.
    """

    time: Numbers
    volts: Numbers
    without_load: Numbers


def voltages_of(flights: Sequence[Flight]) -> list[Voltage | None]:
    """Return each flight's voltage, None where it was not recorded.

    All flights share one resistance, in V per unit of load. Where the voltage does not fall
    significantly with the load, only the discharge is modelled.
    """
    readings = [
        _averaged(flight.series[VOLTAGE]) if flight.has(VOLTAGE) else None for flight in flights
    ]
    signal, loads = _loads(flights)
    resistance = _resistance(
        [
            (reading, load)
            for reading, load in zip(readings, loads, strict=True)
            if reading is not None and load is not None
        ],
        spikes_count=signal == "rotor_speed",
    )
    return [
        None if reading is None else _smoothed(reading, load, resistance)
        for reading, load in zip(readings, loads, strict=True)
    ]


def with_readings_redrawn(flights: Sequence[Flight], random: np.random.Generator) -> list[Flight]:
    """Return flights with the errors of the voltmeter drawn anew.

    Each deviation from `voltages_of` gets a random sign (the wild bootstrap: Wu, "Jackknife,
    bootstrap and other resampling methods in regression analysis", 1986).
    """
    others = []
    for flight, curve in zip(flights, voltages_of(flights), strict=True):
        if curve is None:
            others.append(flight)
            continue
        readings = flight.series[VOLTAGE]
        expected = np.interp(readings.time, curve.time, curve.volts)[:, None]
        sides = random.choice([-1.0, 1.0], size=readings.values.shape)
        other = Series(readings.time, expected + sides * (readings.values - expected))
        others.append(replace(flight, series={**flight.series, VOLTAGE: other}))
    return others


def _loads(flights: Sequence[Flight]) -> tuple[str, list[Series | None]]:
    """Return the signal that loads come from, and each flight's load (n, 1), about one.

    A load is the mean cube of rotor speeds over the mean of all flights, or of motor commands if
    not all rotors of all flights were recorded; None where a flight has neither.
    """
    for signal in ("rotor_speed", "command"):
        cubes = [_mean_cube(flight, signal) for flight in flights]
        known = [cube for cube in cubes if cube is not None]
        if known and (signal == "command" or len(known) == len(flights)):
            mean = float(np.mean(np.concatenate([cube.values for cube in known])))
            return signal, [cube and Series(cube.time, cube.values / mean) for cube in cubes]
    return "", [None] * len(flights)


def _mean_cube(flight: Flight, signal: str) -> Series | None:
    """Return the mean over the rotors (n, 1) of cubed speeds, or of lagged commands."""
    if not flight.has(signal):
        return None
    series = flight.series[signal]
    known = finite_rows(series.values)
    time, speeds = series.time[known], np.abs(series.values[known])
    if signal == "command" and len(time):
        speeds = _lagged(time, speeds + IDLE_SPEED_RATIO)
    cubes = np.mean(speeds**3, axis=1, keepdims=True)
    return Series(time, cubes) if cubes.sum() > 0.0 else None


def _lagged(time: Numbers, values: Numbers) -> Numbers:
    """Return values (n, k), linear between stamps, after a first-order lag of `ROTOR_LAG_S`.

    Recorders take the last value sent: a zero-order hold would be half a gap late.
    """
    return values + _behind(time.tobytes(), values.astype(float).tobytes()).reshape(values.shape)


@lru_cache(maxsize=32)
def _behind(times: bytes, values_there: bytes) -> Numbers:
    """Return the lag's output minus its input, float64, kept for each time a voltage is asked."""
    time = np.frombuffer(times)
    values = np.frombuffer(values_there).reshape(len(time), -1)
    gaps = np.diff(time)
    keep, slope = np.exp(-gaps / ROTOR_LAG_S)[:, None], np.diff(values, axis=0) / gaps[:, None]
    behind = np.zeros_like(values)  # of the lag, at every stamp
    for row in range(1, len(values)):
        steady = -ROTOR_LAG_S * slope[row - 1]
        behind[row] = steady + keep[row - 1] * (behind[row - 1] - steady)
    return behind


def _resistance(pairs: Sequence[tuple[Series, Series]], *, spikes_count: bool) -> float:
    """Return the battery's resistance, V per unit of load, from readings and loads.

    A polynomial discharge is removed from both. ``spikes_count``: whether loads are known in
    spikes, too. The estimate is uncertain from flights of nearly constant load, and matters where
    one saturates for a moment: so it is shrunk by the share of chance in its square (positive-part
    James and Stein 1961) rather than set to zero.
    """
    falls, varied = [np.empty(0)], [np.empty(0)]
    for reading, load in pairs:
        # a battery declines by the charge that was drawn: the load's integral
        means = 0.5 * (load.values[1:, 0] + load.values[:-1, 0])
        charge = np.concatenate([[0.0], np.cumsum(means * np.diff(load.time))])
        drawn = np.interp(reading.time, load.time, charge)
        trend = _polynomials(drawn, 1 + int(np.ceil(float(np.ptp(reading.time)) / TREND_PERIOD_S)))
        if len(reading.time) < trend.shape[1] + MIN_SPLINE_READINGS:
            continue
        there = np.interp(reading.time, load.time, load.values[:, 0])
        both = np.stack([reading.values[:, 0], there], axis=1)
        left = both - trend @ np.linalg.lstsq(trend, both, rcond=None)[0]
        spread = float(robust_sd(left[:, 1]))
        calm = spikes_count | (np.abs(left[:, 1]) <= SPIKE_SD * max(spread, 1e-12))
        falls.append(-left[calm, 0])
        varied.append(left[calm, 1])
    fall, vary = np.concatenate(falls), np.concatenate(varied)
    information = float(vary @ vary)
    if not information > 0.0:
        return 0.0
    resistance = float(vary @ fall) / information
    chance = float(np.mean((fall - resistance * vary) ** 2)) / information
    return resistance - chance / resistance if resistance**2 > chance and resistance > 0.0 else 0.0


def _smoothed(reading: Series, load: Series | None, resistance: float) -> Voltage:
    """Return a voltage without most of its noise, on the load's stamps if there is a resistance."""
    if load is None or resistance == 0.0:
        decline = _spline(reading.time, reading.values[:, 0])(reading.time)
        return Voltage(reading.time, decline, decline)
    sag = resistance * load.values[:, 0]
    without = reading.values[:, 0] + np.interp(reading.time, load.time, sag)
    decline = _spline(reading.time, without)(np.clip(load.time, reading.time[0], reading.time[-1]))
    return Voltage(load.time, decline - sag, decline)


def _polynomials(span: Numbers, order: int) -> Numbers:
    """Return Legendre's polynomials over a span, (n, order + 1)."""
    middle, half = 0.5 * (span[0] + span[-1]), max(0.5 * (span[-1] - span[0]), 1e-9)
    place = np.clip((span - middle) / half, -1.0, 1.0)
    return np.asarray(np.polynomial.legendre.legvander(place, order))


def _spline(time: Numbers, values: Numbers) -> Callable[[Numbers], Numbers]:
    """Return the smoothing spline of noisy values, its stiffness by cross-validation."""
    if len(time) < MIN_SPLINE_READINGS:
        return lambda at: np.asarray(np.interp(at, time, values))
    spline = _spline_of(time.tobytes(), values.astype(float).tobytes())
    return lambda at: np.asarray(spline(at))


@lru_cache(maxsize=256)
def _spline_of(time: bytes, values: bytes) -> Callable[[Numbers], Numbers]:
    """Return the spline of float64 samples, kept for a fit, its check and its exports."""
    from scipy.interpolate import make_smoothing_spline  # noqa: PLC0415 (slow to import, seldom needed)

    at, readings = np.frombuffer(time), np.frombuffer(values)
    spline: Callable[[Numbers], Numbers] = make_smoothing_spline(
        at, readings, lam=_stiffness(at, readings)
    )
    return spline


def _stiffness(time: Numbers, values: Numbers) -> float:
    """Return the weight of a spline's curvature that generalised cross-validation chooses.

    scipy's choice, in a twentieth of its time: the degrees of freedom are the derivative of a
    logarithm of a determinant, by a complex step. Green and Silverman, "Nonparametric regression
    and generalized linear models", 1994, 2.3 and 3.2.
    """
    from scipy.linalg import lapack  # noqa: PLC0415 (slow to import, seldom needed)
    from scipy.optimize import minimize_scalar  # noqa: PLC0415

    count, gaps = len(time), np.diff(time)
    slopes = np.stack([1.0 / gaps[:-1], -1.0 / gaps[:-1] - 1.0 / gaps[1:], 1.0 / gaps[1:]])
    bends = np.sum([slopes[k] * values[k : count - 2 + k] for k in range(3)], axis=0)
    # bands as LAPACK takes them: the diagonal's row is 4
    roughness, squares = np.zeros((7, count - 2)), np.zeros((7, count - 2))
    roughness[4] = (gaps[:-1] + gaps[1:]) / 3.0
    roughness[3, 1:] = roughness[5, :-1] = gaps[1:-1] / 6.0
    for k in range(3):
        product = np.sum(slopes[k:, : count - 2 - k] * slopes[: 3 - k, k:], axis=0)
        squares[4 - k, k:] = squares[4 + k, : count - 2 - k] = product

    def score(weight: float) -> float:
        factors, pivots, _ = lapack.zgbtrf(roughness + (weight + 1e-20j) * squares, 2, 2)
        curvature = lapack.zgbtrs(factors, 2, 2, bends, pivots)[0].real
        left = np.sum([np.pad(slopes[k] * curvature, (k, 2 - k)) for k in range(3)], axis=0)
        free = np.sum(factors[4].imag / factors[4].real) / 1e-20
        return float(left @ left) * count / float(free) ** 2

    return float(minimize_scalar(score, bounds=(0, count), method="bounded").x)


def _averaged(series: Series) -> Series:
    """Return the known readings (n, 1), averaged to at most `MAX_READING_RATE_HZ`."""
    known = np.isfinite(series.values[:, 0]) & (series.values[:, 0] > 0)
    time, values = series.time[known], series.values[known, 0]
    bins = np.floor((time - time[0]) * MAX_READING_RATE_HZ + 1e-6).astype(int)
    _, which, count = np.unique(bins, return_inverse=True, return_counts=True)
    time, values = (np.bincount(which, weights=samples) / count for samples in (time, values))
    return Series(time, values[:, None])


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
                "holds no battery voltage, which battery_exponent needs",
                "write battery_decline for battery in terms, or fix battery_exponent at zero, or "
                "leave the flight out",
            )


def log_voltage_of(
    flights: Sequence[Flight], windows: Sequence[Window], schedule: Schedule
) -> Float[Array, "ticks F"] | None:
    """Return the logarithm of the voltage in V, smoothed, one a control tick: in its middle.

    Parameters
    ----------
    flights, windows
        F windows, and the whole flight that each belongs to.
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
    clock = (np.arange(int(np.ceil(longest * rate)) + 2) + 0.5) / rate
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
