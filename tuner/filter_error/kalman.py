"""A simulation that recorded samples correct, as a Kalman filter does.

At each tick the samples since the one before correct motion, rotor speeds, the controller's memory
and the disturbances. `filtered` linearises the loop about the corrected simulation and propagates
its covariance (extended Kalman filter); `innovations` flies with gains that are given, so that its
derivative is that of a simulation: a predictor of fixed structure (Ljung 1999, 7.2).

Innovations are whitened: with S = L Lᵀ their covariance, L⁻¹ times them is white and of unit
variance if the model holds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.scipy.linalg import solve_triangular
from jax.typing import ArrayLike
from jaxtyping import Float
from numpy.typing import NDArray

from sim_jax.state import State
from sim_jax.trees import row_of
from tuner.filter_error.disturbances import COUNT
from tuner.filter_error.observer import (
    Expected,
    Feed,
    Observer,
    commands_in_flight,
    first_errors,
)
from tuner.objective.simulator import Simulator
from tuner.objective.tunable import Tunable
from tuner.parallel import over_devices

T = TypeVar("T")

GATE = 4.0
"""Standard deviations beyond which an innovation corrects no further: an outlier."""
WIDER = 4.0
"""Times, each innovation in a row that lies beyond."""
WIDEST = 5
"""In a row beyond which the gate grows no further."""


def gated(white: Array, beyond: Array) -> tuple[Array, Array]:
    """Return what whitened innovations correct by, and how many in a row lie beyond the gate.

    One is an outlier; the next ones say that the filter has lost the flight, which at its gate it
    would never find again: each in a row widens it, so after a few they correct as they are.

    Parameters
    ----------
    white
        (m, F); zero where nothing was sampled.
    beyond
        (m, F) how many in a row before these.
    """
    gate = GATE * WIDER ** jnp.minimum(beyond, WIDEST)
    outside = jnp.where(jnp.abs(white) > GATE, beyond + 1, 0)
    return jnp.clip(white, -gate, gate), jnp.where(white != 0.0, outside, beyond)


def deviance(white: Array) -> Array:
    """Return twice the negative log-likelihood of whitened innovations, but for a constant.

    Beyond the gate it grows linearly (Huber): an outlier is no strong disturbance.
    """
    size = jnp.abs(white)
    return jnp.where(size <= GATE, white**2, 2.0 * GATE * size - GATE**2)


class Gains(eqx.Module):
    """Of an observer, on T ticks; n numbers of the state are corrected by m samples.

    Attributes
    ----------
    gain
        (T, n, m, F) correction for one standard deviation of each whitened innovation.
    whitens
        (T, m, m, F) L⁻¹.
    """

    gain: Float[Array, "T n m F"]
    whitens: Float[Array, "T m m F"]


class Filtered(eqx.Module):
    """What a filter makes of recordings.

    Attributes
    ----------
    white
        (T, m, F) whitened innovations.
    loss
        (T, F) negative log-likelihood of each tick's samples, but for a constant.
    whitens
        (T, m, m, F) see `Gains`.
    gain
        (T, n, m, F) see `Gains`; None where it was not asked for.
    """

    white: Float[Array, "T m F"]
    loss: Float[Array, "T F"]
    whitens: Float[Array, "T m m F"]
    gain: Float[Array, "T n m F"] | None

    @property
    def gains(self) -> Gains:
        """Of the observer that the filter is."""
        assert self.gain is not None
        return Gains(self.gain, self.whitens)


def _linearised(function: Callable[[Array], tuple[Array, T]], at: Array) -> tuple[T, Array]:
    """Return what a function returns beside its value, and the value's derivatives.

    Parameters
    ----------
    function
        Of (n, F): the value (k, F), and something else. Segments do not depend on each other.
    at
        Where.

    Returns
    -------
    tuple
        The other thing, and the derivatives (F, k, n).
    """

    def push(row: Array) -> tuple[T, Array]:
        along = row[:, None] * jnp.ones_like(at)
        _, moved, beside = jax.jvp(function, (at,), (along,), has_aux=True)
        return beside, moved

    beside, columns = jax.vmap(push, out_axes=(None, 0))(jnp.eye(len(at)))
    return beside, jnp.moveaxis(columns, (0, 1, 2), (2, 1, 0))


def _undelayed(simulator: Simulator) -> Simulator:
    """Return a simulator without the delay line of estimates, which rate control does not see."""
    schedule = replace(simulator.schedule, longest_estimate_latency=0.0, pose_rate=None)
    return replace(simulator, schedule=schedule)


def _shortly_delayed(simulator: Simulator, expected: Expected) -> tuple[Simulator, int]:
    """Return a simulator whose delay line of commands is no longer than needed.

    And how many commands are on their way to the motors when a step begins: to correct each of them
    costs as much as a rotor's speed.
    """
    schedule = simulator.schedule
    if schedule.longest_actuator_latency == 0.0:
        return simulator, 0
    latency = float(expected.tunable.at(expected.coefficients).vehicle.setup.actuator_latency)
    count = max(int(np.ceil(latency / schedule.step - 1e-9)), 1)
    short = replace(schedule, longest_actuator_latency=count * schedule.step)
    return replace(simulator, schedule=short), count


def stepped(gains: Gains, simulator: Simulator, expected: Expected, times: int) -> Gains:
    """Return the gains of a simulator for the same in so many times finer steps of physics.

    Then so many times as many commands are on their way to the motors.
    """
    in_flight = _shortly_delayed(simulator, expected)[1]
    size, rotors = gains.gain.shape[1], len(expected.tunable.model.vehicle.rotors)
    first = size - COUNT - in_flight * rotors
    commands = np.arange(first, size - COUNT).reshape(in_flight, rotors).repeat(times, axis=0)
    rows = np.concatenate([np.arange(first), commands.ravel(), np.arange(size - COUNT, size)])
    return replace(gains, gain=gains.gain[:, rows])


def filtered(
    simulator: Simulator, feed: Feed, expected: Expected, *, gains: bool = True
) -> Filtered:
    """Return the Kalman gains, the innovations, and how likely they are.

    Parameters
    ----------
    simulator, feed, expected
        What flies, the recordings, and what is taken for true.
    gains
        Whether gains are kept, which take most of the memory.
    """
    short, in_flight = _shortly_delayed(_undelayed(simulator), expected)
    return _filter(short, in_flight, gains)(
        (feed, expected.strengths, expected.noise), expected.tunable, expected.coefficients
    )


@lru_cache(maxsize=8)
def _filter(simulator: Simulator, in_flight: int, gains: bool) -> Callable[..., Filtered]:
    def segmentwise(
        batch: tuple[Feed, Array, Array], tunable: Tunable, coefficients: Array
    ) -> Filtered:
        feed, strengths, noise = batch
        expected = Expected(tunable, coefficients, strengths, noise)
        observer, first = Observer.of(simulator, feed, expected)
        first_sd, processes = first_errors(first, in_flight), observer.processes
        segments, size = feed.segments.flight.shape[0], len(first_sd) + COUNT
        total, wide = next(iter(feed.samples.values())).values.shape[0], len(noise)
        shown = len(first_errors(first, 0))  # to samples: commands on their way are not, nor pushes
        zero = jnp.zeros((size, segments))
        unrest = jnp.concatenate([jnp.zeros((size - COUNT, segments)), processes.added])
        sd = jnp.concatenate([jnp.tile(first_sd[:, None], segments), processes.sd])

        def tick(number: Array, carried: Any) -> Any:
            state, pushed, covariance, before, beyond, kept = carried
            samples = row_of(feed.samples, number)

            def compare(change: Array) -> tuple[Array, Array]:
                now = observer.seen(observer.corrected(state, change, number, 0), number)
                # a sample between two ticks tells of the state, however near the first it was taken
                along = jax.tree.map(lambda at, to: at + to - lax.stop_gradient(to), before, now)
                errors = observer.errors(now, along, samples)
                return errors, errors

            error, seen = _linearised(compare, zero[:shown])
            spread = covariance[:, :, :shown] @ jnp.swapaxes(seen, 1, 2)
            # what was not sampled is as likely with any noise
            variance = jnp.where(observer.sampled(samples), noise**2, 1.0).T
            innovation = seen @ spread[:, :shown] + variance[:, :, None] * jnp.eye(wide)
            factor = jnp.linalg.cholesky(innovation)
            whitens = solve_triangular(
                factor, jnp.broadcast_to(jnp.eye(wide), factor.shape), lower=True
            )
            gain = spread @ jnp.swapaxes(whitens, 1, 2)
            white = jnp.einsum("fkm,mf->kf", whitens, error)
            covariance = covariance - gain @ jnp.swapaxes(gain, 1, 2)
            scatter = jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            kept = jax.tree.map(
                lambda rows, row: lax.dynamic_update_index_in_dim(
                    rows, row.astype(rows.dtype), number, 0
                ),
                kept,
                (
                    white,
                    0.5 * deviance(white).sum(axis=0) + scatter,
                    jnp.moveaxis(whitens, 0, -1),
                    jnp.moveaxis(gain, 0, -1) if gains else None,
                ),
            )
            corrects, beyond = gated(white, beyond)
            change = -jnp.einsum("fik,kf->if", gain, corrects)
            state, pushed = (
                observer.corrected(state, change[:-COUNT], number, in_flight),
                pushed + change[-COUNT:],
            )
            before = observer.seen(state, number)

            def advance(change: Array) -> tuple[Array, State]:
                moved = observer.corrected(state, change[:-COUNT], number, in_flight)
                after = observer.next(moved, pushed + change[-COUNT:], number)
                kept = processes.keeps * change[-COUNT:]
                numbers = observer.numbers(after, number + 1, in_flight)
                return jnp.concatenate([numbers, kept]), after

            state, follows = _linearised(advance, zero)
            covariance = follows @ covariance @ jnp.swapaxes(follows, 1, 2) + _diagonal(unrest)
            covariance = 0.5 * (covariance + jnp.swapaxes(covariance, 1, 2))
            return state, pushed * processes.keeps, covariance, before, beyond, kept

        empty = (
            jnp.zeros((total, wide, segments), jnp.float32),
            jnp.zeros((total, segments)),
            jnp.zeros((total, wide, wide, segments), jnp.float32),
            jnp.zeros((total, size, wide, segments), jnp.float32) if gains else None,
        )
        begin = (
            first,
            jnp.zeros((COUNT, segments)),
            _diagonal(sd**2),
            observer.seen(first, jnp.asarray(0)),
            jnp.zeros((wide, segments), int),
            empty,
        )
        return Filtered(*lax.fori_loop(0, total, tick, begin)[-1])

    return over_devices(segmentwise, name=("filter", simulator, in_flight, gains))


def _diagonal(values: Array) -> Array:
    """Return matrices (F, n, n) with values (n, F) on their diagonals."""
    return values.T[:, :, None] * jnp.eye(len(values))


def innovations(
    simulator: Simulator, feed: Feed, gains: Gains, expected: Expected, directions: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return whitened innovations (T, m, F) with given gains, and derivatives (N, T, m, F).

    Parameters
    ----------
    simulator, feed, expected
        As of `filtered`.
    gains
        Of the observer.
    directions
        (N, K + offsets): along which is differentiated.
    """
    return _innovations(_undelayed(simulator))(
        (feed, gains, expected.strengths, expected.noise),
        expected.tunable,
        expected.coefficients,
        np.asarray(directions, float),
    )


@lru_cache(maxsize=4)
def _innovations(
    simulator: Simulator,
) -> Callable[..., tuple[NDArray[np.float64], NDArray[np.float64]]]:
    def segmentwise(
        batch: tuple[Feed, Gains, Array, Array],
        tunable: Tunable,
        coefficients: Array,
        directions: Array,
    ) -> tuple[Array, Array]:
        feed, gains, strengths, noise = batch

        def flown(vector: Array, offsets: Array) -> Array:
            moved = eqx.tree_at(lambda f: f.offsets, feed, offsets)
            expected = Expected(tunable, vector, strengths, noise)
            observer, state = Observer.of(simulator, moved, expected)
            in_flight = commands_in_flight(state, gains.gain.shape[1] - COUNT)

            def tick(carried: Any, given: Any) -> tuple[Any, Array]:
                state, pushed, before, beyond = carried
                number, samples, gain = given
                error = observer.errors(observer.seen(state, number), before, samples)
                white = jnp.einsum("kmf,mf->kf", gain.whitens, error)
                corrects, beyond = gated(white, beyond)
                change = -jnp.einsum("ikf,kf->if", gain.gain, corrects)
                state, pushed = (
                    observer.corrected(state, change[:-COUNT], number, in_flight),
                    pushed + change[-COUNT:],
                )
                before = observer.seen(state, number)
                after = observer.next(state, pushed, number)
                pushed = pushed * observer.processes.keeps
                return (after, pushed, before, beyond), white

            segments, wide = offsets.shape[-1], gains.whitens.shape[1]
            begin = (
                state,
                jnp.zeros((COUNT, segments)),
                observer.seen(state, jnp.asarray(0)),
                jnp.zeros((wide, segments), int),
            )
            numbers = jnp.arange(gains.gain.shape[0])
            white: Array = lax.scan(tick, begin, (numbers, feed.samples, gains))[1]
            return white

        def push(direction: Array) -> tuple[Array, Array]:
            count = len(coefficients)
            along = direction[count:, None] * jnp.ones_like(feed.offsets)
            return jax.jvp(flown, (coefficients, feed.offsets), (direction[:count], along))

        pushed: tuple[Array, Array] = jax.vmap(push, out_axes=(None, 0))(directions)
        return pushed

    return over_devices(segmentwise, name=("observer's innovations", simulator))
