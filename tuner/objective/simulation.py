"""Simulation of segments by a compiled kernel: initial state, inputs and recorded channels.

The function `_flight` flies one segment; `lanes` flies many side by side. A program belongs to what
is simulated (inlet, rates, terms, what is compared), not to how many segments there are, how long
they last or which coefficients are free.
"""

from __future__ import annotations

import weakref
from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Float

from lanes import Argument, Program, program_of
from sim_jax import terms
from sim_jax.environment import Air, Disturbance, Environment
from sim_jax.frames import gyro_of, markers_of
from sim_jax.geometry import Vec3
from sim_jax.inlet import Inlet
from sim_jax.numeric import Array as JaxArray
from sim_jax.plant import Sample
from sim_jax.rigid_body import Motion
from sim_jax.rollout import start_simulation
from sim_jax.schedule import Schedule
from sim_jax.state import Limits, Start, State
from sim_jax.trim import trimmed_start
from sim_jax.vehicle import PerRotor, Vehicle
from tuner.core.numerics import Array
from tuner.objective.battery import relative_log_voltage
from tuner.objective.initial_conditions import (
    ROWS,
    rotor_trim,
    with_all_rows,
    with_change,
    with_commanded_rotors,
)
from tuner.objective.segments import Segments
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.model import Model, coefficients_in, with_coefficients, with_terms_computed

MOTION, BODY_ATTITUDE, TRUE_ROTOR_SPEED, SETPOINTS = "motion", "turned", "speeds", "setpoints"
"""Channels that no recording has: the centre of mass's position, velocity and body rate; the body's
attitude; the true rotor speeds; and the set-points of rate and thrust."""

_UNMEASURED = (MOTION, BODY_ATTITUDE, TRUE_ROTOR_SPEED, SETPOINTS)
LOGGED = ("position", "attitude", "body_rate", "rotor_speed", "command", *_UNMEASURED)
"""Channels of every program, those that no recording has without derivatives; those that are not
requested are not written."""
EFFECTS = tuple(name for name, row in COEFFICIENTS.items() if row.is_effect)
TERMS = tuple(name for name in EFFECTS if COEFFICIENTS[name].group)
"""Coefficients beyond the base model, and those of them that a fit may add."""
TORQUE_RATE_HZ = 100.0
"""Of the ticks of a predicted torque. Where values alone are computed with terms it is zero: one
program serves flights with such a torque and without."""
CODE = ("sim_jax", "tuner")
"""Packages whose code is run while a program of this one is traced."""


class SimulatedChannels(NamedTuple):
    """Simulated channels at ``schedule.log_rate``; the pose is the markers'.

    Attributes
    ----------
    channels
        Channel -> (F, samples, c).
    columns
        Channel -> (F, Q, samples, c) derivatives, as of a `lanes.ProgramResults`; None
        where nothing moves.
    crash_time
        (F,) s, infinite for a segment that flew.
    """

    channels: dict[str, Array]
    columns: dict[str, Array | None]
    crash_time: Array


class _FlightArguments(NamedTuple):
    """Input of a program: a model and one segment."""

    model: Model
    coefficients: dict[str, Any]
    segments: Segments
    states: Any
    conditions: dict[str, Any]


def fly(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    samples: int,
    limits: Limits,
    coefficients: Mapping[str, Any] = MappingProxyType({}),
    states: Array | None = None,
    conditions: Mapping[str, Any] = MappingProxyType({}),
    tangents: Mapping[str, Array] | None = None,
    channels: tuple[str, ...] | None = None,
    differentiated: bool = False,
) -> SimulatedChannels:
    """Fly segments.

    Parameters
    ----------
    model, schedule, limits
        What flies.
    segments
        F of them.
    samples
        Number of logged samples.
    coefficients
        Name -> value that replaces the model's: a number, or (F,) each segment's own.
    states
        (L, F) deviation of the starts from the recorded ones, in the segments' standard deviations.
    conditions
        Name -> (F,) per-flight conditions, in their units.
    tangents
        Directions along which is differentiated: coefficient or condition -> (Q,), and
        ``"states"`` -> (Q, L). None differentiates by nothing.
    channels
        Channels to log; by default the measured ones.
    differentiated
        Whether the program with derivatives flies without tangents, too: a fit has built it.
    """
    given, program, logged = _prepared(
        model,
        segments,
        schedule,
        limits=limits,
        coefficients=coefficients,
        states=states,
        conditions=conditions,
        channels=channels,
        moves=differentiated or tangents is not None,
    )
    names = tuple(segments.measured) if channels is None else channels
    asked = {name: name in names for name in logged}
    run = program(
        given,
        None if tangents is None else _directions(given, tangents),
        lanes=given.segments.count,
        turns=samples,
        wanted=(asked, True) if tangents is None else ((asked, True), (asked, False)),
    )
    found, crash_time = run.values
    still: dict[str, Array | None] = dict.fromkeys(names)
    return SimulatedChannels(
        {name: found[name] for name in names},
        still if run.columns is None else run.columns[0],
        crash_time,
    )


def flight_program(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    limits: Limits,
    with_terms: bool,
    moves: bool,
) -> Program:
    """Return the program by which `fly` flies, with derivatives if it ``moves``.

    It is that of the base model or, ``with_terms``, the one of any terms beyond it.
    """
    model = replace(model, vehicle=replace(model.vehicle, effects={}))
    calm = {"wind_x": np.zeros(segments.count)} if with_terms else {}
    return _prepared(model, segments, schedule, limits=limits, conditions=calm, moves=moves)[1]


def _prepared(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    limits: Limits,
    coefficients: Mapping[str, Any] = MappingProxyType({}),
    states: Array | None = None,
    conditions: Mapping[str, Any] = MappingProxyType({}),
    channels: tuple[str, ...] | None = None,
    moves: bool,
) -> tuple[_FlightArguments, Program, tuple[str, ...]]:
    """Return the input of a program, the program, and the channels that it logs."""
    several = any(np.ndim(value) for value in coefficients.values())
    structure = _ProgramStructure(
        schedule, limits, tuple(coefficients), tuple(conditions), channels, several, moves
    )
    key = id(model), id(segments), structure
    fixed = _PREPARED.get(key)
    if fixed is None or fixed.owner is not model:
        fixed = _PreparedProgram.of(model, segments, structure)
        if len(_PREPARED) >= MAX_PREPARED:
            _PREPARED.clear()
        _PREPARED[key] = fixed
        weakref.finalize(segments, _PREPARED.pop, key, None).atexit = False
    given = fixed.given
    values = {
        name: np.asarray(coefficients.get(name, value), float)
        for name, value in given.coefficients.items()
    }
    if structure.own:
        values = {name: np.broadcast_to(v, (segments.count,)) for name, v in values.items()}
    given = given._replace(coefficients=values, conditions={**given.conditions, **conditions})
    if states is not None and given.states is not None:
        given = given._replace(states=states)
    return given, fixed.program, fixed.logged


class _ProgramStructure(NamedTuple):
    """What a program depends on besides a model and segments.

    ``several`` is whether segments have coefficients of their own.
    """

    schedule: Schedule
    limits: Limits
    coefficients: tuple[str, ...]
    conditions: tuple[str, ...]
    channels: tuple[str, ...] | None
    several: bool
    moves: bool

    @property
    def own(self) -> bool:
        """Whether the program takes coefficients of each segment's own."""
        return self.several or not self.moves


class _PreparedProgram(NamedTuple):
    """A program, and of its input what is the same at every point.

    Attributes
    ----------
    owner
        The model that was given: as long as it is there, no other one has its place.
    """

    owner: Model
    given: _FlightArguments
    program: Program
    logged: tuple[str, ...]

    @staticmethod
    def of(model: Model, segments: Segments, structure: _ProgramStructure) -> _PreparedProgram:
        """Lay out a program for a model and segments."""
        owner, still = model, np.zeros(segments.count)
        calm = dict.fromkeys(structure.conditions, still)
        free = {*model.vehicle.effects, *structure.coefficients}
        if structure.conditions or free.intersection(EFFECTS):
            model, segments = _with_all_terms(model, segments)
            calm = dict.fromkeys(("wind_x", "wind_y", "battery_decline"), still) | calm
            if not structure.moves and segments.disturbance is None:
                zero = Vec3(*np.zeros((3, 1, segments.count)))
                segments = replace(
                    segments, disturbance=Disturbance(moment=zero, rate=TORQUE_RATE_HZ)
                )
        else:  # nothing reads the voltage: recordings with and without it share a program
            model = replace(model, reference_voltage=None)
            segments = replace(segments, log_voltage=None)
        names = tuple(segments.measured) if structure.channels is None else structure.channels
        # in one order, for it tells programs apart
        logged = tuple(sorted({*LOGGED, *names}))
        none = np.zeros((len(segments.free_rows), segments.count))
        if segments.start_sd is None and segments.free_rows:
            # as if they were free: one program serves both
            segments = replace(segments, start_sd=none)
        shape = (segments.count,) if structure.own else ()
        values = dict.fromkeys(structure.coefficients, np.zeros(())) | coefficients_in(model)
        given = _FlightArguments(
            model=jax.tree.map(np.asarray, model),
            coefficients={
                name: np.broadcast_to(np.asarray(value, float), shape)
                for name, value in values.items()
            },
            segments=flown_part(segments),
            states=None if segments.start_sd is None else none,
            conditions=calm,
        )
        arguments = _arguments(given, own_coefficients=structure.own, moves=structure.moves)
        static = (structure.schedule, structure.limits, logged)
        program = program_of(
            _flight,
            arguments,
            *static,
            name="flight of a segment",
            made_of=(static, structure.moves, terms.TERMS),
            packages=CODE,
        )
        return _PreparedProgram(owner, given, program, logged)


MAX_PREPARED = 16
"""Most layouts that are kept: a stage of a fit takes turns with two."""
_PREPARED: dict[tuple[Any, ...], _PreparedProgram] = {}
"""What was laid out for segments that are still there: a fit asks for the same at every point."""


def _with_all_terms(model: Model, segments: Segments) -> tuple[Model, Segments]:
    """Return model and segments with all terms, at neutral values.

    So two programs serve all vehicles: one of the base model, and one of any terms beyond it,
    whether or not the battery's voltage was recorded.
    """
    if segments.log_voltage is None or model.reference_voltage is None:
        model = replace(model, reference_voltage=np.asarray(1.0))
        segments = replace(segments, log_voltage=np.full((1, segments.count), np.nan))
    return with_terms_computed(model, TERMS), segments


def flown_part(segments: Segments) -> Segments:
    """Return the part of segments that is simulated, without measurements."""
    flown: Segments = replace(segments, measured={}, flight=np.zeros(segments.count, int))
    return flown


def _arguments(given: _FlightArguments, *, own_coefficients: bool, moves: bool) -> _FlightArguments:
    """Return the layout of each leaf: segments along the last axis, except for shared ones."""
    each = partial(Argument.of, lanes=True, moves=moves)
    return _FlightArguments(
        model=jax.tree.map(partial(Argument.of, lanes=False), given.model),
        coefficients=jax.tree.map(
            partial(Argument.of, lanes=own_coefficients, moves=moves), given.coefficients
        ),
        segments=laid_out(given.segments),
        states=jax.tree.map(each, given.states),
        conditions=jax.tree.map(each, given.conditions),
    )


def laid_out(segments: Segments) -> Any:
    """Return the layout of each leaf of the simulated part of segments."""

    def each(leaf: Any, name: str | None = None) -> Argument:
        made = Argument.of(leaf, lanes=True)
        return replace(made, shape=(name, *made.shape[1:])) if name else made

    volts = jax.tree.map(partial(each, name="volts"), segments.log_voltage)
    pushes = jax.tree.map(partial(each, name="pushes"), segments.disturbance)
    return eqx.tree_at(
        lambda s: [s.inlet, s.log_voltage, s.disturbance],
        jax.tree.map(each, segments),
        [_tables(segments.inlet), volts, pushes],
        is_leaf=lambda leaf: leaf is None or isinstance(leaf, Argument),
    )


def _tables(inlet: Inlet) -> Inlet:
    """Return how an inlet's leaves are laid out: those of more than one axis are tables in time.

    Tables of one length share a name that does not tell the length.
    """
    names: dict[int, str] = {}

    def of(leaf: Any) -> Argument:
        made = Argument.of(leaf, lanes=True)
        if not made.shape:
            return made
        name = names.setdefault(int(made.shape[0]), f"rows {len(names)}")
        return replace(made, shape=(name, *made.shape[1:]))

    tables: Inlet = jax.tree.map(of, inlet)
    return tables


def _directions(given: _FlightArguments, tangents: Mapping[str, Array]) -> list[Array]:
    """Return the tangents of all differentiated leaves, in their order."""
    count = len(next(iter(tangents.values())))
    still = np.zeros(count)
    moved = [tangents.get(name, still) for name in sorted(given.coefficients)]
    if given.states is not None:
        moved.append(tangents.get("states", np.zeros((count, len(given.states)))))
    return [*moved, *(tangents.get(name, still) for name in sorted(given.conditions))]


def _flight(
    schedule: Schedule,
    limits: Limits,
    channels: tuple[str, ...],
    given: _FlightArguments,
    lengths: Mapping[str, int],
) -> tuple[dict[str, Any], Any]:
    """Fly one segment: channel -> (samples, c), and the time of a crash."""
    model = with_coefficients(given.model, given.coefficients)
    parts: tuple[Start, Inlet, Environment] = beginning_of(
        model, given.segments, schedule, states=given.states, conditions=given.conditions
    )
    start, inlet, environment = parts
    plant, first = start_simulation(
        model.vehicle,
        model.controller,
        schedule,
        inlet,
        start,
        environment=environment,
        limits=limits,
    )

    def sample(state: State, number: Any) -> tuple[State, dict[str, Any]]:
        after, row = plant.sample(state, number)
        seen = recorded_of(row, model, environment, given.conditions, channels)
        return after, {**seen, **{name: lax.stop_gradient(seen[name]) for name in _UNMEASURED}}

    begin = replace(_moving(first), crash_time=first.crash_time)
    last, logged = lax.scan(sample, begin, jnp.arange(lengths["turns"]))
    return logged, last.crash_time


@jax.custom_jvp
def _moving(state: State) -> State:
    """Return a state as it is, with a derivative, if it is zero, for each of its numbers.

    A loop into which some of them enter without one is differentiated once more.
    """
    return state


_moving.defjvp(lambda state, moved: (state[0], moved[0]))


def recorded_of(
    log: Sample,
    model: Model,
    environment: Environment,
    conditions: Mapping[str, Float[JaxArray, " *F"]],
    channels: Collection[str],
) -> dict[str, JaxArray]:
    """Return channel -> the values that a recording of logged samples would have, columns last.

    Parameters
    ----------
    log
        Leaves (*samples, *F), or those of one sample.
    model, environment, conditions
        As they were flown.
    channels
        Which are asked for.
    """
    motion, parts = log.motion, jax.tree.leaves
    position, attitude = markers_of(model.vehicle).recorded(motion)
    rate = gyro_of(model.vehicle).reading(motion.body_rate)
    logged = {
        "position": parts(position),
        "attitude": parts(attitude),
        "body_rate": parts(rate),
        "rotor_speed": log.rotor_speed if log.read_speed is None else log.read_speed,
        "command": log.command,
        MOTION: parts((motion.position, motion.velocity, motion.body_rate)),
        TRUE_ROTOR_SPEED: log.rotor_speed,
        BODY_ATTITUDE: parts(motion.attitude),
        SETPOINTS: (*parts(log.setpoints.rate), log.setpoints.thrust),
    }
    if "acceleration" in channels:
        logged["acceleration"] = accelerometer(
            model.vehicle, motion, log.rotor_speed, environment, conditions
        )
    axis = min(jnp.ndim(position.x), 1)
    return {name: jnp.stack(logged[name], axis=axis) for name in channels}


def beginning_of(
    model: Model,
    segments: Segments,
    schedule: Schedule,
    *,
    states: Float[JaxArray, "L F"] | None = None,
    conditions: Mapping[str, Float[JaxArray, " F"]] = MappingProxyType({}),
) -> tuple[Start, Inlet, Environment]:
    """Return initial state, input and environment of segments.

    Parameters
    ----------
    model, segments, schedule
        What flies.
    states
        Deviation of the starts from the recorded ones, in the segments' standard deviations.
    conditions
        Name, of `tuner.vehicle.conditions` -> value of each segment, in its unit.
    """
    start, inlet = segments.start, segments.inlet
    true = gyro_of(model.vehicle).body_rate(start.motion.body_rate)
    start = replace(start, motion=replace(start.motion, body_rate=true))
    start = markers_of(model.vehicle).start(start, segments.resting, model.controller.sees_markers)
    environment = environment_of(model, segments, conditions)
    exponent = model.vehicle.effects.get("battery_exponent")
    factor = environment.speed_factor(exponent, jnp.asarray(0), schedule)
    if segments.resting is not None:
        start = trimmed_start(
            model.vehicle, model.controller, start, segments.resting, speed_factor=factor
        )
    if segments.turning is not None:
        start = with_commanded_rotors(start, model.vehicle, segments.turning, speed_factor=factor)
    if states is not None and segments.start_sd is not None:
        change = with_all_rows(states * segments.start_sd, segments.free_rows)
        start = with_change(start, change)
        if ROWS["trim"].start in segments.free_rows:
            inlet = inlet.trimmed(rotor_trim(model.vehicle, change))
    return start, inlet, environment


def accelerometer(
    vehicle: Vehicle,
    motion: Motion,
    rotor_speed: PerRotor,
    environment: Environment,
    biases: Mapping[str, Float[JaxArray, " F"]],
) -> tuple[JaxArray, JaxArray, JaxArray]:
    """Return the reading of an accelerometer at the centre of mass, m/s² along the body's axes.

    It is the specific force (all forces but gravity, over the mass) plus the bias.
    """
    air = Air.around(vehicle, motion, environment, tuple(jnp.zeros_like(w) for w in rotor_speed))
    pull = terms.total_wrench(vehicle, motion, rotor_speed, air).force * (1.0 / vehicle.body.mass)
    x, y, z = (getattr(pull, axis) + biases.get(f"accelerometer_{axis}", 0.0) for axis in "xyz")
    return x, y, z


def environment_of(
    model: Model, segments: Segments, conditions: Mapping[str, Float[JaxArray, " F"]]
) -> Environment:
    """Return the environment of the segments, as far as it acts on a model."""
    log_voltage = None
    volts, reference = segments.log_voltage, model.reference_voltage
    acts = "battery_exponent" in model.vehicle.effects
    if acts and volts is not None and reference is not None:
        log_voltage = relative_log_voltage(volts, reference)
    decline = conditions.get("battery_decline")
    return Environment(
        wind=_wind(conditions),
        log_voltage=log_voltage,
        battery_decline=decline,
        begin=None if decline is None else segments.begin,
        disturbance=segments.disturbance,
    )


def _wind(conditions: Mapping[str, Float[JaxArray, " F"]]) -> Vec3 | None:
    known = [conditions[name] for name in ("wind_x", "wind_y") if name in conditions]
    if not known:
        return None
    calm = jnp.zeros_like(known[0])
    return Vec3(conditions.get("wind_x", calm), conditions.get("wind_y", calm), calm)
