"""Recorded rotor signals compared with the vehicle file.

A multirotor's angular acceleration is its rotors' torque over its inertia, and their mean lift its
weight. This shows how well recorded commands or speeds explain the turning, the order of their
columns, the rotors' spins, the unit of speeds, and the commands of a commanded thrust and torque.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.findings.findings import Code, Finding
from tuner.objective.inlets import linear_interpolation
from tuner.recordings.content import PER_MOTOR
from tuner.recordings.flight import Flight, Series
from tuner.recordings.interpolation import resample
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import UNITS, to_si
from tuner.vehicle import VehicleFile
from tuner.vehicle.motor_orders import columns_of

Source = Literal["command", "rotor_speed"]

MAX_RATE_HZ = 250.0
"""Largest rate at which signals are compared."""
MAX_DELAY_S = 0.06
"""Largest delay of turning behind commands: lag, latency and clocks."""
SMOOTHING_SAMPLES = 3
"""Samples over which both are averaged against noise."""
MIN_SAMPLES = 100


@dataclass(frozen=True)
class TorqueCorrelation:
    """Correlation of the rotors' torque with a flight's angular acceleration.

    Attributes
    ----------
    source
        The recorded rotor signal.
    correlation
        About body x, y and z, at the best delay of roll and pitch together.
    rate, gyro_rate
        Hz at which the rotors and the gyro were logged.
    """

    source: Source
    correlation: tuple[float, float, float]
    rate: float
    gyro_rate: float

    @property
    def tilting(self) -> float:
        """The mean correlation about roll and pitch."""
        return 0.5 * (self.correlation[0] + self.correlation[1])


def torque_correlation(
    flight: Flight, vehicle: VehicleFile, source: Source
) -> TorqueCorrelation | None:
    """Return the torque correlation of a rotor signal; None if too little was recorded."""
    if not flight.has(source) or "body_rate" not in flight.series:
        return None
    read = _turning(flight.series, vehicle, source, (0.0, flight.duration))
    if read is None:
        return None
    step, turning, squares = read
    torque = _smoothed(squares) @ levers(vehicle)

    def after(delay: int) -> Array:
        late, early = turning[max(0, delay) :], torque[: len(torque) - max(0, delay)]
        if delay < 0:
            late, early = turning[:delay], torque[-delay:]
        return _correlations(late - late.mean(axis=0), early - early.mean(axis=0))

    found = (after(delay) for delay in range(-1, max(1, round(MAX_DELAY_S / step)) + 1))
    best = max(found, key=lambda correlation: correlation[0] + correlation[1]).tolist()
    rates = flight.series[source].rate, flight.series["body_rate"].rate
    return TorqueCorrelation(source, (best[0], best[1], best[2]), *rates)


def _turning(
    series: Mapping[str, Series], vehicle: VehicleFile, source: Source, span: tuple[float, float]
) -> tuple[float, Array, Array] | None:
    """Return step in s, angular acceleration (n, 3), rad/s², and squared rotor speeds (n, rotors).

    They have the gyro's rate, over the common part of a span in s; None if that is too short.
    """
    gyro, rotors = series["body_rate"], series[source]
    rate = min(MAX_RATE_HZ, gyro.rate)
    begin = max(span[0], gyro.time[0], rotors.time[0])
    end = min(span[1], gyro.time[-1], rotors.time[-1])
    count = int((end - begin) * rate)
    known = [bool(np.isfinite(signal.values).any(axis=0).all()) for signal in (gyro, rotors)]
    if count < MIN_SAMPLES or not all(known):
        return None
    clock = begin + np.arange(count) / rate
    step = float(clock[1] - clock[0])
    turning = np.gradient(_smoothed(linear_interpolation(gyro, clock)), step, axis=0)
    return step, turning, squared_speed(vehicle, source, linear_interpolation(rotors, clock))


def squared_speed(vehicle: VehicleFile, source: Source, values: Array) -> Array:
    """Return squared rotor speeds, (rad/s)², of commands by the vehicle's curve, or of speeds."""
    if source == "rotor_speed":
        return np.square(values)
    motor = vehicle.motor
    command = values + motor.input_offset
    speed = motor.zero_position_armed + (motor.input_scaling + motor.quadratic * command) * command
    return np.square(speed)


def levers(vehicle: VehicleFile) -> Array:
    """Return (rotors, 3) moments about x, y and z in m of one newton of thrust at each rotor."""
    drag = vehicle.aerodynamics.moment_constant
    x, y, _ = np.transpose([rotor.position for rotor in vehicle.rotors])
    about_z = [-drag if rotor.spin == "ccw" else drag for rotor in vehicle.rotors]
    return np.stack([y, -x, about_z], axis=1)


def _smoothed(values: Array) -> Array:
    """Return the moving average (n, k) of (n, k), whose first and last values go on at the ends."""
    around = np.pad(values, ((SMOOTHING_SAMPLES // 2,) * 2, (0, 0)), mode="edge")
    return np.asarray(np.mean(sliding_window_view(around, SMOOTHING_SAMPLES, axis=0), axis=-1))


def _correlations(turning: Array, torque: Array) -> Array:
    """Return the correlation (3,) about each axis of two signals (n, 3) of mean zero."""
    size = np.sqrt((turning * turning).sum(axis=0) * (torque * torque).sum(axis=0))
    return np.asarray((turning * torque).sum(axis=0) / np.maximum(size, 1e-300))


TRIED_LAGS_S = (0.005, 0.015, 0.03, 0.06)
MAX_STAMP_ERROR_S = 0.4
"""Largest error of stamps that is tried, either way."""
HIGH_PASS_HZ = 2.0
"""Frequency below which turning is filtered out: drag has a part in it."""
MIN_CORRELATION = 0.4
"""Least correlation about roll and pitch of an accepted order."""
SETTLED_S = 0.1
"""A command that has held for so many s is followed."""
BEYOND_LIMIT, MIN_AT_LIMIT = 1.1, 20
"""Least speed asked for over the rotors' limit, and samples of that."""
LEAST_SHARE = 1e-12
"""Share of two signals' squares, multiplied, below which a part of them is rounding errors."""
RESPONSE_LAGS = 40.0
"""Length of a rotor's impulse response, in lags: to the last digit."""
MIN_LEAD = 0.3
"""Least difference of correlation to the next best order."""


@dataclass(frozen=True)
class MotorOrder:
    """The assignment of recorded columns to the rotors of a vehicle file.

    Attributes
    ----------
    rotors
        For each recorded column the number, from 0, of the rotor that it drives.
    reversed_spins
        Whether all rotors spin against the vehicle file; None where yaw does not show it. Both
        halves of a recording have to say so: rotors fall behind where a spin in yaw begins.
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
    series: Mapping[str, Series], vehicle: VehicleFile, source: Source, span: tuple[float, float]
) -> MotorOrder | None:
    """Return which rotor each recorded column drives; None where the recording does not show it.

    Parameters
    ----------
    series
        Signals, among them ``body_rate`` and the source.
    vehicle
        Gives the rotors' places and spins.
    source
        The recorded rotor signal.
    span
        Begin and end of the flight in s.
    """
    read = _quick_turning(series, vehicle, source, span)
    if read is None:
        return None
    _, turning, lagged = read
    arms, size = levers(vehicle), (turning * turning).sum(axis=0)
    sums = [(turning.T @ x, x.T @ x) for x in lagged]

    def alike(order: tuple[int, ...]) -> list[Array]:
        own = arms[list(order)]
        found = []
        for across, of in sums:
            torque, whole = np.diagonal(own.T @ of @ own), np.trace(of) * (own * own).sum(axis=0)
            square = size * np.maximum(torque, LEAST_SHARE * whole) + 1e-300
            found.append(np.diagonal(across @ own) / np.sqrt(square))
        return found

    best = leading_order(lambda order: max(min(axes[:2]) for axes in alike(order)))
    if best is None:
        return None
    torques, count = [x @ arms[list(best)] for x in lagged], len(turning)
    parts = (slice(None), slice(0, count // 2), slice(count // 2, count))
    yaws = [
        max((_correlations(turning[part], x[part])[2] for x in torques), key=abs) for part in parts
    ]
    if max(yaws) < -MIN_CORRELATION:
        return MotorOrder(best, reversed_spins=True)
    return MotorOrder(best, False if yaws[0] > MIN_CORRELATION else None)


def leading_order(alike: Callable[[tuple[int, ...]], float]) -> tuple[int, ...] | None:
    """Return the order of four motors that is clearly the one; None if none is.

    ``alike`` returns the correlation of an order's torques, the lesser of roll and pitch.
    """
    correlation = {order: alike(order) for order in permutations(range(4))}
    best, second = sorted(correlation, key=correlation.__getitem__, reverse=True)[:2]
    clear = correlation[best] > max(MIN_CORRELATION, correlation[second] + MIN_LEAD)
    return best if clear else None


def lateness(
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    source: Source,
    span: tuple[float, float],
) -> float:
    """Return by how many s a signal of the rotors is stamped later than the turning it makes.

    Zero where it follows as rotors do, or where that is not seen: the correlation has to rise by
    `MIN_LEAD` above that without a delay, and above that of any delay with the opposite sign, which
    of a periodic motion is as large. Parameters as of `motor_order`.
    """
    read = _quick_turning(series, vehicle, source, span)
    if read is None:
        return 0.0
    step, turning, lagged = read
    torques, count = [squares @ levers(vehicle) for squares in lagged], len(turning)
    most = min(round(MAX_STAMP_ERROR_S / step), count // 4)
    delays = np.arange(-most, most + 1)
    behind, before = np.maximum(delays, 0), np.maximum(-delays, 0)
    length = 1 << (count + most).bit_length()
    spectrum = np.fft.rfft(turning, length, axis=0).conj()

    def alike(torque: Array) -> Array:
        products = np.fft.irfft(spectrum * np.fft.rfft(torque, length, axis=0), length, axis=0)
        of_turning, of_torque = (
            np.cumsum(np.pad(values, ((1, 0), (0, 0))) ** 2, axis=0) for values in (turning, torque)
        )
        size = (of_turning[count - behind] - of_turning[before]) * (
            of_torque[count - before] - of_torque[behind]
        )
        least = LEAST_SHARE * of_turning[-1] * of_torque[-1] + 1e-300
        return np.asarray((products[delays] / np.sqrt(np.maximum(size, least)))[:, :2].min(axis=1))

    found = np.max([alike(torque) for torque in torques], axis=0)
    best, rival = int(found.argmax()), max(found[most], -found.min())
    clear = found[best] > max(MIN_CORRELATION, rival + MIN_LEAD)
    return float((best - most) * step) if clear and abs(best - most) * step > MAX_DELAY_S else 0.0


def _quick_turning(
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    source: Source,
    span: tuple[float, float],
) -> tuple[float, Array, list[Array]] | None:
    """Return the s between samples, and the quick part of turning (n, 3) and squared speeds.

    The latter (n, 4) for each of `TRIED_LAGS_S`; None where too little was recorded.
    """
    read = _turning(series, vehicle, source, span)
    if read is None or len(vehicle.rotors) != 4 or 0.5 / read[0] < 4.0 * HIGH_PASS_HZ:
        return None
    step, turning, squares = read
    lagged = [_without_slow(_lagged(squares, step, lag), step) for lag in TRIED_LAGS_S]
    return step, _without_slow(turning, step), lagged


def order_findings(
    name: str,
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    span: tuple[float, float],
    source: Source = "command",
) -> tuple[Finding, ...]:
    """Return what is wrong with a flight's commands or speeds: stamps, order, or the spins."""
    if late := lateness(series, vehicle, source, span):
        return (Code.STAMPED_LATE.warning(name, source, seconds=late),)
    order = motor_order(series, vehicle, source, span)
    if order is None or order.is_right:
        return ()
    if order.fields != tuple(sorted(order.fields)):
        return (Code.MOTOR_ORDER.warning(name, *order.fields),)
    return (Code.SPINS_REVERSED.warning(name),)


def rotor_limit(flights: Sequence[Flight]) -> float | None:
    """Return the speed, rad/s, at which rotors stop whatever more is commanded; None if unseen.

    Commands that have held for `SETTLED_S` ask, by the line through the others, for more than
    `BEYOND_LIMIT` of it.
    """
    least, means, speeds = [], [], []
    for flight in flights:
        if not set(PER_MOTOR) <= set(flight.series):
            continue
        rotors = flight.series["rotor_speed"]
        inside = (rotors.time >= 0.0) & (rotors.time <= flight.duration)
        asked = linear_interpolation(flight.series["command"], rotors.time[inside])
        length = max(1, round(SETTLED_S * rotors.rate))
        if inside.sum() < length + MIN_SAMPLES:
            continue
        before = sliding_window_view(asked, length, axis=0)
        least.append(before.min(axis=-1).ravel())
        means.append(before.mean(axis=-1).ravel())
        speeds.append(rotors.values[inside][length - 1 :].ravel())
    if not speeds:
        return None
    held, mean, speed = (np.concatenate(parts) for parts in (least, means, speeds))
    known = np.isfinite(held) & np.isfinite(speed)
    held, mean, speed = held[known], mean[known], speed[known]
    top = float(np.quantile(speed, 0.999)) if len(speed) else 0.0
    below = speed < top / BEYOND_LIMIT
    if below.sum() < MIN_SAMPLES or np.ptp(mean[below]) == 0.0:
        return None
    slope, offset = np.polyfit(mean[below], speed[below], 1)
    beyond = offset + slope * held > BEYOND_LIMIT * top
    stopped = beyond.sum() >= MIN_AT_LIMIT and np.mean(speed[beyond] > 0.95 * top) > 0.9
    return float(np.median(speed[beyond])) if stopped else None


def columns_of_rotors(vehicle: VehicleFile, notes: Sequence[Note]) -> list[int] | None:
    """Return the recorded column, from 0, of each rotor by the vehicle file.

    None if it gives no order, or by ``notes`` the recording's topic map had one when it was read.
    """
    mapped = any(note.code is NoteCode.MOTOR_ORDER_GIVEN for note in notes)
    return None if mapped or vehicle.motor_order is None else columns_of(vehicle.motor_order)


def in_rotor_order(series: Mapping[str, Series], columns: list[int]) -> dict[str, Series]:
    """Return signals with the columns of motors in the order of the rotors."""
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


def _without_slow(values: Array, step: float) -> Array:
    """Return (n, k) values after a Butterworth high pass of second order, without delay.

    Forwards and backwards; it removes the slow turning of laps, in which drag has a part.
    """
    edge = min(round(1.0 / HIGH_PASS_HZ / step), len(values) - 1)
    before = 2.0 * values[0] - values[edge:0:-1]
    behind = 2.0 * values[-1] - values[-2 : -edge - 2 : -1]
    spectrum = np.fft.rfft(np.concatenate([before, values, behind]), axis=0)
    share = (np.fft.rfftfreq(len(values) + 2 * edge, step) / HIGH_PASS_HZ) ** 4
    filtered = np.fft.irfft(
        spectrum * (share / (1.0 + share))[:, None], len(values) + 2 * edge, axis=0
    )
    return np.asarray(filtered[edge : edge + len(values)])


def _lagged(squares: Array, step: float, lag: float) -> Array:
    """Return squared speeds (n, 4) after a first-order lag in s, settled at the first."""
    decay = np.exp(-step / lag)
    response = (1.0 - decay) * decay ** np.arange(math.ceil(RESPONSE_LAGS * lag / step))
    late = [np.convolve(column - column[0], response)[: len(squares)] for column in squares.T]
    return _smoothed(squares[0] + np.stack(late, axis=-1))


WRENCH = ("commanded_thrust", "commanded_torque")


def with_commands(flight: Flight, vehicle: VehicleFile) -> Flight:
    """Return a flight with motor commands, if it holds a commanded wrench and no commands.

    Parameters
    ----------
    flight
        The recording.
    vehicle
        Of four rotors; else the flight is returned as it is.
    """
    has_wrench = all(flight.has(name) for name in WRENCH)
    if flight.has("command") or not has_wrench or len(vehicle.rotors) != 4:
        return flight
    thrust, torque = (flight.series[name] for name in WRENCH)
    moments = linear_interpolation(torque, thrust.time)
    command = commands_of(np.column_stack([thrust.values, moments]), vehicle)
    series = Series(thrust.time, command)
    on_clock = resample("command", series, flight.time)
    nearest = command[int(np.argmin(np.abs(thrust.time)))]
    return replace(
        flight,
        series={**flight.series, "command": series},
        signals={**flight.signals, "command": on_clock},
        initial=replace(flight.initial, command=nearest),
        notes=(*flight.notes, NoteCode.COMMAND_DERIVED.note()),
    )


def commands_of(wrench: Array, vehicle: VehicleFile) -> Array:
    """Return commands (n, 4) of thrust in N and torque in N m (n, 4), body FLU.

    They are above 1 where the vehicle file's rotors are too weak. The matrix is regular: a vehicle
    file has the signs of a quad-X's rotors.
    """
    shares = np.vstack([np.ones(4), levers(vehicle).T])
    lift = np.maximum(wrench @ np.linalg.inv(shares).T, 0.0)
    motor = vehicle.motor
    speed = np.sqrt(lift / vehicle.aerodynamics.motor_constant) - motor.zero_position_armed
    linear, square = motor.input_scaling, motor.quadratic
    root = np.sqrt(np.maximum(linear * linear + 4.0 * square * speed, 0.0))
    shifted = 2.0 * speed / (linear + root)  # of square·u² + linear·u = speed, stable at 0
    return np.asarray(np.maximum(shifted - motor.input_offset, 0.0))


WEIGHT_TOLERANCE = 1.25
"""Largest factor between lift and weight, either way, of commands in the right unit."""


def dshot_lift(flight: Flight, vehicle: VehicleFile) -> tuple[float, float] | None:
    """Return the lift over weight of commands as pulses and as DShot, where the unit is in doubt.

    Values between 1000 and 2000 may be either. None where commands were not read as pulses by their
    range, or lift as pulses is near the weight, or nearer than as DShot.
    """
    read = ("command", UNITS["pwm_us"].phrase)
    if not any(n.code is NoteCode.UNIT_READ and n.names == read for n in flight.notes):
        return None
    pulses = flight.signals["command"]
    force = vehicle.aerodynamics.motor_constant / (vehicle.mass * GRAVITY)
    lift, other = (
        force * float(np.nanmean(squared_speed(vehicle, "command", u).sum(axis=1)))
        for u in (pulses, to_si(1e3 * (1.0 + pulses), "dshot"))
    )
    off = abs(math.log(lift))
    return (lift, other) if off > max(abs(math.log(other)), math.log(WEIGHT_TOLERANCE)) else None


SPEED_UNITS = {"si": "in rad/s", "rpm": "in revolutions a minute", "hz": "in revolutions a second"}
"""Units that rotor speeds come in, and how a sentence calls them."""
UNIT_TOLERANCE = math.sqrt(6.0)
"""Largest ratio of recorded to expected speed in the right unit: units differ by its square."""


def with_speeds_in_si(flight: Flight, vehicle: VehicleFile) -> Flight:
    """Return a flight with its rotor speeds in rad/s, where nothing says in which unit they are.

    Raises
    ------
    RecordingError
        In no unit do they carry the vehicle.
    """
    note = next((n for n in flight.notes if n.code is NoteCode.SPEED_UNIT_OPEN), None)
    if note is None or not flight.has("rotor_speed"):
        return flight
    (assumed,) = note.names
    ratios = _ratios(flight, vehicle)
    factors = {unit: UNITS[unit].factor / UNITS[assumed].factor for unit in SPEED_UNITS}

    def fits(unit: str) -> bool:
        fastest = UNIT_TOLERANCE * vehicle.motor.max_rotor_velocity
        slow_enough = float(np.nanmedian(flight.signals["rotor_speed"])) * factors[unit] < fastest
        return slow_enough and all(
            1 / UNIT_TOLERANCE < ratio * factors[unit] < UNIT_TOLERANCE for ratio in ratios
        )

    if not ratios or fits(assumed):
        return flight
    fitting = [unit for unit in SPEED_UNITS if fits(unit)]
    if len(fitting) != 1:
        carried = ", ".join(
            f"{(ratios[0] * factor) ** 2:.2g} times the weight {SPEED_UNITS[unit]}"
            for unit, factor in factors.items()
        )
        raise RecordingError(
            flight.path,
            f"nothing says in which unit its rotor speeds are, and by the vehicle file they carry "
            f"{carried}",
            "give rotor_speed its unit (si, rpm or hz) in the topic map, and check mass and "
            "motor_constant of the vehicle",
        )
    (unit,) = fitting
    return _scaled(flight, factors[unit], SPEED_UNITS[unit])


def _ratios(flight: Flight, vehicle: VehicleFile) -> list[float]:
    """Return recorded over expected rotor speeds, by the weight and by the commands."""
    speeds = flight.signals["rotor_speed"]
    squares = float(np.nanmedian(np.square(speeds)))
    hover = vehicle.mass * GRAVITY / (len(vehicle.rotors) * vehicle.aerodynamics.motor_constant)
    ratios = [math.sqrt(squares / hover)]
    if flight.has("command"):
        asked = float(np.nanmedian(squared_speed(vehicle, "command", flight.signals["command"])))
        ratios.append(math.sqrt(squares / asked) if asked > 0 else ratios[0])
    return ratios if squares > 0 else []


def _scaled(flight: Flight, factor: float, name: str) -> Flight:
    series = flight.series["rotor_speed"]
    speeds = {"rotor_speed": Series(series.time, factor * series.values)}
    signals = {"rotor_speed": factor * flight.signals["rotor_speed"]}
    read = NoteCode.UNIT_READ.note("rotor_speed", name, count=len(series.time))
    return replace(
        flight,
        signals={**flight.signals, **signals},
        series={**flight.series, **speeds},
        initial=replace(flight.initial, rotor_speed=factor * flight.initial.rotor_speed),
        notes=(*flight.notes, read),
    )
