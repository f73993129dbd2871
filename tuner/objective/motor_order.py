"""The order of recorded motors and the spins of their rotors, seen from how they turn the vehicle.

Each rotor's thrust turns the vehicle about the two axes that it is off, and its drag about the
third. Of the orders in which the recorded columns may stand, one makes a torque that looks like the
angular acceleration; of the two senses of spin, one makes the yaw.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from tuner.findings.findings import Code, Finding
from tuner.objective.explained import (
    Source,
    common_clock,
    levers,
    smoothed,
    squared_speed,
)
from tuner.objective.recorded_inputs import linear_interpolation
from tuner.recordings.content import PER_MOTOR
from tuner.recordings.flight import Array, Flight, Series
from tuner.recordings.notes import Note, NoteCode
from tuner.vehicle import VehicleFile
from tuner.vehicle.motor_orders import columns_of

LAGS = (0.005, 0.015, 0.03, 0.06)
"""s of the rotors' lag that are tried."""
SLOW = 2.0
"""Hz below which turns are left out."""
ENOUGH = 0.4
"""Correlation about roll and pitch from which an order is believed."""
SETTLED = 40.0
"""Lags after which a rotor has followed, to the last digit."""
CLEARER = 0.3
"""By how much the next best order must be less alike."""


@dataclass(frozen=True)
class MotorOrder:
    """How recorded columns stand to the rotors of a vehicle file.

    Attributes
    ----------
    rotors
        For each recorded column the number, from 0, of the rotor that it drives.
    reversed_spins
        Whether all rotors spin against the vehicle file; None where yaw does not show it.
    """

    rotors: tuple[int, ...]
    reversed_spins: bool | None

    @property
    def fields(self) -> tuple[str, ...]:
        """The recorded columns, from 1, in the order in which a topic map is to list them."""
        return tuple(str(1 + self.rotors.index(rotor)) for rotor in range(len(self.rotors)))

    @property
    def is_right(self) -> bool:
        """Whether the columns are in the vehicle's order and its spins are not reversed."""
        return self.rotors == tuple(range(len(self.rotors))) and not self.reversed_spins


def motor_order(
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    source: Source,
    span: tuple[float, float],
) -> MotorOrder | None:
    """Return which rotor each recorded column drives; None where the recording does not show it.

    Parameters
    ----------
    series
        Signals, among them ``body_rate`` and the source.
    vehicle
        Where its rotors sit, and how they spin.
    source
        What was recorded of the rotors.
    span
        s of the flight.
    """
    clock = common_clock(series, source, span)
    if clock is None or len(vehicle.rotors) != 4:
        return None
    step = float(clock[1] - clock[0])
    turning = np.gradient(smoothed(linear_interpolation(series["body_rate"], clock)), step, axis=0)
    squares = squared_speed(vehicle, source, linear_interpolation(series[source], clock))
    if 0.5 / step < 4.0 * SLOW:
        return None
    turning = _without_slow(turning, step)
    lagged = [_without_slow(_lagged(squares, step, lag), step) for lag in LAGS]
    arms = levers(vehicle)
    orders = list(permutations(range(4)))
    alike_of = {
        order: max(_alike(turning, x, arms[list(order)]) for x in lagged) for order in orders
    }
    best, second = sorted(orders, key=alike_of.__getitem__, reverse=True)[:2]
    if alike_of[best] < ENOUGH or alike_of[second] > alike_of[best] - CLEARER:
        return None
    by_yaw = [_correlations(turning, x, arms[list(best)])[2] for x in lagged]
    yaw = max(by_yaw, key=abs)
    return MotorOrder(best, bool(yaw < 0.0) if abs(yaw) > ENOUGH else None)


def order_findings(
    name: str,
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    span: tuple[float, float],
    source: Source = "command",
) -> tuple[Finding, ...]:
    """Return what is wrong with the order of a flight's commands or speeds, and with the spins."""
    order = motor_order(series, vehicle, source, span)
    if order is None or order.is_right:
        return ()
    if order.fields != tuple(sorted(order.fields)):
        return (Finding(Code.MOTOR_ORDER, "warning", name, names=order.fields),)
    return (Finding(Code.SPINS_REVERSED, "warning", name),)


def columns_of_rotors(vehicle: VehicleFile, notes: Sequence[Note]) -> list[int] | None:
    """Return the recorded column, from 0, of each rotor, where only the vehicle file says it.

    Parameters
    ----------
    vehicle
        Whose file may say in which order its recordings are.
    notes
        Of the recording, whose topic map may have said it, and then was read so.
    """
    said = any(note.code is NoteCode.MOTOR_ORDER_GIVEN for note in notes)
    return None if said or vehicle.motor_order is None else columns_of(vehicle.motor_order)


def in_rotor_order(series: Mapping[str, Series], columns: list[int]) -> dict[str, Series]:
    """Return signals with what was recorded of motors in the order of the rotors."""
    return {
        name: Series(of.time, of.values[:, columns]) if name in PER_MOTOR else of
        for name, of in series.items()
    }


def flight_in_rotor_order(flight: Flight, vehicle: VehicleFile) -> Flight:
    """Return a flight with its motors in the order of the vehicle's rotors."""
    columns = columns_of_rotors(vehicle, flight.notes)
    if columns is None:
        return flight
    signals = {n: of[:, columns] if n in PER_MOTOR else of for n, of in flight.signals.items()}
    initial = {name: getattr(flight.initial, name)[columns] for name in PER_MOTOR}
    return replace(
        flight,
        series=in_rotor_order(flight.series, columns),
        signals=signals,
        initial=replace(flight.initial, **initial),
    )


def _alike(turning: Array, squares: Array, arms: Array) -> float:
    """Return the lesser correlation of torque and angular acceleration about x and y."""
    roll, pitch, _ = _correlations(turning, squares, arms)
    return float(min(roll, pitch))


def _correlations(turning: Array, squares: Array, arms: Array) -> Array:
    torque = squares @ arms
    size = np.sqrt((turning * turning).sum(axis=0) * (torque * torque).sum(axis=0))
    return np.asarray((turning * torque).sum(axis=0) / np.maximum(size, 1e-300))


def _without_slow(values: Array, step: float) -> Array:
    """Return (n, k) values without the turns in which drag has a part: those of laps.

    By Butterworth's high pass of second order, forwards and backwards, and so without delay.
    """
    edge = min(round(1.0 / SLOW / step), len(values) - 1)
    before = 2.0 * values[0] - values[edge:0:-1]
    behind = 2.0 * values[-1] - values[-2 : -edge - 2 : -1]
    spectrum = np.fft.rfft(np.concatenate([before, values, behind]), axis=0)
    share = (np.fft.rfftfreq(len(values) + 2 * edge, step) / SLOW) ** 4
    filtered = np.fft.irfft(
        spectrum * (share / (1.0 + share))[:, None], len(values) + 2 * edge, axis=0
    )
    return np.asarray(filtered[edge : edge + len(values)])


def _lagged(squares: Array, step: float, lag: float) -> Array:
    """Return squared speeds (n, 4) as rotors of a lag in s follow them, settled at the first."""
    decay = np.exp(-step / lag)
    response = (1.0 - decay) * decay ** np.arange(math.ceil(SETTLED * lag / step))
    late = [np.convolve(column - column[0], response)[: len(squares)] for column in squares.T]
    return smoothed(squares[0] + np.stack(late, axis=-1))
