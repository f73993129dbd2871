"""A simulation that recorded samples correct, as a Kalman filter does.

From one tick to the next the closed loop of rate control flies, fed with recorded set-points; at
each tick the samples since the one before correct motion, rotor speeds, the controller's memory and
the disturbances. `gains` linearises the loop about the corrected simulation and propagates its
covariance (extended Kalman filter); `innovations` flies with gains that are given, so that its
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

from sim_jax.plant import Plant
from sim_jax.rigid_body import Motion
from sim_jax.rollout import begun
from sim_jax.rotation import Quaternion
from sim_jax.sensing import GyroMemory
from sim_jax.state import State
from sim_jax.trees import replaced, row_of
from sim_jax.vector import Vec3
from tuner.filter_error.disturbances import COUNT, Processes, disturbance_of, processes_of
from tuner.filter_error.recorded import Sampled
from tuner.objective.criterion import OFFSET_UNIT, units_of
from tuner.objective.markers import markers_of
from tuner.objective.residuals import beginning_of
from tuner.objective.segments import CLOCK_OF, CLOCKS, OFFSETS, Segments
from tuner.objective.simulator import Simulator
from tuner.objective.tunable import Tunable
from tuner.parallel import over_devices

T = TypeVar("T")

GATE = 4.0
"""Standard deviations beyond which an innovation corrects no further: an outlier."""


class Feed(eqx.Module):
    """What an observer needs of its segments, F of which lie along the last axis.

    Attributes
    ----------
    segments
        Their inlet takes set-points.
    offsets
        (offsets, F) of the point.
    samples
        Channel -> its samples on ticks.
    """

    segments: Segments
    offsets: Float[Array, "O F"]
    samples: dict[str, Sampled]


class Expected(eqx.Module):
    """What an observer takes for true.

    Attributes
    ----------
    tunable, coefficients
        The model, and its search vector (K,).
    strengths
        (6,) of the disturbances.
    noise
        (m,) factors on the standard deviations of the samples.
    """

    tunable: Tunable
    coefficients: Float[Array, " K"]
    strengths: Float[Array, " 6"]
    noise: Float[Array, " m"]


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


class _Observer(eqx.Module):
    """The stepped loop with its disturbances and its samples."""

    plant: Plant
    processes: Processes
    late: Float[Array, "O F"]
    channels: tuple[str, ...] = eqx.field(static=True)
    rate: float = eqx.field(static=True)

    @staticmethod
    def of(simulator: Simulator, feed: Feed, expected: Expected) -> tuple[_Observer, State]:
        """Return the observer, and the state in which the segments begin."""
        model, schedule = expected.tunable.at(expected.coefficients), simulator.schedule
        units = units_of(simulator.conditions)
        conditions = {
            name: feed.offsets[len(OFFSETS) + row] * units[row]
            for row, name in enumerate(simulator.conditions)
        }
        start, inlet, environment = beginning_of(
            model, feed.segments, schedule, conditions=conditions
        )
        plant, state = begun(
            model.vehicle,
            model.controller,
            schedule,
            inlet,
            start,
            environment=environment,
            limits=simulator.limits,
        )
        rate = float(schedule.log_rate)
        processes = processes_of(model.vehicle, expected.strengths, rate)
        late = feed.offsets[: len(OFFSETS)] * OFFSET_UNIT
        return _Observer(plant, processes, late, tuple(feed.samples), rate), state

    def next(self, state: State, disturbance: Array, tick: Array) -> State:
        """Return the state a tick later."""
        environment = eqx.tree_at(
            lambda e: e.disturbance,
            self.plant.environment,
            disturbance_of(disturbance),
            is_leaf=lambda leaf: leaf is None,
        )
        plant = eqx.tree_at(lambda p: p.environment, self.plant, environment)
        after: State = plant.sample(state, tick)[0]
        return after

    def seen(self, state: State, tick: Array) -> dict[str, Array]:
        """Return channel -> (c, F), what a recording would hold."""
        motion, markers = state.motion, markers_of(self.plant.vehicle)
        position, attitude = motion.position, motion.attitude
        if markers is not None:
            position, attitude = markers.recorded(motion)
        command = state.command
        if "command" in self.channels:
            command = self.plant.inlet.next_command(self.plant, state, tick).command
        rate = motion.body_rate
        signals = {
            "position": (position.x, position.y, position.z),
            "attitude": (attitude.w, attitude.x, attitude.y, attitude.z),
            "body_rate": (rate.x, rate.y, rate.z),
            "rotor_speed": state.rotor_speed,
            "command": command,
        }
        shape = self.late.shape[1:]
        return {
            name: jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in signals[name]])
            for name in self.channels
        }

    def errors(
        self, now: dict[str, Array], before: dict[str, Array], samples: dict[str, Sampled]
    ) -> Array:
        """Return what is seen minus what was sampled (m, F), in standard deviations."""
        rows = []
        for name, sample in samples.items():
            place = sample.place - self.late[CLOCK_OF[name]] * self.rate
            there = before[name] + place * (now[name] - before[name])
            if name == "attitude":
                seen = Quaternion.of(there).normalized()
                error = Quaternion.of(sample.values).rotation_vector_to(seen).stacked()
            elif name == "command":
                error = now[name] - sample.values
            elif name == "body_rate":
                error = there + self.late[len(CLOCKS) :] - sample.values
            else:
                error = there - sample.values
            rows.append(jnp.where(sample.weight > 0, error * sample.weight, 0.0))
        return jnp.concatenate(rows)


def _parts(state: State) -> tuple[Motion, Any, Vec3, GyroMemory]:
    """Return what is corrected of a state: 32 numbers with both gyro filters."""
    return state.motion, state.rotor_speed, state.integral, state.gyro


def _numbers(state: State) -> Array:
    """Return what is corrected of a state, (n, F)."""
    return jnp.stack(jax.tree.leaves(_parts(state)))


def _corrected(state: State, change: Array) -> State:
    """Return a state moved by a change (n, F); its attitude stays a rotation."""
    leaves, structure = jax.tree.flatten(_parts(state))
    moved = [leaf + row for leaf, row in zip(leaves, change, strict=True)]
    motion, rotor_speed, integral, gyro = jax.tree.unflatten(structure, moved)
    motion = Motion(
        motion.position, motion.velocity, motion.attitude.normalized(), motion.body_rate
    )
    return replaced(state, motion=motion, rotor_speed=rotor_speed, integral=integral, gyro=gyro)


def _first_errors(state: State) -> np.ndarray[Any, Any]:
    """Return the standard deviations (n,) of the state in which a flight begins."""

    def filled(tree: Any, sd: float) -> Any:
        return jax.tree.map(lambda _: sd, tree)

    motion, rotor_speed, integral, gyro = _parts(state)
    errors = (
        Motion(
            filled(motion.position, 1e-3),
            filled(motion.velocity, 0.02),
            filled(motion.attitude, 0.0025),
            filled(motion.body_rate, 0.03),
        ),
        filled(rotor_speed, 3.0),
        filled(integral, 0.01),
        GyroMemory(
            filled(gyro.newer, 0.03),
            filled(gyro.older, 0.03),
            filled(gyro.rate, 0.03),
            filled(gyro.acceleration, 0.3),
        ),
    )
    return np.asarray(jax.tree.leaves(errors))


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


def _undelayed(simulator: Simulator, *, commands: bool) -> Simulator:
    """Return a simulator without the delay line of estimates, which rate control does not see.

    And without that of commands, if its numbers are to be corrected, too: there are dozens.
    """
    schedule = replace(simulator.schedule, longest_estimate_latency=0.0, pose_rate=None)
    if commands:
        schedule = replace(schedule, longest_actuator_latency=0.0)
    return replace(simulator, schedule=schedule)


def gains_of(
    simulator: Simulator, feed: Feed, expected: Expected, ticks: int
) -> tuple[Gains, NDArray[np.float64]]:
    """Return the Kalman gains, and each segment's (F,) negative log-likelihood.

    Parameters
    ----------
    simulator, feed, expected
        What flies, the recordings, and what is taken for true.
    ticks
        Up to which the likelihood counts and gains are computed; they are zero beyond.
    """
    return _gains(_undelayed(simulator, commands=True))(feed, expected, np.asarray(ticks))


@lru_cache(maxsize=4)
def _gains(simulator: Simulator) -> Callable[..., tuple[Gains, NDArray[np.float64]]]:
    def segmentwise(feed: Feed, expected: Expected, ticks: Array) -> tuple[Gains, Array]:
        observer, first = _Observer.of(simulator, feed, expected)
        noise = expected.noise
        processes = observer.processes
        segments, size = feed.segments.flight.shape[0], len(_numbers(first)) + COUNT
        total, wide = next(iter(feed.samples.values())).values.shape[0], len(noise)
        zero = jnp.zeros((size, segments))
        unrest = jnp.diag(jnp.concatenate([jnp.zeros(size - COUNT), processes.added]))
        sd = jnp.concatenate([jnp.asarray(_first_errors(first)), processes.sd])

        def tick(number: Array, carried: Any) -> Any:
            state, pushed, covariance, before, loss, kept = carried
            samples = row_of(feed.samples, number)

            def compare(change: Array) -> tuple[Array, Array]:
                moved = _corrected(state, change[:-COUNT])
                errors = observer.errors(observer.seen(moved, number), before, samples)
                return errors, errors

            error, seen = _linearised(compare, zero)
            spread = jnp.einsum("fij,fmj->fim", covariance, seen)
            innovation = jnp.einsum("fmi,fin->fmn", seen, spread) + jnp.diag(noise**2)
            factor = jnp.linalg.cholesky(innovation)
            whitens = solve_triangular(
                factor, jnp.broadcast_to(jnp.eye(wide), factor.shape), lower=True
            )
            gain = jnp.einsum("fim,fkm->fik", spread, whitens)
            white = jnp.einsum("fkm,mf->kf", whitens, error)
            covariance = covariance - jnp.einsum("fik,fjk->fij", gain, gain)
            deviance = jnp.minimum(white**2, 2.0 * GATE * jnp.abs(white) - GATE**2)
            scatter = jnp.log(jnp.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
            kept = jax.tree.map(
                lambda rows, row: lax.dynamic_update_index_in_dim(
                    rows, jnp.moveaxis(row, 0, -1).astype(rows.dtype), number, 0
                ),
                kept,
                Gains(gain, whitens),
            )
            change = -jnp.einsum("fik,kf->if", gain, jnp.clip(white, -GATE, GATE))
            state, pushed = _corrected(state, change[:-COUNT]), pushed + change[-COUNT:]
            before = observer.seen(state, number)

            def advance(change: Array) -> tuple[Array, State]:
                moved = _corrected(state, change[:-COUNT])
                after = observer.next(moved, pushed + change[-COUNT:], number)
                kept = processes.keeps[:, None] * change[-COUNT:]
                return jnp.concatenate([_numbers(after), kept]), after

            state, follows = _linearised(advance, zero)
            covariance = jnp.einsum("fij,fjk,flk->fil", follows, covariance, follows) + unrest
            covariance = 0.5 * (covariance + jnp.swapaxes(covariance, 1, 2))
            return (
                state,
                pushed * processes.keeps[:, None],
                covariance,
                before,
                loss + 0.5 * deviance.sum(axis=0) + scatter,
                kept,
            )

        empty = Gains(
            jnp.zeros((total, size, wide, segments), jnp.float32),
            jnp.zeros((total, wide, wide, segments), jnp.float32),
        )
        begin = (
            first,
            jnp.zeros((COUNT, segments)),
            jnp.broadcast_to(jnp.diag(sd**2), (segments, size, size)),
            observer.seen(first, jnp.asarray(0)),
            jnp.zeros(segments),
            empty,
        )
        *_, loss, kept = lax.fori_loop(0, ticks, tick, begin)
        return kept, loss

    return over_devices(segmentwise, name=("observer's gains", simulator))


def innovations(
    simulator: Simulator, feed: Feed, gains: Gains, expected: Expected, directions: ArrayLike
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return whitened innovations (T, m, F) with given gains, and derivatives (N, T, m, F).

    Parameters
    ----------
    simulator, feed, expected
        As of `gains_of`.
    gains
        Of the observer.
    directions
        (N, K + offsets): along which is differentiated.
    """
    return _innovations(_undelayed(simulator, commands=False))(
        (feed, gains), expected, np.asarray(directions, float)
    )


@lru_cache(maxsize=4)
def _innovations(
    simulator: Simulator,
) -> Callable[..., tuple[NDArray[np.float64], NDArray[np.float64]]]:
    def segmentwise(
        batch: tuple[Feed, Gains], expected: Expected, directions: Array
    ) -> tuple[Array, Array]:
        feed, gains = batch
        vector = expected.coefficients

        def flown(vector: Array, offsets: Array) -> Array:
            moved = eqx.tree_at(lambda f: f.offsets, feed, offsets)
            at = eqx.tree_at(lambda e: e.coefficients, expected, vector)
            observer, state = _Observer.of(simulator, moved, at)

            def tick(carried: Any, given: Any) -> tuple[Any, Array]:
                state, pushed, before = carried
                number, samples, gain = given
                error = observer.errors(observer.seen(state, number), before, samples)
                white = jnp.einsum("kmf,mf->kf", gain.whitens, error)
                change = -jnp.einsum("ikf,kf->if", gain.gain, jnp.clip(white, -GATE, GATE))
                state, pushed = _corrected(state, change[:-COUNT]), pushed + change[-COUNT:]
                before = observer.seen(state, number)
                after = observer.next(state, pushed, number)
                return (after, pushed * observer.processes.keeps[:, None], before), white

            begin = (
                state,
                jnp.zeros((COUNT, offsets.shape[-1])),
                observer.seen(state, jnp.asarray(0)),
            )
            numbers = jnp.arange(gains.gain.shape[0])
            white: Array = lax.scan(tick, begin, (numbers, feed.samples, gains))[1]
            return white

        def push(direction: Array) -> tuple[Array, Array]:
            along = direction[len(vector) :, None] * jnp.ones_like(feed.offsets)
            return jax.jvp(flown, (vector, feed.offsets), (direction[: len(vector)], along))

        pushed: tuple[Array, Array] = jax.vmap(push, out_axes=(None, 0))(directions)
        return pushed

    return over_devices(segmentwise, name=("observer's innovations", simulator))
