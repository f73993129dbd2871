"""Gyro, accelerometer and commands on one clock, and body rates that commands predict.

Errors of open-loop predictions from the measured body rate are told by the time ahead::

    I dω/dt = Σ lever·k·Ω² + trim - ω × Iω

with Ω the rotor speeds that follow the commands. Airspeed is unknown without a pose, and left out.
Errors of the torque accumulate, so that a constant body rate becomes the better prediction after
some time; later errors do not measure a vehicle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import starmap

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from tuner.core.numerics import Array
from tuner.objective.inlets import linear_interpolation
from tuner.objective.rotor_response import MotorLags, rotor_speeds
from tuner.objective.rotor_signals import levers
from tuner.recordings.flight import Series
from tuner.vehicle import ControllerFile, VehicleFile, values_of
from tuner.vehicle.model import model_of

CUTOFF_HZ = 30.0
"""Low-pass of measured and modelled signals, between the band of motors with lags of tens of ms and
vibrations of propellers and frame."""
MAX_RATE_HZ = 500.0
"""Of the common clock."""
END_MARGIN_S = 0.5
"""Both ends of a stretch are left out: take-off, landing and the filters' transients."""
BLOCK_S = 1.0
"""Longer than the correlation of residuals: standard errors count blocks, not samples."""


@dataclass(frozen=True)
class Stretch:
    """A stretch of flight, uniformly sampled.

    Attributes
    ----------
    time
        (n,) s.
    body_rate
        (n, 3) rad/s.
    force
        (n, 3) m/s², the specific force of the accelerometer.
    command
        (n, 4) 0..1.
    """

    time: Array
    body_rate: Array
    force: Array
    command: Array

    @property
    def step(self) -> float:
        """The s between two samples."""
        return float(self.time[1] - self.time[0])

    @property
    def inside(self) -> NDArray[np.bool_]:
        """(n,) flags of samples that are not near the ends."""
        ends = self.time[0] + END_MARGIN_S, self.time[-1] - END_MARGIN_S
        return np.asarray((self.time > ends[0]) & (self.time < ends[1]), dtype=np.bool_)

    @property
    def at_half_rate(self) -> Stretch:
        """The stretch at half the rate."""
        even = len(self.time) // 2 * 2
        command = self.command[:even].reshape(-1, 2, self.command.shape[1]).mean(axis=1)
        every = slice(0, even, 2)
        return Stretch(self.time[every], self.body_rate[every], self.force[every], command)


def stretches_of(
    series: Mapping[str, Series], flying: tuple[tuple[float, float], ...]
) -> tuple[Stretch, ...]:
    """Return the stretches in the air on the clock of the slowest of the three signals."""
    names = ("body_rate", "acceleration", "command")
    rate = min(MAX_RATE_HZ, *(series[name].rate for name in names))
    stretches = []
    for begin, end in flying:
        count = int((end - begin) * rate)
        if count >= 4 * END_MARGIN_S * rate - 1:
            time = begin + np.arange(count) / rate
            stretches.append(
                Stretch(time, *(linear_interpolation(series[name], time) for name in names))
            )
    return tuple(stretches)


def low_pass(values: Array, step: float, cutoff: float = CUTOFF_HZ) -> Array:
    """Return (n, k) values, low-passed without delay at a cutoff in Hz."""
    return np.asarray(signal.sosfiltfilt(_sections(step, cutoff), values, axis=0))


@cache
def _sections(step: float, cutoff: float) -> Array:
    """Return second-order sections of a Butterworth filter, which a search asks for repeatedly."""
    return np.asarray(signal.butter(2, cutoff, fs=1.0 / step, output="sos"))


def blocks_of(stretches: tuple[Stretch, ...], order: int) -> NDArray[np.int64]:
    """Return the block number of each compared step, without the first `order` of a stretch."""
    numbers, first = [], 0
    for stretch in stretches:
        inside = stretch.time[:-1][stretch.inside[:-1]][order:]
        block = first + ((inside - inside[0]) / BLOCK_S).astype(np.int64)
        numbers.append(block)
        first = int(block[-1]) + 1
    return np.concatenate(numbers)


HORIZONS_S = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5)
"""Times ahead of the errors."""
STRIDE_S = 0.1
"""Time from one prediction to the next."""


@dataclass(frozen=True)
class RateErrors:
    """Mean errors, rad/s, of body rates predicted so far ahead.

    Attributes
    ----------
    seconds
        One of `HORIZONS_S`.
    initial, fitted
        By the initial and by the fitted vehicle.
    hold
        By a constant body rate.
    """

    seconds: float
    initial: float
    fitted: float
    hold: float


def rate_errors(
    stretches: Sequence[Stretch], initial: VehicleFile, fitted: VehicleFile
) -> tuple[RateErrors, ...]:
    """Return the errors of a flight's predictions; none without a stretch."""
    if not stretches:
        return ()
    missed = [
        np.concatenate([_prediction_errors(stretch, vehicle) for stretch in stretches], axis=1)
        for vehicle in (initial, fitted, None)
    ]
    errors = np.linalg.norm(missed, axis=-1).mean(axis=-1)
    return tuple(starmap(RateErrors, zip(HORIZONS_S, *errors.tolist(), strict=True)))


def _prediction_errors(stretch: Stretch, vehicle: VehicleFile | None) -> Array:
    """Return the errors (S, n, 3) rad/s of predictions that begin every `STRIDE_S`."""
    measured, inside = low_pass(stretch.body_rate, stretch.step), np.flatnonzero(stretch.inside)
    places = [round(seconds / stretch.step) for seconds in HORIZONS_S]
    begin = inside[: max(0, len(inside) - places[-1]) : round(STRIDE_S / stretch.step)]
    rates = [measured[begin]]
    if vehicle is not None:
        value = values_of(vehicle)
        inertia = np.array([value[f"inertia_{axis}{axis}"] for axis in "xyz"])
        trim = np.array([value.get(f"torque_trim_{axis}", 0.0) for axis in "xyz"])
        motor = model_of(vehicle, ControllerFile()).vehicle.motor
        lags = MotorLags(
            value["time_constant_up"], value["time_constant_down"], value["actuator_latency"]
        )
        speeds = rotor_speeds(stretch.command, stretch.step, motor, lags)
        torque = value["motor_constant"] * np.square(speeds) @ levers(vehicle) + trim
        for step in range(places[-1]):
            moment = torque[begin + step] - np.cross(rates[-1], inertia * rates[-1])
            rates.append(rates[-1] + stretch.step * moment / inertia)
    return np.stack([rates[min(n, len(rates) - 1)] - measured[begin + n] for n in places])
