"""Segments flown by a kernel, and the derivatives of what they are compared by.

The function below flies one segment; `lanes` flies many side by side. A program belongs to what is
simulated (inlet, rates, terms, what is compared), not to how many segments there are, how long they
last or which coefficients are free.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from lanes import Argument, Program
from sim_jax.environment import Environment
from sim_jax.inlet import Inlet, ReferenceInlet
from sim_jax.rollout import begun
from sim_jax.schedule import Schedule
from sim_jax.state import Limits, Start, State
from sim_jax.terms import total
from tuner.objective.flight import (
    MOTION,
    SETPOINTS,
    SPEEDS,
    TURNED,
    beginning_of,
    recorded_of,
)
from tuner.objective.initial_conditions import SPIN
from tuner.objective.segments import Segments
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.model import (
    Model,
    coefficients_in,
    with_coefficients,
    with_terms_computed,
)

Array = NDArray[np.float64]

LOGGED = (
    *("position", "attitude", "body_rate", "rotor_speed", "command"),
    *(MOTION, TURNED, SPEEDS, SETPOINTS),
)
"""What every program without derivatives logs; what nobody asks for is not written."""
AT_ONCE = 2
"""Columns of derivatives in one pass over a block of segments: with more, code leaves the
instruction cache and takes longer to build."""


EFFECTS = tuple(name for name, row in COEFFICIENTS.items() if row.is_effect)
TERMS = tuple(name for name in EFFECTS if COEFFICIENTS[name].group)
"""Coefficients beyond the base model, and those of them that a fit may add."""
CODE = ("sim_jax", "tuner")
"""Packages whose code is run while a program of this one is traced."""


class Flown(NamedTuple):
    """What segments are compared by, logged at ``schedule.log_rate``; the pose is the markers'.

    Attributes
    ----------
    channels
        Channel -> (F, samples, c).
    columns
        Channel -> (F, passes, samples, c, columns of a pass) derivatives, as of a `lanes.Run`; None
        where nothing moves.
    crash_time
        (F,) s, infinite for a segment that flew.
    """

    channels: dict[str, Array]
    columns: dict[str, Array | None]
    crash_time: Array


class _Given(NamedTuple):
    """What a program is given of a model and of one segment."""

    model: Model
    coefficients: dict[str, Any]
    segments: Segments
    states: Any
    conditions: dict[str, Any]


@dataclass(frozen=True)
class _Static:
    """What a program belongs to, besides the structure of what it is given."""

    schedule: Schedule
    limits: Limits
    channels: tuple[str, ...]
    moves: bool


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
) -> Flown:
    """Fly segments.

    Parameters
    ----------
    model, schedule, limits
        What flies.
    segments
        F of them.
    samples
        How many samples are logged.
    coefficients
        Name -> value that replaces the model's: a number, or (F,) each segment's own.
    states
        (L, F) how far the starts lie from the recorded ones, in the segments' standard deviations.
    conditions
        Name -> (F,) per-flight conditions, in their units.
    tangents
        Directions along which is differentiated: coefficient or condition -> (Q,), and
        ``"states"`` -> (Q, L). None differentiates by nothing.
    channels
        What is logged; by default what was measured.
    """
    if conditions or {*model.vehicle.effects, *coefficients}.intersection(EFFECTS):
        model, conditions = _with_all(model, segments, conditions)
    names = tuple(segments.measured) if channels is None else channels
    moves = tangents is not None
    # in one order, for it tells programs apart
    logged = tuple(sorted(names if moves else {*LOGGED, *names}))
    coefficients = {**coefficients_in(model), **coefficients}
    own = not moves or any(np.ndim(value) for value in coefficients.values())
    if segments.freedom is None and isinstance(segments.inlet, ReferenceInlet):
        # as flights with a spin have it: one program serves both
        nothing = np.zeros((len(SPIN), segments.count))
        segments = replace(segments, freedom=nothing, freed=SPIN)
    if segments.freedom is not None and states is None:
        states = np.zeros((len(segments.freed), segments.count))
    given = _Given(
        model=model,
        coefficients={name: np.asarray(value, float) for name, value in coefficients.items()},
        segments=flown_part(segments),
        states=None if segments.freedom is None else states,
        conditions=dict(conditions),
    )
    if own:
        given = given._replace(
            coefficients={
                name: np.broadcast_to(value, (segments.count,))
                for name, value in given.coefficients.items()
            }
        )
    arguments = _arguments(given, own_coefficients=own, moves=moves)
    leaves, structure = jax.tree.flatten(arguments, is_leaf=lambda leaf: isinstance(leaf, Argument))
    static = _Static(schedule, limits, logged, moves)
    program = _program(tuple(leaves), structure, static)
    run = program(
        given,
        None if tangents is None else _directions(given, tangents),
        lanes=segments.count,
        turns=samples,
        wanted=None if moves else ({name: name in names for name in logged}, True),
    )
    found, crash_time = run.values
    still: dict[str, Array | None] = dict.fromkeys(names)
    return Flown(
        {name: found[name] for name in names},
        still if run.columns is None else run.columns[0],
        crash_time,
    )


def _with_all(
    model: Model, segments: Segments, conditions: Mapping[str, Any]
) -> tuple[Model, dict[str, Any]]:
    """Return model and conditions with all terms, and all that surrounds, at neutral values.

    So two programs serve all that flies alike: of the base model, and of any terms beyond it.
    """
    around = ["wind_x", "wind_y"]
    if segments.log_voltage is None:
        around.append("battery_decline")
    calm = dict.fromkeys(around, np.zeros(segments.count))
    return with_terms_computed(model, TERMS), {**calm, **conditions}


def flown_part(segments: Segments) -> Segments:
    """Return what of segments is flown, not compared."""
    flown: Segments = replace(segments, measured={}, flight=jnp.zeros(segments.count, int))
    return flown


def _arguments(given: _Given, *, own_coefficients: bool, moves: bool) -> _Given:
    """Return how each leaf is laid out: segments along the last axis but for what they share."""

    def shared(leaf: Any) -> Argument:
        return Argument(np.shape(leaf), np.result_type(leaf), lanes=False)

    def moving(leaf: Any, *, lanes: bool) -> Argument:
        shape = np.shape(leaf)[:-1] if lanes else np.shape(leaf)
        return Argument(shape, np.result_type(leaf), lanes=lanes, moves=moves)

    return _Given(
        model=jax.tree.map(shared, given.model),
        coefficients=jax.tree.map(
            lambda leaf: moving(leaf, lanes=own_coefficients), given.coefficients
        ),
        segments=laid_out(given.segments),
        states=jax.tree.map(lambda leaf: moving(leaf, lanes=True), given.states),
        conditions=jax.tree.map(lambda leaf: moving(leaf, lanes=True), given.conditions),
    )


def laid_out(segments: Segments) -> Any:
    """Return how each leaf of what is flown of segments is laid out."""

    def each(leaf: Any, name: str | None = None) -> Argument:
        shape = np.shape(leaf)[:-1]
        return Argument((name, *shape[1:]) if name else shape, np.result_type(leaf), lanes=True)

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
        shape = np.shape(leaf)[:-1]
        if shape:
            shape = (names.setdefault(shape[0], f"rows {len(names)}"), *shape[1:])
        return Argument(shape, np.result_type(leaf), lanes=True)

    tables: Inlet = jax.tree.map(of, inlet)
    return tables


def _directions(given: _Given, tangents: Mapping[str, Array]) -> list[Array]:
    """Return the tangents of what moves, in the order of the leaves."""
    count = len(next(iter(tangents.values())))
    still = np.zeros(count)
    moved = [tangents.get(name, still) for name in sorted(given.coefficients)]
    if given.states is not None:
        moved.append(tangents.get("states", np.zeros((count, len(given.states)))))
    return [*moved, *(tangents.get(name, still) for name in sorted(given.conditions))]


@lru_cache(maxsize=64)
def _program(leaves: tuple[Argument, ...], structure: Any, static: _Static) -> Program:
    arguments = jax.tree.unflatten(structure, leaves)

    def flight(given: _Given, lengths: Mapping[str, int]) -> tuple[dict[str, Any], Any]:
        return _flight(given, static, lengths["turns"])

    return Program(
        flight,
        arguments,
        at_once=AT_ONCE,
        name="flight of a segment",
        made_of=(static, total.TERMS),
        packages=CODE,
    )


def _flight(given: _Given, static: _Static, samples: int) -> tuple[dict[str, Any], Any]:
    """Fly one segment: channel -> (samples, c), and the time of a crash."""
    model = with_coefficients(given.model, given.coefficients)
    parts: tuple[Start, Inlet, Environment] = beginning_of(
        model,
        given.segments,
        static.schedule,
        states=given.states,
        conditions=given.conditions,
    )
    start, inlet, environment = parts
    plant, first = begun(
        model.vehicle,
        model.controller,
        static.schedule,
        inlet,
        start,
        environment=environment,
        limits=static.limits,
    )

    def sample(state: State, number: Any) -> tuple[State, dict[str, Any]]:
        after, row = plant.sample(state, number)
        return after, recorded_of(row, model, environment, given.conditions, static.channels)

    last, channels = lax.scan(sample, first, jnp.arange(samples))
    return channels, last.crash_time
