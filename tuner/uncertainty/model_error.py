"""Model error: a fit's problem simulated finer, fed otherwise, or with what its model lacks.

By how much coefficients then have to move is a part of their standard errors. What the model lacks
is seen in the recordings: the laws that `tuner.equation_error.omitted_laws` finds push the
simulated flights, each along its recording, and a rate controller that answers otherwise than its
file (`tuner.equation_error.rate_controller`) flies them so.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from sim_jax.control.gains import MixerSettings, RateGains
from sim_jax.control.mixer import torque_of
from sim_jax.environment import Disturbance, Environment
from sim_jax.frames import markers_of
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import ReferenceInlet, RotorSpeedInlet
from sim_jax.motor import Lag, reference_speed
from sim_jax.rigid_body import Motion
from sim_jax.schedule import Schedule
from sim_jax.vehicle import Motor
from tuner.core.numerics import Array
from tuner.equation_error.omitted_laws import Law, Pair, unexplained
from tuner.equation_error.rate_controller import AXES, PARTS, Answer, Signals, answers
from tuner.equation_error.recorded_accelerations import FEWEST, Mask, Steps, steps_of
from tuner.findings.findings import Code, Finding
from tuner.objective.battery import log_voltage_of, read_again
from tuner.objective.criterion import Point
from tuner.objective.inlets import zero_order_hold
from tuner.objective.normal_equations import Objective
from tuner.objective.simulation import MOTION, SETPOINTS, SPEEDS, TURNED, Flown, environment_of, fly
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight, Series
from tuner.search.findings import odd_flights
from tuner.search.progress import Fitted
from tuner.uncertainty.estimates import (
    DRAWS,
    LIMIT,
    LIMIT_STEP,
    LOGGED,
    READINGS,
    STEP,
    Uncertainty,
)
from tuner.vehicle.model import Model

MATTERS = 0.5
"""Standard errors without it, from which the move of a coefficient is said."""
_CHANNELS = ("position", "attitude", SPEEDS, "body_rate", "command")
LOOP_SIGNALS = ("rate_setpoint", "body_rate", "command")
"""What a rate controller hears and says, as recorded."""
WITHIN_PERIOD = 1.5e-3
"""s of a rate controller's lateness below which nothing is said: stamps tell in which period of the
loop a sample was taken, and not when in it; half of one at 400 Hz is 1.25 ms."""
LATE = 1e-3
"""s of rotor speeds' lateness that is worth a word."""
SMALLEST = 0.03
"""Share of what varies along an axis below which a law is none to speak of."""


FAR_OFF = 1.3
"""Factor on a gain from which it is another controller's, and not its file's with the battery's."""
GAINS = {"rate_gain_roll_pitch": ("roll", "pitch"), "rate_gain_yaw": ("yaw",)}
"""Coefficient -> axes of the rate controller whose gains it scales."""


@dataclass(frozen=True)
class Lack:
    """What the model of a fit lacks.

    Attributes
    ----------
    laws
        The likeliest first.
    disturbance
        What all of them make, in every segment; None for no laws.
    answers
        Which of the rate controller's gains are not the file's.
    late
        s by which recorded rotor speeds come after the turning that they make; zero for not.
    gains
        Fitted coefficient of `GAINS` -> share by which recorded commands put it elsewhere, chance
        apart.
    """

    laws: tuple[Law, ...]
    disturbance: Disturbance | None
    answers: tuple[Answer, ...] = ()
    late: float = 0.0
    gains: Mapping[str, float] = field(default_factory=dict)

    @property
    def or_none(self) -> Lack | None:
        """None if there is nothing to say or to widen."""
        return self if self.laws or self.answers or self.late or self.gains else None

    def acting_on(self, objective: Objective) -> Objective:
        """Return a problem whose simulated flights it pushes, and whose gains are those found.

        And whose rotor speeds were taken when they turned so.
        """
        segments, model = objective.segments, objective.model
        rate = model.controller.rate
        for answer in self.answers:
            rate = _answering(rate, answer)
        pushed = replace(
            objective,
            segments=replace(segments, disturbance=self.disturbance),
            model=eqx.tree_at(lambda m: m.controller.rate, model, rate),
        )
        return _with_speeds_earlier(pushed, self.late) if self.late else pushed


def lack_of(fitted: Fitted, flights: Sequence[Flight]) -> Lack | None:
    """Return what the model of a fit lacks; None if that is nothing, or cannot be told.

    Of flights as of `odd_flights` nothing is taken.

    Parameters
    ----------
    fitted
        Of whole flights in the closed loop.
    flights
        The F fitted ones, in the order of the segments.
    """
    objective, point = fitted.objective, fitted.point
    segments, schedule = objective.segments, objective.schedule
    if segments.windowed or not isinstance(segments.inlet, ReferenceInlet):
        return None
    vector = np.asarray(point.coefficients)
    model = objective.model_at(vector)
    conditions = objective.conditions_at(point)
    environment = environment_of(model, segments, conditions)
    driven = [not flight.tells_speeds for flight in flights]
    commands = {
        number: flight.series["command"]
        for number, flight in enumerate(flights)
        if driven[number] and "command" in flight.series
    }
    speeds = _driven(commands, model, environment, schedule)
    read_late = float(model.vehicle.effects.get("tachometer_lag", 0.0))  # to first order
    read = []
    for number, flight in enumerate(flights):
        series = dict(flight.series)
        if number in speeds:
            series["rotor_speed"] = speeds[number]
        elif read_late and "rotor_speed" in series:
            late = series["rotor_speed"]
            series["rotor_speed"] = Series(late.time - read_late, late.values)
        read.append(_recorded(replace(flight, series=series), model, conditions, number))
    flown = fly(
        objective.model,
        segments,
        schedule,
        samples=objective.samples,
        limits=objective.limits,
        coefficients=objective.space.values(vector),
        conditions=conditions,
        channels=(*_CHANNELS, MOTION, TURNED, SETPOINTS),
    )
    rate = float(schedule.log_rate)
    odd = odd_flights(fitted.scales)
    tell = ~np.isfinite(np.asarray(flown.crash_time))
    tell[[number for number, name in enumerate(fitted.scales) if name in odd]] = False
    told = _heard(flights, flown, model.controller.mixer, rate, tell)
    heard = tuple(answer for answer in told if answer.differs)
    apart = {}
    for name in set(GAINS) & set(objective.space.names):
        if (gain := gain_told(name, told)) is not None and abs(gain[0] - 1.0) > gain[1]:
            apart[name] = float(np.sqrt((gain[0] - 1.0) ** 2 - gain[1] ** 2))
    pairs = {
        number: Pair(one, _simulated(one, flown.channels, conditions, number, rate), by_command)
        for number, (one, by_command) in enumerate(zip(read, driven, strict=True))
        if one is not None and tell[number]
    }
    if not pairs:
        return Lack((), None, heard, gains=apart).or_none
    scaled = np.asarray(objective.space.scaled(point.coefficients))
    parameters = objective.space.parameters
    found = unexplained(model, parameters, scaled, tuple(pairs.values()))
    if not found.laws:
        return Lack((), None, heard, found.late, apart).or_none
    body = model.vehicle.body
    by = np.array([*[body.mass] * 3, body.inertia_xx, body.inertia_yy, body.inertia_zz], float)
    ticks = np.arange(objective.samples + 2) / rate
    pushes = np.zeros((6, len(ticks), segments.count))
    for (number, pair), made in zip(pairs.items(), found.accelerations, strict=True):
        one, acting = pair.recorded, made * by
        acting[:, :3] = Rotation.from_quat(
            np.asarray(one.motion.attitude.stacked()).T, scalar_first=True
        ).apply(acting[:, :3])
        for axis, column in enumerate(acting.T):
            pushes[axis, :, number] = np.interp(ticks, one.time, column)
    force, moment = (Vec3(*map(jnp.asarray, rows)) for rows in (pushes[:3], pushes[3:]))
    pushed = Disturbance(force=force, moment=moment, rate=rate)
    return Lack(found.laws, pushed, heard, found.late, apart)


def gain_told(name: str, answers: Sequence[Answer]) -> tuple[float, float] | None:
    """Return a coefficient of `GAINS` by recorded commands, over the fit's, and its error.

    None where they do not tell it of all its axes.
    """
    those = [one for one in answers if one.part == "P" and one.axis in GAINS[name]]
    if len(those) < len(GAINS[name]):
        return None
    weights = np.array([one.sd**-2.0 for one in those])
    value = float(np.average([one.value for one in those], weights=weights))
    return value, float(weights.sum() ** -0.5)


def alternatives_of(
    objective: Objective, point: Point, flights: Sequence[Flight] = ()
) -> dict[str, Objective]:
    """Return what might be simulated differently -> the problem so simulated.

    Physics runs in the same steps where a recording is fed in step by step: it is laid out for
    those.

    Parameters
    ----------
    flights
        Those that are flown whole in it, to have their voltmeters read again where the fit has a
        battery; none for a fit in which that is not asked.
    """
    limited = _limited(objective)
    if not isinstance(objective.segments.inlet, ReferenceInlet):
        return limited
    schedule = objective.schedule
    finer = replace(schedule, physics_rate=2 * schedule.physics_rate)
    return {
        STEP: replace(objective, schedule=finer),
        **limited,
        **_filtered_by_samples(objective),
        **_read_again(objective, point, flights),
    }


def _limited(objective: Objective) -> dict[str, Objective]:
    """Return the problem whose rotors reach less speed, if nothing recorded tells rotor speeds.

    Thrust and drag tell rotors that turn faster from ones that give more by nothing but their
    limit.
    """
    segments, model = objective.segments, objective.model
    if "rotor_speed" in segments.measured or isinstance(segments.inlet, RotorSpeedInlet):
        return {}
    lower = (1.0 - LIMIT_STEP) * model.vehicle.motor.max_rotor_velocity
    limited = eqx.tree_at(lambda m: m.vehicle.motor.max_rotor_velocity, model, lower)
    return {LIMIT: replace(objective, model=limited)}


def _filtered_by_samples(objective: Objective) -> dict[str, Objective]:
    """Return the problem whose rotor speeds were filtered sample by sample, if it has their lag.

    Such a filter is late by half a period of the log less than one of the same time constant that
    is steady, and what was logged does not tell which it was: limits, of which the standard error
    is the half-width over √3.
    """
    speeds = objective.segments.measured.get("rotor_speed")
    if speeds is None or "tachometer_lag" not in objective.space.names:
        return {}
    apart = np.diff(np.asarray(speeds.time), axis=0)
    late = 0.5 * float(np.median(apart[apart > 0.0])) / np.sqrt(3.0)
    return {LOGGED: _with_speeds_earlier(objective, late)}


def _with_speeds_earlier(objective: Objective, seconds: float) -> Objective:
    """Return a problem whose rotor speeds were recorded so much earlier."""
    measured = dict(objective.segments.measured)
    if "rotor_speed" in measured:
        speeds = measured["rotor_speed"]
        measured["rotor_speed"] = eqx.tree_at(lambda m: m.time, speeds, speeds.time - seconds)
    return replace(objective, segments=replace(objective.segments, measured=measured))


def _read_again(
    objective: Objective, point: Point, flights: Sequence[Flight]
) -> dict[str, Objective]:
    """Return the problem with other readings of the voltmeters, if they matter to a fit."""
    segments = objective.segments
    vehicle = objective.model_at(point.coefficients).vehicle
    matters = bool(float(vehicle.effects.get("battery_exponent", 0.0)))
    if not flights or segments.log_voltage is None or not matters:
        return {}
    windows = [Window(flight, 0.0) for flight in flights]
    as_read = log_voltage_of(flights, windows, objective.schedule)
    assert as_read is not None, "the segments hold what was read"
    random, others = np.random.default_rng(0), {}
    for number in range(DRAWS):
        again = log_voltage_of(read_again(flights, random), windows, objective.schedule)
        assert again is not None, "there is a voltmeter"
        volts = segments.log_voltage + (again - as_read)
        others[f"{READINGS} {number}"] = replace(
            objective, segments=replace(segments, log_voltage=volts)
        )
    return others


def lack_found(lack: Lack | None, uncertainty: Uncertainty) -> tuple[Finding, ...]:
    """Return what there is to say of it; of laws, those that may have moved coefficients."""
    if lack is None:
        return ()
    moved = [
        name
        for name, estimate in uncertainty.estimates.items()
        if (move := estimate.parts.lack)
        and move**2 > MATTERS**2 * (estimate.std_error**2 - move**2)
    ]
    laws = [
        Finding(
            Code.LAW_LACKING,
            "warning",
            "model",
            {"share": law.share},
            (law.axis, law.feature, *moved),
        )
        for law in lack.laws
        if moved and abs(law.share) > SMALLEST
    ]
    heard = [one for one in lack.answers if one.part != "late" or abs(one.value) > WITHIN_PERIOD]
    if abs(lack.late) > LATE:
        numbers = {"seconds": lack.late}
        laws.insert(0, Finding(Code.ROTOR_SPEEDS_LATE, "warning", "rotor speeds", numbers))
    return (*_said_of_controller(heard), *laws)


def gains_far_off(fitted: Fitted, flights: Sequence[Flight]) -> tuple[Finding, ...]:
    """Return which gains of the controller file cannot be those that flew, by recorded commands.

    They tell that beside any fit; arguments are those of `lack_of`.
    """
    lack = lack_of(fitted, flights)
    answers = () if lack is None else lack.answers
    return _said_of_controller(
        [one for one in answers if one.part != "late" and not 1.0 / FAR_OFF < one.value < FAR_OFF]
    )


def _said_of_controller(answers: Sequence[Answer]) -> tuple[Finding, ...]:
    parts = {part: [one for one in answers if one.part == part] for part in PARTS}
    return tuple(
        Finding(
            Code.CONTROLLER_ANSWERS,
            "warning",
            "controller file",
            {
                name: number
                for one in those
                for name, number in ((one.axis, one.value), (f"{one.axis}_error", one.sd))
            },
            (part, *(one.axis for one in those)),
        )
        for part, those in parts.items()
        if those
    )


def _answering(gains: RateGains, answer: Answer) -> RateGains:
    """Return the gains of which one is as it was found, P before the lateness of its axis.

    A lag of the gyro is as good as less D; a lateness is that beside a D that grows with P.
    """
    axis = "xyz"[AXES.index(answer.axis)]

    def scaled(gain: Vec3) -> Vec3:
        return replace(gain, **{axis: answer.value * getattr(gain, axis)})

    if answer.part == "P":
        return replace(gains, p=scaled(gains.p), d=scaled(gains.d))
    if answer.part == "I":
        return replace(gains, i=scaled(gains.i))
    late = getattr(gains.d, axis) - answer.value * getattr(gains.p, axis)
    return replace(gains, d=replace(gains.d, **{axis: late}))


def _heard(
    flights: Sequence[Flight], flown: Flown, mixer: MixerSettings, rate: float, tell: Mask
) -> tuple[Answer, ...]:
    """Return how the rate controllers of recorded flights answer, beside those of the fit's.

    ``tell`` (F,) says which flights are looked at.
    """
    recorded, simulated = [], []
    for number, flight in enumerate(flights):
        series = flight.series
        known = set(LOOP_SIGNALS) <= set(series)
        if not (known and tell[number]):
            continue
        clock = np.arange(flown.channels["command"].shape[1]) / rate
        time = series["command"].time
        time = time[(time >= 0.0) & (time <= clock[-1])]
        if len(time) < FEWEST or not all(
            np.isfinite(series[name].values).all() for name in LOOP_SIGNALS
        ):
            continue
        even = np.linspace(time[0], time[-1], len(time))
        recorded.append(_signals([series[name] for name in LOOP_SIGNALS], mixer, even))
        made = []
        for name, channel in zip(LOOP_SIGNALS, (SETPOINTS, "body_rate", "command"), strict=True):
            stamps = series[name].time  # what is lost between a recording's samples is lost here
            stamps = stamps[(stamps >= 0.0) & (stamps <= clock[-1])]
            there = Series(clock, flown.channels[channel][number])
            # what a loop computes holds until it runs again; a body turns on
            read = _at if name == "body_rate" else zero_order_hold
            made.append(Series(stamps, read(there, stamps)))
        simulated.append(_signals(made, mixer, even))
    return answers(recorded, simulated) if recorded else ()


def _signals(parts: Sequence[Series], mixer: MixerSettings, time: Array) -> Signals:
    """Return what a rate controller hears and says from set-points, gyro and commands."""
    wanted, rate, commands = (_at(part, time) for part in parts)
    torque = torque_of(mixer, tuple(commands.T))
    turned = np.array([1.0, -1.0, -1.0])  # FRD
    return Signals(
        step=float(time[1] - time[0]),
        error=(wanted[:, :3] - rate) * turned,
        rate=rate * turned,
        torque=np.column_stack([torque.x, torque.y, torque.z]),
    )


def _recorded(
    flight: Flight, model: Model, conditions: Mapping[str, Array], number: int
) -> Steps | None:
    """Return the steps of a recording, of the centre of mass in body axes through the air."""
    known = {"position", "attitude", "body_rate", "rotor_speed"} <= set(flight.series)
    if known:
        flight = replace(flight, series={**flight.series, **_of_body(flight.series, model)})
    steps = steps_of(flight)
    return None if steps is None else _through_air(steps, conditions, number)


def _of_body(series: Mapping[str, Series], model: Model) -> dict[str, Series]:
    """Return pose and velocity of the centre of mass, in body axes, from those of markers."""
    markers = markers_of(model.vehicle)
    attitude, position = series["attitude"], series["position"]
    turned, moved = Rotation.from_quat(attitude.values, scalar_first=True), {}
    if markers.turn is not None:
        tilt = Rotation.from_quat(np.array(markers.turn.stacked()), scalar_first=True)
        turned = turned * tilt.inv()
        moved["attitude"] = Series(attitude.time, turned.as_quat(scalar_first=True))
    if markers.offset is not None:
        offset = np.array(markers.offset.stacked())  # SciPy takes no array that is read-only
        arm = Series(attitude.time, turned.apply(offset))
        moved["position"] = _less(position, arm)
        if "velocity" in series and float(model.controller.sees_markers) > 0.5:
            rates = _at(series["body_rate"], attitude.time)
            swing = Series(attitude.time, turned.apply(np.cross(rates, offset)))
            moved["velocity"] = _less(series["velocity"], swing)
    return moved


def _at(series: Series, times: Array) -> Array:
    return np.column_stack([np.interp(times, series.time, column) for column in series.values.T])


def _less(series: Series, other: Series) -> Series:
    return Series(series.time, series.values - _at(other, series.time))


def _driven(
    commands: Mapping[int, Series], model: Model, environment: Environment, schedule: Schedule
) -> dict[int, Series]:
    """Return the rotor speeds that flights' commands ask for, late as the motors are."""
    if not commands:
        return {}
    late = float(model.vehicle.setup.actuator_latency)
    late += float(model.vehicle.effects.get("time_constant_second", 0.0))  # to first order
    values = np.concatenate([series.values for series in commands.values()])
    steps = [np.diff(series.time, prepend=series.time[0]) for series in commands.values()]
    found = _motor_answers(model.vehicle.motor, values, np.concatenate(steps)[:, None])
    ends = np.cumsum([len(series.time) for series in commands.values()])[:-1]
    answers = zip(*(np.split(np.asarray(part), ends) for part in found), strict=True)
    driven = {}
    for (number, series), (curve, up, down) in zip(commands.items(), answers, strict=True):
        time, asked = series.time, curve.copy()
        if environment.log_voltage is not None:
            volts = np.asarray(environment.log_voltage)[:, number]
            tick = np.clip((time * schedule.position_control_rate).astype(int), 0, len(volts) - 1)
            exponent = float(model.vehicle.effects["battery_exponent"])
            asked *= np.exp(exponent * volts[tick])[:, None]
        if environment.battery_decline is not None:
            decline = float(environment.battery_decline[number])
            asked *= 1.0 - decline * np.maximum(time, 0.0)[:, None]
        speeds = asked.copy()
        for row in range(1, len(asked)):
            before, now = asked[row - 1], speeds[row - 1]
            speeds[row] = before + np.where(before > now, up[row], down[row]) * (now - before)
        driven[number] = Series(time + late, speeds)
    return driven


@eqx.filter_jit
def _motor_answers(motor: Motor, commands: Array, steps: Array) -> tuple[Any, Any, Any]:
    """Return the speeds that commands ask for, and the shares of a difference that steps leave."""
    lag = Lag.over(motor, jnp.asarray(steps))
    return reference_speed(motor, jnp.asarray(commands)), lag.decay_up, lag.decay_down


def _through_air(part: Steps, conditions: Mapping[str, Array], number: int) -> Steps:
    x, y = (conditions.get(name, np.zeros(number + 1))[number] for name in ("wind_x", "wind_y"))
    wind = Vec3(np.asarray(x), np.asarray(y), np.zeros(()))
    motion = part.motion
    moved = Motion(motion.position, motion.velocity - wind, motion.attitude, motion.body_rate)
    return replace(part, motion=moved)


def _simulated(
    part: Steps,
    channels: Mapping[str, Array],
    conditions: Mapping[str, Array],
    number: int,
    rate: float,
) -> Steps:
    """Return the same steps as the fit flies them; nothing of them is unknown."""
    clock = np.arange(channels[MOTION].shape[1]) / rate

    def at(name: str) -> Array:
        return _at(Series(clock, channels[name][number]), part.time)

    rows, attitude, speeds = at(MOTION), at(TURNED), at(SPEEDS)
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    position, velocity, turning = (Vec3.of(rows[:, at].T) for at in _PARTS)
    motion = Motion(position, velocity, Quaternion.of(attitude.T), turning)
    flown = replace(
        part,
        motion=motion,
        rotor_speed=speeds,
        rotor_acceleration=np.gradient(speeds, part.step, axis=0),
        accelerations=np.zeros_like(part.accelerations),
    )
    return _through_air(flown, conditions, number)


_PARTS = (slice(0, 3), slice(3, 6), slice(6, 9))
