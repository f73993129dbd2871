"""The battery's voltage as the motors meet it, from recordings that hold it.

A motor's speed goes with its voltage (thesis 10.4). Voltmeters are read some ten times a second
with some tens of millivolts of noise, a hundredth of which would be thrust if it were flown as it
stands; what the voltage itself does, a slow decline and a sag with the load, takes longer. A local
parabola through what was read keeps both and a third of the noise (Savitzky and Golay 1964;
Cleveland 1979, with a Gaussian weight instead of his).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from sim_jax.numeric import Scalar
from sim_jax.schedule import Schedule
from tuner.config import VehicleFile
from tuner.errors import RecordingError
from tuner.flights.flight import Array as Numbers
from tuner.flights.flight import Flight, Series
from tuner.objective.windows import Window
from tuner.padding import padded_size

VOLTAGE = "battery_voltage"
MEMORY = 0.5
"""s, standard deviation of the parabola's weight: what swings within two seconds passes by half."""
FEWEST = 2.0
"""Samples to one such deviation at least, where the voltage was read more slowly."""
OFTEN = 20.0
"""Hz to which faster readings are averaged first."""
STEADY = 1e-3
"""Keeps the parabola of a lone sample level, in squared samples."""
PARTS = 16
"""A long recording is smoothed in so many parts, for the memory."""


def with_reference_voltage(vehicle: VehicleFile, flights: Sequence[Flight]) -> VehicleFile:
    """Return a vehicle that has a reference voltage: its own, or the largest recorded.

    Where no flight's voltage was recorded it stays as it is.
    """
    known = [flight.series[VOLTAGE].values for flight in flights if flight.has(VOLTAGE)]
    if vehicle.battery.reference_voltage is not None or not known:
        return vehicle
    largest = max(float(np.nanmax(values)) for values in known)
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
    curves = {
        id(flight): smoothed(flight.series[VOLTAGE]) for flight in flights if flight.has(VOLTAGE)
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
        volts = np.interp(window.begin + np.minimum(clock, lasts), curve.time, curve.values[:, 0])
        columns.append(np.log(volts))
    return jnp.asarray(np.stack(columns, axis=-1))


def relative_log_voltage(
    log_voltage: Float[Array, "ticks F"], reference: Scalar
) -> Float[Array, "ticks F"]:
    """Return the logarithm of the voltage over the reference voltage; zero where it is unknown."""
    unknown = jnp.isnan(log_voltage)
    return jnp.where(unknown, 0.0, jnp.where(unknown, 0.0, log_voltage) - jnp.log(reference))


def smoothed(series: Series) -> Series:
    """Return a voltage (n, 1) without most of its noise, on stamps of its own."""
    known = np.isfinite(series.values[:, 0]) & (series.values[:, 0] > 0)
    time, volts = _averaged(series.time[known], series.values[known, 0])
    gap = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    width = max(MEMORY, FEWEST * gap)
    parts = [_parabolas(some, time, volts, width) for some in np.array_split(time, PARTS)]
    return Series(time, np.concatenate(parts)[:, None])


def _averaged(time: Numbers, values: Numbers) -> tuple[Numbers, Numbers]:
    """Return the means of samples that follow each other faster than `OFTEN`."""
    bins = np.floor((time - time[0]) * OFTEN + 1e-6).astype(int)
    _, which, count = np.unique(bins, return_inverse=True, return_counts=True)
    means = [np.bincount(which, weights=samples) / count for samples in (time, values)]
    return means[0], means[1]


def _parabolas(places: Numbers, time: Numbers, values: Numbers, width: float) -> Numbers:
    """Return the value at each place of the parabola that fits the samples around it best."""
    away = np.clip((time - places[:, None]) / width, -6.0, 6.0)
    weight = np.exp(-0.5 * away**2)
    powers = np.stack([np.ones_like(away), away, away**2], axis=1)
    matrix = np.einsum("pin,pn,pjn->pij", powers, weight, powers, optimize=True)
    right = np.einsum("pin,pn,n->pi", powers, weight, values, optimize=True)
    level = np.diag([0.0, STEADY, STEADY])
    return np.asarray(np.linalg.solve(matrix + level, right[..., None])[:, 0, 0])
