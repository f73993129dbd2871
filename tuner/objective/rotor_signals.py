"""What was recorded of the rotors, held against the vehicle file.

A multirotor's angular acceleration is its rotors' torque over its inertia, and their mean lift its
weight. That tells how well recorded commands or speeds explain how the vehicle turned, in which
order their columns stand and how the rotors spin, in which unit speeds are, and which commands make
a thrust and torque that was commanded.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Literal

import numpy as np

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.findings.findings import Code, Finding
from tuner.objective.inlets import linear_interpolation
from tuner.recordings.content import PER_MOTOR
from tuner.recordings.flight import Flight, Series
from tuner.recordings.interpolation import resample
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import UNIT_PHRASES, UNITS, to_si
from tuner.vehicle import VehicleFile
from tuner.vehicle.motor_orders import columns_of

Source = Literal["command", "rotor_speed"]

FASTEST = 250.0
"""Hz at which signals are compared, at most."""
LATEST = 0.06
"""s by which a turn may follow a command: lag, latency and clocks."""
SMOOTHED = 3
"""Samples over which both are averaged against noise."""
FEWEST = 100
"""Samples below which nothing is said."""


@dataclass(frozen=True)
class TorqueCorrelation:
    """What the rotors explain of a flight's angular acceleration.

    Attributes
    ----------
    source
        What was recorded of the rotors.
    correlation
        About body x, y and z, at the delay at which roll and pitch together are met best.
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


def explained(flight: Flight, vehicle: VehicleFile, source: Source) -> TorqueCorrelation | None:
    """Return what a recorded signal of the rotors explains; None if too little was recorded."""
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

    found = (after(delay) for delay in range(-1, max(1, round(LATEST / step)) + 1))
    best = max(found, key=lambda correlation: correlation[0] + correlation[1]).tolist()
    rates = flight.series[source].rate, flight.series["body_rate"].rate
    return TorqueCorrelation(source, (best[0], best[1], best[2]), *rates)


def _turning(
    series: Mapping[str, Series], vehicle: VehicleFile, source: Source, span: tuple[float, float]
) -> tuple[float, Array, Array] | None:
    """Return the s from sample to sample, and two signals over what both cover of a span in s.

    Angular acceleration (n, 3) in rad/s², and squared rotor speeds (n, rotors), (rad/s)², at the
    gyro's rate; None if too little was recorded.
    """
    gyro, rotors = series["body_rate"], series[source]
    rate = min(FASTEST, gyro.rate)
    begin = max(span[0], gyro.time[0], rotors.time[0])
    end = min(span[1], gyro.time[-1], rotors.time[-1])
    count = int((end - begin) * rate)
    known = [bool(np.isfinite(signal.values).any(axis=0).all()) for signal in (gyro, rotors)]
    if count < FEWEST or not all(known):
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
    rows = []
    for rotor in vehicle.rotors:
        x, y, _ = rotor.position
        rows.append((y, -x, -drag if rotor.spin == "ccw" else drag))
    return np.array(rows)


def _smoothed(values: Array) -> Array:
    kernel = np.ones(SMOOTHED) / SMOOTHED
    return np.stack([np.convolve(column, kernel, "same") for column in values.T], axis=1)


def _correlations(turning: Array, torque: Array) -> Array:
    """Return the correlation (3,) about each axis of two signals (n, 3) of mean zero."""
    size = np.sqrt((turning * turning).sum(axis=0) * (torque * torque).sum(axis=0))
    return np.asarray((turning * torque).sum(axis=0) / np.maximum(size, 1e-300))


LAGS = (0.005, 0.015, 0.03, 0.06)
"""s of the rotors' lag that are tried."""
LATEST_STAMP = 0.4
"""s by which stamps may be late or early."""
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
    read = _quick_turning(series, vehicle, source, span)
    if read is None:
        return None
    _, turning, lagged = read
    arms = levers(vehicle)
    alike_of = {
        order: max(min(_correlations(turning, x @ arms[list(order)])[:2]) for x in lagged)
        for order in permutations(range(4))
    }
    best, second = sorted(alike_of, key=alike_of.__getitem__, reverse=True)[:2]
    if alike_of[best] < ENOUGH or alike_of[second] > alike_of[best] - CLEARER:
        return None
    yaw = max((_correlations(turning, x @ arms[list(best)])[2] for x in lagged), key=abs)
    return MotorOrder(best, bool(yaw < 0.0) if abs(yaw) > ENOUGH else None)


def lateness(
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    source: Source,
    span: tuple[float, float],
) -> float:
    """Return by how many s a signal of the rotors is stamped later than the turning it makes.

    Zero where it follows as rotors do, or where that is not seen: the correlation has to rise by
    `CLEARER` above that without a delay, and above that of any delay with the opposite sign, which
    of a periodic motion is as large. Parameters as of `motor_order`.
    """
    read = _quick_turning(series, vehicle, source, span)
    if read is None:
        return 0.0
    step, turning, lagged = read
    torques, count = [squares @ levers(vehicle) for squares in lagged], len(turning)

    def alike(delay: int) -> float:
        behind, before = max(0, delay), max(0, -delay)
        of_lags = (
            _correlations(turning[before : count - behind], torque[behind : count - before])
            for torque in torques
        )
        return float(max(min(axes[:2]) for axes in of_lags))

    most = min(round(LATEST_STAMP / step), count // 4)
    found = np.array([alike(delay) for delay in range(-most, most + 1)])
    best, rival = int(found.argmax()), max(found[most], -found.min())
    clear = found[best] > max(ENOUGH, rival + CLEARER)
    return float((best - most) * step) if clear and abs(best - most) * step > LATEST else 0.0


def _quick_turning(
    series: Mapping[str, Series],
    vehicle: VehicleFile,
    source: Source,
    span: tuple[float, float],
) -> tuple[float, Array, list[Array]] | None:
    """Return the s between samples, and the quick part of turning (n, 3) and squared speeds.

    The latter (n, 4) for each of `LAGS`; None where too little was recorded.
    """
    read = _turning(series, vehicle, source, span)
    if read is None or len(vehicle.rotors) != 4 or 0.5 / read[0] < 4.0 * SLOW:
        return None
    step, turning, squares = read
    lagged = [_without_slow(_lagged(squares, step, lag), step) for lag in LAGS]
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
        return (Finding(Code.STAMPED_LATE, "warning", name, {"seconds": late}, (source,)),)
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
    moments = np.column_stack(
        [np.interp(thrust.time, torque.time, column) for column in torque.values.T]
    )
    command = commands_of(np.column_stack([thrust.values, moments]), vehicle)
    series = Series(thrust.time, command)
    on_clock = resample("command", series, flight.time)
    nearest = command[int(np.argmin(np.abs(thrust.time)))]
    return replace(
        flight,
        series={**flight.series, "command": series},
        signals={**flight.signals, "command": on_clock},
        initial=replace(flight.initial, command=nearest),
        notes=(*flight.notes, Note(NoteCode.COMMAND_DERIVED)),
    )


def commands_of(wrench: Array, vehicle: VehicleFile) -> Array:
    """Return commands (n, 4) of thrust in N and torque in N m (n, 4), body FLU.

    They are above 1 where the vehicle file's rotors are too weak for what was commanded. The signs
    of a quad-X's rotors, which a vehicle file must have, make the matrix regular.
    """
    shares = np.vstack([np.ones(4), levers(vehicle).T])
    lift = np.maximum(wrench @ np.linalg.inv(shares).T, 0.0)
    motor = vehicle.motor
    speed = np.sqrt(lift / vehicle.aerodynamics.motor_constant) - motor.zero_position_armed
    linear, square = motor.input_scaling, motor.quadratic
    root = np.sqrt(np.maximum(linear * linear + 4.0 * square * speed, 0.0))
    shifted = 2.0 * speed / (linear + root)  # of square·u² + linear·u = speed, stable at 0
    return np.asarray(np.maximum(shifted - motor.input_offset, 0.0))


CARRIES = 1.25
"""Times the weight that commands may lift, or less, in their unit."""


def lifts_as_dshot(flight: Flight, vehicle: VehicleFile) -> tuple[float, float] | None:
    """Return what commands lift as pulses and as DShot, over the weight, where that is in doubt.

    Between 1000 and 2000 nothing else tells the two apart. None where commands were not taken for
    pulses by their range, or pulses carry the vehicle, or better than DShot does.
    """
    read = ("command", UNIT_PHRASES["pwm_us"])
    if not any(n.code is NoteCode.UNIT_READ and n.names == read for n in flight.notes):
        return None
    pulses = flight.signals["command"]
    force = vehicle.aerodynamics.motor_constant / (vehicle.mass * GRAVITY)
    lift, other = (
        force * float(np.nanmean(squared_speed(vehicle, "command", u).sum(axis=1)))
        for u in (pulses, to_si(1e3 * (1.0 + pulses), "dshot"))
    )
    off = abs(math.log(lift))
    return (lift, other) if off > max(abs(math.log(other)), math.log(CARRIES)) else None


SPEED_UNITS = {"si": "in rad/s", "rpm": "in revolutions a minute", "hz": "in revolutions a second"}
"""Units that rotor speeds come in, and how a sentence calls them."""
NEAR = math.sqrt(6.0)
"""Times that a speed may be off what the vehicle file says: units lie over its square apart."""


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
    factors = {unit: UNITS[unit][0] / UNITS[assumed][0] for unit in SPEED_UNITS}

    def fits(unit: str) -> bool:
        fastest = NEAR * vehicle.motor.max_rotor_velocity
        slow_enough = float(np.nanmedian(flight.signals["rotor_speed"])) * factors[unit] < fastest
        return slow_enough and all(1 / NEAR < ratio * factors[unit] < NEAR for ratio in ratios)

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
    """Return how many times too fast the rotors turn, by the weight and by the commands."""
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
    read = Note(NoteCode.UNIT_READ, count=len(series.time), names=("rotor_speed", name))
    return replace(
        flight,
        signals={**flight.signals, **signals},
        series={**flight.series, **speeds},
        initial=replace(flight.initial, rotor_speed=factor * flight.initial.rotor_speed),
        notes=(*flight.notes, read),
    )
