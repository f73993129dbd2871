"""Extended Kalman filter of a simulation.

At each tick the samples since the one before correct motion, rotor speeds, the controller's memory
and the disturbances. `filtered` linearises the loop about the corrected simulation and propagates
its covariance; `innovations` simulates with given gains, so that its derivative is that of a
simulation: a predictor of fixed structure (Ljung 1999, 7.2).

Innovations are whitened: with S = L Lᵀ their covariance (Cholesky), L⁻¹ times them is white and of
unit variance if the model holds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float
from numpy.typing import NDArray

from lanes import Argument, ProgramResults, program_of
from sim_jax import terms
from sim_jax.numeric import row_of
from sim_jax.schedule import Schedule
from sim_jax.state import State
from tuner.disturbances.covariance import Samples, SparseMatrix, at, innovations_of, propagated
from tuner.disturbances.disturbances import PROCESSES, SLOW
from tuner.disturbances.observer import (
    AssumedModel,
    FilterInput,
    Observer,
    commands_in_flight,
    first_errors,
)
from tuner.objective.criterion import AnyArray
from tuner.objective.simulation import CODE, flown_part, laid_out

GATE = 4.0
"""Standard deviations at which an innovation's correction is clipped: an outlier."""
GATE_GROWTH = 4.0
"""Factor on the gate for each outlier in a row."""
MAX_GATE_STEPS = 5
"""Outliers in a row after which the gate stays the same."""
FEW_FLIGHTS = 4
"""Flights up to which vectors for few lanes take less time."""
MIN_VARIANCE = 1e-12
"""Least variance of a gust, (m/s)²: a thrust's mean over none has no slope at rest."""


def gate_innovations(white: Array, beyond: Array) -> tuple[Array, Array]:
    """Return gated innovations, and the number of outliers in a row.

    One is an outlier; several show that the filter has lost the flight, which it would never find
    again within its gate: each in a row widens the gate, so that after a few they correct in full.

    Parameters
    ----------
    white
        (m, F) whitened innovations; zero where nothing was sampled.
    beyond
        (m, F) outliers in a row before these.
    """
    gate = GATE * GATE_GROWTH ** jnp.minimum(beyond, MAX_GATE_STEPS)
    outside = jnp.where(jnp.abs(white) > GATE, beyond + 1, 0)
    return jnp.clip(white, -gate, gate), jnp.where(white != 0.0, outside, beyond)


def deviance(white: Array) -> Array:
    """Return twice the negative log-likelihood of whitened innovations, but for a constant.

    Beyond the gate it grows linearly (Huber), so that outliers do not count as disturbances.
    """
    size = jnp.abs(white)
    return jnp.where(size <= GATE, white**2, 2.0 * GATE * size - GATE**2)


class Gains(eqx.Module):
    """Gains of a filter on T ticks; m samples correct n numbers of the state.

    Attributes
    ----------
    gain
        (F, T, m, n) correction for one standard deviation of each whitened innovation; arbitrary
        where nothing was sampled.
    factors
        (F, T, m, m) L, lower triangular.
    draught
        (F, T) m/s², standard error of the gusts upwards, as the filter estimates them.
    rate
        Hz of the filter's physics steps. With finer steps there are more commands in flight: the
        correction of each is repeated for those of its time.
    """

    gain: Float[AnyArray, "F T m n"]
    factors: Float[AnyArray, "F T m m"]
    draught: Float[AnyArray, "F T"]
    rate: int = eqx.field(static=True)

    def of_flights(self, flights: NDArray[np.intp]) -> Gains:
        """Return those of some flights."""
        own = {name: getattr(self, name)[flights] for name in ("gain", "factors", "draught")}
        return replace(self, **own)


class FilterResult(eqx.Module):
    """Result of a filter.

    Attributes
    ----------
    white, root
        (T, m, F) whitened innovations, and the standard deviation of each given earlier ones of its
        tick: the diagonal of L.
    loss
        (T, F) negative log-likelihood of each tick's samples, but for a constant.
    gains
        See `Gains`; None if not kept.
    """

    white: Float[AnyArray, "T m F"]
    root: Float[AnyArray, "T m F"]
    loss: Float[AnyArray, "T F"]
    gains: Gains | None

    def first(self, ticks: int, segments: slice = slice(None)) -> FilterResult:
        """Return the same of some segments' first ticks, without gains."""
        white, root, loss = (
            np.asarray(rows[:ticks, ..., segments]) for rows in (self.white, self.root, self.loss)
        )
        return FilterResult(white, root, loss, None)


def _undelayed(schedule: Schedule) -> Schedule:
    """Return a schedule without the delay line of estimates, which rate control does not see."""
    return replace(schedule, longest_estimate_latency=0.0, pose_rate=None)


def _shortly_delayed(
    schedule: Schedule, assumed: AssumedModel, latency: float = 0.0
) -> tuple[Schedule, int]:
    """Return a schedule with the shortest delay line of commands, and the commands in it.

    The correction of each command in flight costs as much as that of a rotor's speed.
    """
    if schedule.longest_actuator_latency == 0.0:
        return schedule, 0
    latency = max(float(assumed.coefficients["actuator_latency"]), latency)
    count = max(int(np.ceil(latency / schedule.step - 1e-9)), 1)
    return replace(schedule, longest_actuator_latency=count * schedule.step), count


def filtered(
    schedule: Schedule,
    inputs: FilterInput,
    assumed: AssumedModel,
    *,
    gains: bool = True,
    latency: float = 0.0,
    few: bool = False,
) -> FilterResult:
    """Return Kalman gains, innovations, and their likelihood.

    Parameters
    ----------
    schedule, inputs, assumed
        Rates of the simulation, the recordings, and the model.
    gains
        Whether gains are kept, which take most of the memory.
    latency
        Largest latency of commands so far, s. Corrections of commands that have arrived have no
        effect: with the same number in flight, one program serves all filters.
    few
        Whether no more than `FEW_FLIGHTS` were recorded, though they may be filtered several times.
    """
    short, in_flight = _shortly_delayed(_undelayed(schedule), assumed, latency)
    wanted = (*[True] * 3, *[gains] * 3)
    run = _run((short, in_flight), _given(inputs, assumed), wanted, few=few)
    *rows, gain, factors, draught = run.values
    white, root, loss = (np.moveaxis(each, 0, -1) for each in rows)
    kept = Gains(gain, factors, draught, schedule.physics_rate) if gains else None
    return FilterResult(white, root, loss, kept)


def innovations(
    schedule: Schedule,
    inputs: FilterInput,
    gains: Gains,
    assumed: AssumedModel,
    tangents: Mapping[str, NDArray[np.float64]] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float32] | None]:
    """Return whitened innovations (T, m, F) with given gains, and derivatives; None for none.

    The derivatives keep the kernel's layout (F, Q, T, m): see `lanes.ProgramResults`.

    Parameters
    ----------
    schedule, inputs, assumed
        As of `filtered`.
    gains
        Gains of the filter.
    tangents
        Directions along which is differentiated: coefficient -> (Q,), and ``"offsets"`` ->
        (Q, offsets). With none of them, Q = 0, the program of derivatives computes innovations
        alone; for None there is one of its own.
    """
    moved = None
    if tangents is not None:
        still = np.zeros(len(tangents["offsets"]))
        names = sorted(assumed.coefficients)  # the order of the leaves
        moved = [tangents["offsets"], *(tangents.get(name, still) for name in names)]
    wanted = ((True, False), (False, True)) if moved and len(moved[0]) else (True, False)
    few = inputs.offsets.shape[-1] <= FEW_FLIGHTS
    run = _run((_undelayed(schedule),), _given(inputs, assumed, gains), wanted, moved, few=few)
    return np.moveaxis(run.values[0], 0, -1), run.columns and run.columns[1]


class _FilterArguments(NamedTuple):
    """Input of a program.

    ``order`` (T, m + 1) are each tick's rows that are sampled in any segment, then their number.
    """

    inputs: FilterInput
    assumed: AssumedModel
    order: Any
    gains: Gains | None


def _given(
    inputs: FilterInput, assumed: AssumedModel, gains: Gains | None = None
) -> _FilterArguments:
    weights = [np.asarray(inputs.samples[name].weight) for name in inputs.widths]
    sampled = np.concatenate([(weight > 0).any(axis=-1) for weight in weights], axis=1)
    first = np.argsort(~sampled, axis=1, kind="stable")
    order = np.concatenate([first, np.count_nonzero(sampled, axis=1)[:, None]], axis=1)
    inputs = replace(inputs, segments=flown_part(inputs.segments))
    given: _FilterArguments = jax.tree.map(
        np.asarray, _FilterArguments(inputs, assumed, order, gains)
    )
    return given


def _run(
    static: tuple[Any, ...],
    given: _FilterArguments,
    wanted: Any,
    tangents: list[NDArray[np.float64]] | None = None,
    *,
    few: bool,
) -> ProgramResults:
    """Simulate all segments with given gains; without any, filter them."""

    def table(leaf: Any) -> Argument:
        return replace(Argument.of(leaf, lanes=True), shape=("ticks", *np.shape(leaf)[1:-1]))

    def apart(leaf: Any) -> Argument:
        shape = ("ticks", *np.shape(leaf)[2:])
        return replace(Argument.of(leaf, lanes=True), shape=shape, apart=True)

    inputs, assumed, moves = given.inputs, given.assumed, tangents is not None
    arguments = _FilterArguments(
        FilterInput(
            segments=laid_out(inputs.segments),
            offsets=Argument.of(inputs.offsets, lanes=True, moves=moves),
            samples=jax.tree.map(table, inputs.samples),
            conditions=inputs.conditions,
        ),
        AssumedModel(
            model=jax.tree.map(partial(Argument.of, lanes=False), assumed.model),
            coefficients=jax.tree.map(
                partial(Argument.of, lanes=False, moves=moves), assumed.coefficients
            ),
            strengths=Argument.of(assumed.strengths, lanes=True),
            noise=Argument.of(assumed.noise, lanes=True),
        ),
        order=Argument(("ticks", *given.order.shape[1:]), int, lanes=False),
        gains=jax.tree.map(apart, given.gains),
    )
    kind = "filter" if given.gains is None else "innovations"
    program = program_of(
        _filter if kind == "filter" else _innovations,
        arguments,
        *static,
        name=kind,
        made_of=(kind, static, moves, terms.TERMS),
        packages=CODE,
        few_lanes=few,
    )
    count, ticks = inputs.offsets.shape[-1], len(given.order)
    return program(given, tangents, lanes=count, turns=ticks, wanted=wanted)


def _sampled(given: _FilterArguments, tick: Array) -> tuple[Callable[[Array], Array], Array]:
    """Return the function from number to sampled row of a tick, and the count of rows."""

    def order(number: Array) -> Array:
        return lax.dynamic_slice(given.order, (tick, number), (1, 1))[0, 0]

    return order, order(jnp.asarray(given.order.shape[1] - 1))


def _filter(
    schedule: Schedule, in_flight: int, given: _FilterArguments, lengths: Mapping[str, int]
) -> Any:
    """Filter one segment: white, root and loss of `FilterResult`, then the arrays of `Gains`."""
    observer, first = Observer.of(schedule, given.inputs, given.assumed)
    processes = observer.processes
    first_sd = jnp.asarray(first_errors(first, in_flight))
    size, wide = len(first_sd) + PROCESSES, len(given.assumed.noise)
    shown = len(first_errors(first, 0))  # to samples: commands on their way are not, nor pushes
    process_noise = jnp.concatenate([jnp.zeros(size - PROCESSES), processes.added])
    gust = size - PROCESSES + SLOW.index("gust_z")
    least = MIN_VARIANCE / processes.acts[SLOW.index("gust_z")] ** 2

    def tick(carried: Any, number: Array) -> Any:
        state, pushed, matrices, before, beyond = carried
        covariance, gain = matrices
        read = row_of(given.inputs.samples, number)

        def compare(change: list[Array]) -> list[Array]:
            now = observer.outputs(observer.corrected(state, change, number, 0), number)
            # a sample between two ticks is an observation of the second, wherever it lies
            along = {
                name: at + now[name] - lax.stop_gradient(now[name]) for name, at in before.items()
            }
            return observer.errors(now, along, read)

        error, changes = jax.linearize(compare, [jnp.zeros(())] * shown)
        variance = jnp.where(observer.sampled(read), given.assumed.noise**2, 1.0)
        samples = Samples(
            jnp.concatenate(error),
            variance,
            SparseMatrix.of(changes, shown),
            *_sampled(given, number),
        )
        draught = jnp.sqrt(jnp.maximum(covariance[gust, gust], least))
        update = innovations_of(covariance, gain, samples)
        white, factors = update.white, update.factors
        root = jnp.stack([factors[i, i] for i in range(wide)])
        loss = 0.5 * jnp.sum(deviance(white)) + jnp.sum(jnp.log(root))
        corrects, beyond = gate_innovations(white, beyond)
        change = -update.corrections(samples, corrects)
        state = observer.corrected(state, change[:-PROCESSES], number, in_flight)
        pushed = pushed + change[-PROCESSES:]
        before = observer.outputs(state)

        def advance(change: Array) -> tuple[Array, State]:
            moved = observer.corrected(state, change[:-PROCESSES], number, in_flight)
            after = observer.next(moved, pushed + change[-PROCESSES:], number, draught)
            return observer.numbers(after, number + 1, in_flight), after

        _, transition, after = jax.linearize(advance, jnp.zeros(size), has_aux=True)
        covariance = propagated(
            covariance,
            update,
            samples,
            transition,
            process_noise,
            retention=processes.retention,
            tick=number,
        )
        gains = update.gain.astype(jnp.float32)
        matrices = covariance, update.gain
        carried = after, pushed * processes.retention, matrices, before, beyond
        return carried, (white, root, loss, gains, factors.astype(jnp.float32), draught)

    sd = jnp.concatenate([first_sd, processes.sd])
    diagonal = jnp.arange(size)[:, None] == jnp.arange(size)
    begin = (
        first,
        jnp.zeros(PROCESSES),
        (jnp.where(diagonal, sd**2, 0.0), jnp.zeros((wide, size))),
        observer.outputs(first),
        jnp.zeros(wide, int),
    )
    return lax.scan(tick, begin, jnp.arange(lengths["turns"]))[1]


def _innovations(
    schedule: Schedule, given: _FilterArguments, lengths: Mapping[str, int]
) -> tuple[Array, Array]:
    """Return one segment's whitened innovations (ticks, m) with given gains.

    And the same in single precision for derivatives, which take most of the memory.
    """
    assert given.gains is not None
    observer, first = Observer.of(schedule, given.inputs, given.assumed)
    gains, factors, draughts = given.gains.gain, given.gains.factors, given.gains.draught
    wide, size = gains.shape[1:]
    in_flight, finer = commands_in_flight(first, size - PROCESSES), 1
    if in_flight:
        finer = schedule.physics_rate // given.gains.rate

    def for_each_step(change: Array) -> Array:
        """Return a correction of all commands in flight from that of the filter's steps."""
        begin = size - PROCESSES - in_flight * len(first.rotor_speed)
        commands = change[begin:-PROCESSES].reshape(in_flight, -1)
        commands = jnp.repeat(commands, finer, axis=0).ravel()
        return jnp.concatenate([change[:begin], commands, change[-PROCESSES:]])

    def tick(carried: Any, number: Array) -> tuple[Any, tuple[Array, Array]]:
        state, pushed, before, beyond = carried
        read = row_of(given.inputs.samples, number)
        error = jnp.concatenate(observer.errors(observer.outputs(state, number), before, read))
        order, count = _sampled(given, number)

        def row_of_tick(table: Array, i: Array, count: int) -> Array:
            found = lax.dynamic_slice(table, (number, i, 0), (1, 1, count))[0, 0]
            return found.astype(error.dtype)

        def whitened(place: Array, white: Array) -> Array:
            i = order(place)
            factor = row_of_tick(factors, i, wide)
            alone = (at(error, i) - factor @ white) / at(factor, i)
            after: Array = lax.dynamic_update_index_in_dim(white, alone, i, 0)
            return after

        def corrected(place: Array, change: Array) -> Array:
            i = order(place)
            return change - at(corrects, i) * row_of_tick(gains, i, size)

        white = lax.fori_loop(0, count, whitened, jnp.zeros(wide))
        corrects, beyond = gate_innovations(white, beyond)
        change = lax.fori_loop(0, count, corrected, jnp.zeros(size))
        if finer > 1:
            change = for_each_step(change)
        state = observer.corrected(state, change[:-PROCESSES], number, in_flight * finer)
        pushed = pushed + change[-PROCESSES:]
        before = observer.outputs(state)
        after = observer.next(state, pushed, number, row_of(draughts, number))
        carried = after, pushed * observer.processes.retention, before, beyond
        return carried, (white, white.astype(jnp.float32))

    # what moves later has a derivative from the beginning: jax differentiates the loop once
    still = 0.0 * first.motion.position.x
    first = replace(first, gyro=jax.tree.map(lambda number: number + still, first.gyro))
    begin = (
        first,
        jnp.zeros(PROCESSES) + still,
        observer.outputs(first),
        jnp.zeros(wide, int),
    )
    rows: tuple[Array, Array] = lax.scan(tick, begin, jnp.arange(lengths["turns"]))[1]
    return rows
