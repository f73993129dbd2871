"""Model error: a fit's problem with finer steps, other inputs, or errors of its model corrected.

The shift of the coefficients is a part of their standard errors. Recordings show the model's
errors: forces of omitted laws (`tuner.equation_error.omitted_laws`) then act on the simulated
flights, and the rate controller has the gains that recorded commands show
(`tuner.equation_error.rate_controller`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from sim_jax.control.gains import MixerSettings, RateGains
from sim_jax.control.mixer import torque_of
from sim_jax.environment import Disturbance, Environment
from sim_jax.frames import markers_of
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import ActuatorInlet, Inlet, MixedInlet, ReferenceInlet, RotorSpeedInlet
from sim_jax.motor import Lag, reference_speed
from sim_jax.rigid_body import Motion
from sim_jax.schedule import Schedule
from sim_jax.vehicle import Motor
from tuner.core.numerics import Array
from tuner.equation_error.omitted_laws import Law, find_omitted_laws
from tuner.equation_error.rate_controller import (
    AXES,
    PARTS,
    ControllerEstimate,
    Signals,
    estimate_controller,
    others_gains,
)
from tuner.equation_error.recorded_accelerations import MIN_SAMPLES, Mask, Steps, steps_of
from tuner.findings.findings import Code, Finding
from tuner.findings.sentences import CONTROLLER_FILE
from tuner.objective.battery import log_voltage_of, with_readings_redrawn
from tuner.objective.criterion import OFFSET_UNIT, Point
from tuner.objective.inlets import linear_interpolation, zero_order_hold
from tuner.objective.normal_equations import Objective
from tuner.objective.rotor_signals import leading_order
from tuner.objective.segments import CLOCK_OF, CLOCKS, stamped_earlier
from tuner.objective.simulation import (
    BODY_ATTITUDE,
    MOTION,
    SETPOINTS,
    TRUE_ROTOR_SPEED,
    SimulatedChannels,
    environment_of,
    fly,
)
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight, Series
from tuner.recordings.interpolation import with_gaps_filled
from tuner.search.findings import outlying_flights
from tuner.search.progress import Fit
from tuner.uncertainty.estimates import (
    INPUT,
    LIMIT,
    LIMIT_STEP,
    MIN_REPORTED_SPEED_LAG_S,
    READINGS,
    STEP,
    VOLTMETER_DRAWS,
    Uncertainty,
)
from tuner.vehicle.model import Model

MIN_REPORTED_SHIFT = 0.5
"""Least shift of a coefficient that is reported, in standard errors without it."""
_CHANNELS = ("position", "attitude", TRUE_ROTOR_SPEED, "body_rate", "command")
LOOP_SIGNALS = ("rate_setpoint", "body_rate", "command")
"""Recorded inputs and output of a rate controller."""
MIN_REPORTED_LATENCY_S = 1.5e-3
"""Least latency of a rate controller that is reported: stamps show the loop's period of a sample,
not its time within the period; half a period at 400 Hz is 1.25 ms."""
MIN_REPORTED_LAW_SHARE = 0.03
"""Least share of an axis' variation that a reported law explains."""
FAR_OFF_GAIN = 1.3
"""Factor on a gain from which the file is another controller's: a battery changes it by less."""
GAIN_AXES = {"rate_gain_roll_pitch": ("roll", "pitch"), "rate_gain_yaw": ("yaw",)}
"""Coefficient -> axes of the rate controller whose gains it scales."""


@dataclass(frozen=True)
class ModelErrors:
    """Errors of a fit's model that its recordings show.

    Attributes
    ----------
    laws
        Omitted laws, the likeliest first.
    disturbance
        Their forces and moments in every segment; None for no laws.
    controller
        Gains and latencies of the rate controller that differ from the file's, of all flights or
        of one.
    speed_lag
        s by which recorded rotor speeds lag behind the turning that they cause; 0 for none.
    gains
        Fitted coefficient of `GAIN_AXES` -> relative deviation of its estimate from recorded
        commands, its standard error subtracted.
    order
        Recorded column of motors, from 1, of each rotor, where they are in another order.
    """

    laws: tuple[Law, ...]
    disturbance: Disturbance | None
    controller: tuple[ControllerEstimate, ...] = ()
    speed_lag: float = 0.0
    gains: Mapping[str, float] = field(default_factory=dict)
    order: tuple[str, ...] = ()

    @property
    def or_none(self) -> ModelErrors | None:
        """None if there are no errors."""
        every = (self.laws, self.controller, self.speed_lag, self.gains, self.order)
        return self if any(every) else None

    def applied_to(self, objective: Objective) -> Objective:
        """Return a problem with these disturbances, gains, and stamps of rotor speeds."""
        segments, model = objective.segments, objective.model
        rate = model.controller.rate
        for estimate in self.controller:
            if not estimate.flight:
                rate = _with_gain(rate, estimate)
        pushed = replace(
            objective,
            segments=replace(segments, disturbance=self.disturbance),
            differentiated=self.disturbance is None,
            model=eqx.tree_at(lambda m: m.controller.rate, model, rate),
        )
        return _with_speeds_earlier(pushed, self.speed_lag) if self.speed_lag else pushed


def model_errors_of(fitted: Fit, flights: Sequence[Flight]) -> ModelErrors | None:
    """Return the errors of a fit's model; None if there are none, or they cannot be estimated.

    They are estimated from all flights but crashed ones and those of `outlying_flights`.

    Parameters
    ----------
    fitted
        A fit to whole flights in closed loop.
    flights
        The F fitted flights, in the order of the segments.
    """
    objective, point = fitted.objective, fitted.point
    segments, schedule = objective.segments, objective.schedule
    simulated, flights = _flown(fitted), _on_the_simulations_clock(fitted, flights)
    if simulated is None:
        return None
    flown, usable = simulated
    model, conditions = objective.model_at(point.coefficients), objective.conditions_at(point)
    environment = environment_of(model, segments, conditions)
    driven = [not flight.has_tachometers for flight in flights]
    commands = {
        number: flight.series["command"]
        for number, flight in enumerate(flights)
        if driven[number] and "command" in flight.series
    }
    speeds = _commanded_speeds(commands, model, environment, schedule)
    tachometer_lag = float(model.vehicle.effects.get("tachometer_lag", 0.0))  # to first order
    read = []
    for number, flight in enumerate(flights):
        series = dict(flight.series)
        if number in speeds:
            series["rotor_speed"] = speeds[number]
        elif tachometer_lag and "rotor_speed" in series:
            lagging = series["rotor_speed"]
            series["rotor_speed"] = Series(lagging.time - tachometer_lag, lagging.values)
        read.append(_recorded(replace(flight, series=series), model, conditions, number))
    rate = float(schedule.log_rate)
    loops = _loops_of(flights, flown, model.controller.mixer, rate, usable)
    if order := _order_of_motors(loops, model.controller.mixer):
        return ModelErrors((), None, order=order)
    estimates = _controller_estimates(loops)
    differing = tuple(estimate for estimate in estimates if estimate.differs)
    gain_shifts = {}
    for name in set(GAIN_AXES) & set(objective.space.names):
        if (gain := gain_by_commands(name, estimates)) is not None and abs(gain[0] - 1.0) > gain[1]:
            gain_shifts[name] = float(np.sqrt((gain[0] - 1.0) ** 2 - gain[1] ** 2))
    pairs = {
        number: (one, _simulated(one, flown.channels, conditions, number, rate), by_command)
        for number, (one, by_command) in enumerate(zip(read, driven, strict=True))
        if one is not None and usable[number]
    }
    if not pairs:
        return ModelErrors((), None, differing, gains=gain_shifts).or_none
    scaled = np.asarray(objective.space.scaled(point.coefficients))
    parameters = objective.space.parameters
    found = find_omitted_laws(model, parameters, scaled, tuple(pairs.values()))
    if not found.laws:
        return ModelErrors((), None, differing, found.speed_lag, gain_shifts).or_none
    body = model.vehicle.body
    by = np.array([*[body.mass] * 3, body.inertia_xx, body.inertia_yy, body.inertia_zz], float)
    ticks = np.arange(objective.samples + 2) / rate
    pushes = np.zeros((6, len(ticks), segments.count))
    for (number, (one, *_)), of_laws in zip(pairs.items(), found.accelerations, strict=True):
        acting = of_laws * by
        acting[:, :3] = Rotation.from_quat(
            np.asarray(one.motion.attitude.stacked()).T, scalar_first=True
        ).apply(acting[:, :3])
        pushes[..., number] = linear_interpolation(Series(one.time, acting), ticks).T
    force, moment = (Vec3(*map(jnp.asarray, rows)) for rows in (pushes[:3], pushes[3:]))
    pushed = Disturbance(force=force, moment=moment, rate=rate)
    return ModelErrors(found.laws, pushed, differing, found.speed_lag, gain_shifts)


def answers_of(fitted: Fit, flights: Sequence[Flight]) -> tuple[ControllerEstimate, ...]:
    """Return the estimates of the rate controller that differ; arguments of `model_errors_of`."""
    estimates = _controller_estimates(_loops_in(fitted, flights))
    return tuple(estimate for estimate in estimates if estimate.differs)


def _loops_in(fitted: Fit, flights: Sequence[Flight]) -> list[_Loop]:
    """Return the rate loops of a fit's flights; none where they are not flown whole."""
    simulated, objective = _flown(fitted), fitted.objective
    if simulated is None:
        return []
    flights = _on_the_simulations_clock(fitted, flights)
    mixer, rate = objective.model.controller.mixer, float(objective.schedule.log_rate)
    return _loops_of(flights, simulated[0], mixer, rate, simulated[1])


def _on_the_simulations_clock(fitted: Fit, flights: Sequence[Flight]) -> tuple[Flight, ...]:
    """Return the fitted flights with each clock's stamps as early as the fit found it late."""
    late = np.asarray(fitted.point.offsets)[: len(CLOCKS)] * OFFSET_UNIT
    moved = list(flights)
    for number, flight in enumerate(flights):
        for clock, seconds in enumerate(late[:, number].tolist()):
            stamped = [name for name in flight.series if CLOCK_OF.get(name) == clock]
            moved[number] = stamped_earlier(moved[number], stamped, seconds)
    return tuple(moved)


def _flown(fitted: Fit) -> tuple[SimulatedChannels, Mask] | None:
    """Return a fit's flights as simulated, and which (F,) show errors; None if not flown whole."""
    objective, segments = fitted.objective, fitted.objective.segments
    if segments.windowed or not isinstance(segments.inlet, ReferenceInlet):
        return None
    flown = fly(
        objective.model,
        segments,
        objective.schedule,
        samples=objective.samples,
        limits=objective.limits,
        coefficients=objective.space.values(np.asarray(fitted.point.coefficients)),
        states=fitted.criterion.states,
        conditions=objective.conditions_at(fitted.point),
        channels=(*_CHANNELS, MOTION, BODY_ATTITUDE, SETPOINTS),
    )
    odd = outlying_flights(fitted.scales)
    usable = ~np.isfinite(np.asarray(flown.crash_time))
    usable[[number for number, name in enumerate(fitted.scales) if name in odd]] = False
    return flown, usable


def gain_by_commands(
    name: str, controller: Sequence[ControllerEstimate]
) -> tuple[float, float] | None:
    """Return a coefficient of `GAIN_AXES` by recorded commands over the fit's, and its error.

    None where one of its axes has no estimate.
    """
    those = [
        one
        for one in controller
        if one.part == "P" and one.axis in GAIN_AXES[name] and not one.flight
    ]
    if len(those) < len(GAIN_AXES[name]):
        return None
    weights = np.array([one.sd**-2.0 for one in those])
    value = float(np.average([one.value for one in those], weights=weights))
    return value, float(weights.sum() ** -0.5)


def alternatives_of(
    objective: Objective, point: Point, flights: Sequence[Flight] = ()
) -> dict[str, Objective]:
    """Return the name of a source of error -> the problem simulated with it changed.

    Where a recording is fed in step by step, physics keeps its steps.

    Parameters
    ----------
    flights
        Whole flights, whose voltmeter readings are drawn again if the fit has a battery; none to
        leave that out.
    """
    limited, finer = _with_lower_limit(objective), in_half_steps(objective)
    if finer is None:
        return limited | _with_recorded_rotors(objective, flights)
    return {STEP: finer, **limited, **with_other_readings(objective, point, flights)}


def in_half_steps(objective: Objective) -> Objective | None:
    """Return the problem simulated in steps half as long; None where a recording is fed in."""
    if not isinstance(objective.segments.inlet, ReferenceInlet):
        return None
    schedule = objective.schedule
    finer = replace(schedule, physics_rate=2 * schedule.physics_rate)
    return replace(objective, schedule=finer, differentiated=False)


def _with_lower_limit(objective: Objective) -> dict[str, Objective]:
    """Return the problem with a lower limit of rotor speeds, if no recording has rotor speeds.

    Without them only the limit separates the rotors' speeds from their constants.
    """
    segments, model = objective.segments, objective.model
    if "rotor_speed" in segments.measured or isinstance(segments.inlet, RotorSpeedInlet):
        return {}
    lower = (1.0 - LIMIT_STEP) * model.vehicle.motor.max_rotor_velocity
    limited = eqx.tree_at(lambda m: m.vehicle.motor.max_rotor_velocity, model, lower)
    return {LIMIT: replace(objective, model=limited)}


def _with_recorded_rotors(objective: Objective, flights: Sequence[Flight]) -> dict[str, Objective]:
    """Return the problem fed with recorded rotor speeds instead of commands, if it has both.

    Between samples commands are not known; rotors move less there.
    """
    segments, inlet = objective.segments, objective.segments.inlet
    parts = inlet.parts if isinstance(inlet, MixedInlet) else (inlet,)
    kind = np.broadcast_to(getattr(inlet, "kind", 0), segments.count)
    by_command = np.array([isinstance(part, ActuatorInlet) for part in parts])
    whose = np.asarray(segments.flight)[by_command[kind]]
    if not (len(flights) and len(whose) and all(flights[n].has("rotor_speed") for n in whose)):
        return {}

    def with_rotors(part: Inlet) -> Inlet:
        if not isinstance(part, ActuatorInlet):
            return part
        clock = np.arange(len(part.command[0])) / objective.schedule.physics_rate
        speeds = np.zeros((len(part.command), len(clock), segments.count))
        for number in np.flatnonzero(by_command[kind]):
            read = with_gaps_filled(flights[int(segments.flight[number])].series["rotor_speed"])
            speeds[..., number] = linear_interpolation(read, clock + segments.begins[number]).T
        return RotorSpeedInlet(tuple(speeds))

    swapped = tuple(map(with_rotors, parts))
    fed = eqx.tree_at(lambda i: i.parts, inlet, swapped) if len(parts) > 1 else swapped[0]
    fed_in = replace(segments, inlet=fed)
    return {INPUT: replace(objective, segments=fed_in, differentiated=False)}


def _with_speeds_earlier(objective: Objective, seconds: float) -> Objective:
    """Return a problem with the stamps of rotor speeds moved to earlier."""
    measured = dict(objective.segments.measured)
    if "rotor_speed" in measured:
        speeds = measured["rotor_speed"]
        measured["rotor_speed"] = eqx.tree_at(lambda m: m.time, speeds, speeds.time - seconds)
    return replace(objective, segments=replace(objective.segments, measured=measured))


def with_other_readings(
    objective: Objective, point: Point, flights: Sequence[Flight]
) -> dict[str, Objective]:
    """Return problems with voltmeter readings drawn again, if a fit of whole flights uses them."""
    segments = objective.segments
    vehicle = objective.model_at(point.coefficients).vehicle
    matters = bool(float(vehicle.effects.get("battery_exponent", 0.0)))
    if not flights or segments.windowed or segments.log_voltage is None or not matters:
        return {}
    windows = [Window(flight, 0.0) for flight in flights]
    as_read = log_voltage_of(flights, windows, objective.schedule)
    assert as_read is not None, "the segments have a voltage"
    random, others = np.random.default_rng(0), {}
    for number in range(VOLTMETER_DRAWS):
        again = log_voltage_of(with_readings_redrawn(flights, random), windows, objective.schedule)
        assert again is not None, "there is a voltmeter"
        other = replace(segments, log_voltage=segments.log_voltage + (again - as_read))
        others[f"{READINGS} {number}"] = replace(objective, segments=other)
    return others


def model_error_findings(
    model_errors: ModelErrors | None, uncertainty: Uncertainty
) -> Iterator[Finding]:
    """Return the findings on model errors; on omitted laws only if these may move coefficients."""
    if model_errors is None:
        return
    if model_errors.order:
        yield Code.MOTOR_ORDER.warning("motors", *model_errors.order)
    yield from _controller_findings(
        one
        for one in model_errors.controller
        if one.part != "late" or abs(one.value) > MIN_REPORTED_LATENCY_S
    )
    if abs(model_errors.speed_lag) > MIN_REPORTED_SPEED_LAG_S:
        yield Code.ROTOR_SPEEDS_LATE.warning("rotor speeds", seconds=model_errors.speed_lag)
    moved = [
        name
        for name, estimate in uncertainty.estimates.items()
        if (move := estimate.parts.lack)
        and move**2 > MIN_REPORTED_SHIFT**2 * (estimate.std_error**2 - move**2)
    ]
    for law in model_errors.laws:
        if moved and abs(law.share) > MIN_REPORTED_LAW_SHARE:
            yield Code.LAW_LACKING.warning("model", law.axis, law.feature, *moved, share=law.share)


def gains_far_off(fitted: Fit, flights: Sequence[Flight]) -> Iterator[Finding]:
    """Yield findings on motors in another order, or gains far from the file's.

    Arguments are those of `model_errors_of`.

    An axis is left out whose simulated signals show far less than the file's P: motors clip. A fit
    that is not at its minimum may spin a vehicle that it cannot turn.
    """
    controller = fitted.objective.model.controller
    loops = _loops_in(fitted, flights)
    if order := _order_of_motors(loops, controller.mixer):
        yield Code.MOTOR_ORDER.warning("motors", *order)
        return
    gains = np.asarray(controller.rate.p.stacked() * controller.rate.k.stacked())
    of_file = dict(zip(AXES, gains, strict=True))
    yield from _controller_findings(
        one
        for one in _controller_estimates(loops)
        if one.differs
        and one.part != "late"
        and not 1.0 / FAR_OFF_GAIN < one.value < FAR_OFF_GAIN
        and not one.simulated_p * FAR_OFF_GAIN < of_file[one.axis]
    )


def _controller_findings(controller: Iterable[ControllerEstimate]) -> Iterator[Finding]:
    alike: dict[tuple[str, str], list[ControllerEstimate]] = {}
    for one in sorted(controller, key=lambda one: PARTS.index(one.part)):
        alike.setdefault((one.flight, one.part), []).append(one)
    for (flight, part), those in alike.items():
        numbers: dict[str, float] = {}
        for one in those:
            numbers |= {one.axis: one.value, f"{one.axis}_error": one.sd}
        yield Code.CONTROLLER_ANSWERS.warning(
            flight or CONTROLLER_FILE, part, *(one.axis for one in those), **numbers
        )


def _with_gain(gains: RateGains, estimate: ControllerEstimate) -> RateGains:
    """Return the gains with one estimate applied; a latency, after P, acts like less D."""
    axis = "xyz"[AXES.index(estimate.axis)]

    def scaled(gain: Vec3) -> Vec3:
        return replace(gain, **{axis: estimate.value * getattr(gain, axis)})

    if estimate.part == "P":
        return replace(gains, p=scaled(gains.p), d=scaled(gains.d))
    if estimate.part == "I":
        return replace(gains, i=scaled(gains.i))
    less_d = getattr(gains.d, axis) - estimate.value * getattr(gains.p, axis)
    return replace(gains, d=replace(gains.d, **{axis: less_d}))


class _Loop(NamedTuple):
    """A flight's rate loop as recorded and as simulated: signals, and commands (N, 4)."""

    flight: str
    recorded: Signals
    simulated: Signals
    commands: tuple[Array, Array]


def _loops_of(
    flights: Sequence[Flight],
    flown: SimulatedChannels,
    mixer: MixerSettings,
    rate: float,
    usable: Mask,
) -> list[_Loop]:
    """Return the rate loops of the flights that recorded them; ``usable`` (F,) are those to use."""
    loops = []
    for number, flight in enumerate(flights):
        series = flight.series
        known = set(LOOP_SIGNALS) <= set(series)
        if not (known and usable[number]):
            continue
        clock = np.arange(flown.channels["command"].shape[1]) / rate
        time = series["command"].time
        time = time[(time >= 0.0) & (time <= clock[-1])]
        if len(time) < MIN_SAMPLES or not all(
            np.isfinite(series[name].values).all() for name in LOOP_SIGNALS
        ):
            continue
        even = np.linspace(time[0], time[-1], len(time))
        told = [series[name] for name in LOOP_SIGNALS]
        made = []
        for name, channel in zip(LOOP_SIGNALS, (SETPOINTS, "body_rate", "command"), strict=True):
            stamps = series[name].time  # sampled as the recording
            stamps = stamps[(stamps >= 0.0) & (stamps <= clock[-1])]
            there = Series(clock, flown.channels[channel][number])
            # outputs of a loop hold until it runs again; a body rate is continuous
            read = linear_interpolation if name == "body_rate" else zero_order_hold
            made.append(Series(stamps, read(there, stamps)))
        commands = [linear_interpolation(parts[-1], even) for parts in (told, made)]
        recorded, simulated = (_signals(parts, mixer, even) for parts in (told, made))
        loops.append(_Loop(flight.name, recorded, simulated, (commands[0], commands[1])))
    return loops


def _order_of_motors(loops: Sequence[_Loop], mixer: MixerSettings) -> tuple[str, ...]:
    """Return the recorded column, from 1, of each rotor; empty for its own order or no clear one.

    Simulated rotors are in the vehicle's order, and answer the same manoeuvres: columns in another
    order make torques of roll and pitch that are not those.
    """
    if not loops:
        return ()

    def torques(all_commands: Iterable[Array], columns: Sequence[int]) -> Array:
        parts = []
        for commands in all_commands:
            torque = torque_of(mixer, tuple(commands[:, columns].T))
            both = np.column_stack([torque.x, torque.y])
            parts.append(both - both.mean(axis=0))
        return np.concatenate(parts)

    own = tuple(range(4))
    made = torques((loop.commands[1] for loop in loops), own)

    def alike(columns: Sequence[int]) -> float:
        told = torques((loop.commands[0] for loop in loops), columns)
        sizes = np.sqrt((told * told).sum(axis=0) * (made * made).sum(axis=0))
        return float(((told * made).sum(axis=0) / np.maximum(sizes, 1e-300)).min())

    best = leading_order(alike)
    return tuple(str(1 + column) for column in best) if best and best != own else ()


def _controller_estimates(loops: Sequence[_Loop]) -> tuple[ControllerEstimate, ...]:
    """Return the estimates of recorded rate controllers relative to those of the fit.

    A flight with another P than the others' is estimated by itself.
    """
    if not loops:
        return ()
    names = [loop.flight for loop in loops]
    recorded, simulated = [loop.recorded for loop in loops], [loop.simulated for loop in loops]
    odd = others_gains(recorded, simulated)
    rest = [number for number in range(len(recorded)) if number not in odd]
    alike = estimate_controller(
        [recorded[number] for number in rest], [simulated[number] for number in rest]
    )
    return (
        *alike,
        *(
            answer._replace(flight=names[number])
            for number in odd
            for answer in estimate_controller([recorded[number]], [simulated[number]])
            if answer.part == "P"
        ),
    )


def _signals(parts: Sequence[Series], mixer: MixerSettings, time: Array) -> Signals:
    """Return a rate controller's inputs and outputs from set-points, gyro and commands."""
    wanted, rate, commands = (linear_interpolation(part, time) for part in parts)
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
    """Return the steps of a recording: motion of the centre of mass relative to the air."""
    known = {"position", "attitude", "body_rate", "rotor_speed"} <= set(flight.series)
    if known:
        flight = replace(
            flight, series={**flight.series, **_of_centre_of_mass(flight.series, model)}
        )
    steps = steps_of(flight)
    return None if steps is None else _relative_to_air(steps, conditions, number)


def _of_centre_of_mass(series: Mapping[str, Series], model: Model) -> dict[str, Series]:
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
        moved["position"] = _difference(position, arm)
        if "velocity" in series and float(model.controller.sees_markers) > 0.5:
            rates = linear_interpolation(series["body_rate"], attitude.time)
            swing = Series(attitude.time, turned.apply(np.cross(rates, offset)))
            moved["velocity"] = _difference(series["velocity"], swing)
    return moved


def _difference(series: Series, other: Series) -> Series:
    return Series(series.time, series.values - linear_interpolation(other, series.time))


def _commanded_speeds(
    commands: Mapping[int, Series], model: Model, environment: Environment, schedule: Schedule
) -> dict[int, Series]:
    """Return the rotor speeds that the motors reach by flights' commands."""
    if not commands:
        return {}
    delay = float(model.vehicle.setup.actuator_latency)
    delay += float(model.vehicle.effects.get("time_constant_second", 0.0))  # to first order
    values = np.concatenate([series.values for series in commands.values()])
    steps = [np.diff(series.time, prepend=series.time[0]) for series in commands.values()]
    found = _motor_response(model.vehicle.motor, values, np.concatenate(steps)[:, None])
    ends = np.cumsum([len(series.time) for series in commands.values()])[:-1]
    responses = zip(*(np.split(np.asarray(part), ends) for part in found), strict=True)
    driven = {}
    for (number, series), (curve, up, down) in zip(commands.items(), responses, strict=True):
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
        driven[number] = Series(time + delay, speeds)
    return driven


@eqx.filter_jit
def _motor_response(motor: Motor, commands: Array, steps: Array) -> tuple[Any, Any, Any]:
    """Return commanded speeds, and the shares of a difference left after each step."""
    lag = Lag.over(motor, jnp.asarray(steps))
    return reference_speed(motor, jnp.asarray(commands)), lag.decay_up, lag.decay_down


def _relative_to_air(part: Steps, conditions: Mapping[str, Array], number: int) -> Steps:
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
    """Return the same steps as the fit simulates them."""
    clock = np.arange(channels[MOTION].shape[1]) / rate

    def at(name: str) -> Array:
        return linear_interpolation(Series(clock, channels[name][number]), part.time)

    rows, attitude, speeds = at(MOTION), at(BODY_ATTITUDE), at(TRUE_ROTOR_SPEED)
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    position, velocity, turning = (Vec3.of(rows[:, at].T) for at in _MOTION_PARTS)
    motion = Motion(position, velocity, Quaternion.of(attitude.T), turning)
    flown = replace(
        part,
        motion=motion,
        rotor_speed=speeds,
        rotor_acceleration=np.gradient(speeds, part.step, axis=0),
        accelerations=np.zeros_like(part.accelerations),
    )
    return _relative_to_air(flown, conditions, number)


_MOTION_PARTS = (slice(0, 3), slice(3, 6), slice(6, 9))
