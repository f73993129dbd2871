"""The battery in a simulation: its reference voltage, and the recorded voltage tick by tick."""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from sim_jax.numeric import Scalar
from sim_jax.schedule import Schedule
from tuner.core.errors import RecordingError
from tuner.objective.voltage import VOLTAGE, voltages_of
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight
from tuner.vehicle import VehicleFile


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
    """Return the logarithm of the voltage in V, smoothed, one a control tick: in its middle.

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
