"""Loss, gradient and Gauss-Newton Hessian of a fit, segment by segment, keeping no Jacobian."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float, Int

from sim_jax.crash import Limits
from sim_jax.schedule import Schedule
from tuner.coefficients.space import Space
from tuner.model import Model, with_coefficients
from tuner.objective.criterion import (
    OFFSET_UNIT,
    Criterion,
    Jacobian,
    Point,
    SegmentData,
    SegmentSums,
)
from tuner.objective.initial_conditions import eliminated
from tuner.objective.residuals import Trace, fly, residuals
from tuner.objective.segments import OFFSETS, Segments
from tuner.objective.tunable import Tunable, tunable_of
from tuner.padding import padded_size
from tuner.parallel import in_pieces, over_devices, piece_that_fits

MEMORY = 2**30
"""bytes that derivatives take at most by default while they are computed, on all devices."""


class Objective(eqx.Module):
    """A fit as a function of a point: data and model are leaves, so that it compiles once a shape.

    Attributes
    ----------
    model
        Fixed coefficients and the controllers.
    segments
        The data.
    space
        Free coefficients.
    schedule, samples, limits
        How the simulation runs.
    """

    model: Model
    segments: Segments
    space: Space = eqx.field(static=True)
    schedule: Schedule = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    memory: int = eqx.field(static=True, default=MEMORY)
    """bytes that derivatives may take while they are computed: segments beyond take turns."""

    @property
    def flights(self) -> int:
        """How many flights the segments belong to."""
        return int(np.max(np.asarray(self.segments.flight))) + 1

    def start(self, vector: np.ndarray[Any, Any]) -> Point:
        """Return a point with a search vector and no offset."""
        return Point(jnp.asarray(vector), jnp.zeros((len(OFFSETS), self.flights)))

    @property
    def flier(self) -> Flier:
        """The static half, by which compiled functions are kept."""
        return Flier(self.schedule, padded_size(self.samples), self.limits, self.memory)

    @property
    def tunable(self) -> Tunable:
        """The model and what moves it."""
        return tunable_of(self.model, self.space)

    def simulate(self, coefficients: Float[Array, " K"], horizon: Int[Array, ""]) -> Trace:
        """Fly every segment with a search vector."""
        return self.flier.fly(self.tunable, self.segments, coefficients, horizon)

    def sums(self, point: Point, criterion: Criterion, *, derivatives: bool = True) -> SegmentSums:
        """Return every segment's contribution at a point, computed on all devices."""
        alone = jax.tree.map(lambda leaf: np.asarray(leaf)[None], point)
        found: SegmentSums = jax.tree.map(
            lambda leaf: leaf[0], self.sums_of(alone, criterion, derivatives=derivatives)
        )
        return found

    def sums_of(
        self, points: Point, criterion: Criterion, *, derivatives: bool = True
    ) -> SegmentSums:
        """Return every segment's contribution at S points; all leaves have S first."""
        found: SegmentSums = _shared_sums(self.flier, derivatives)(
            self.data(points.offsets, criterion),
            self.tunable,
            np.asarray(points.coefficients),
            np.asarray(criterion.horizon),
            np.asarray(criterion.huber),
        )
        return found

    def jacobian(
        self, point: Point, criterion: Criterion, *, columns: int | None = None
    ) -> Jacobian:
        """Return every residual's derivatives, computed on all devices.

        They are computed for ``columns`` parameters at a time, or all of them.
        """
        vector, data = np.asarray(point.coefficients), self.data(point.offsets, criterion)
        model = with_coefficients(self.model, self.space.values(jnp.asarray(vector)))
        count = len(self.space) if columns is None else columns
        parts = []
        for first in range(0, len(vector), count):
            some = Space(self.space.parameters[first : first + count], {})
            moved = np.pad(vector[first : first + count], (0, count - len(some)))
            found = _shared_jacobian(self.flier)(
                data, tunable_of(model, some, count=count), moved, np.asarray(criterion.horizon)
            )
            parts.append((len(some), found))
        return _beside(count, parts)

    def data(self, offsets: Array, criterion: Criterion) -> SegmentData:
        """Return what each device needs of its segments; offsets are (\\*starts, offsets, N)."""
        flight = np.asarray(self.segments.flight)
        own: SegmentData = jax.tree.map(
            np.asarray,
            SegmentData(
                segments=self.segments,
                offsets=offsets[..., flight],
                scale={name: scale[flight] for name, scale in criterion.scale.items()},
                held=criterion.held[:, flight],
                states=criterion.states,
            ),
        )
        return own


def _beside(count: int, parts: Sequence[tuple[int, Jacobian]]) -> Jacobian:
    """Return as one the Jacobians by some parameters each, all followed by what flights own."""
    own, first = parts[0]
    if own == count and len(parts) == 1:
        return first
    columns: dict[str, Any] = {
        name: np.concatenate([part.columns[name][:own] for own, part in parts] + [column[count:]])
        for name, column in first.columns.items()
    }
    return Jacobian(first.residuals, columns, first.crash_time)


@lru_cache(maxsize=16)
def _shared_jacobian(flier: Flier) -> Callable[..., Jacobian]:
    def segmentwise(data: SegmentData, *rest: Any) -> Jacobian:
        pieces = in_pieces(flier.jacobian, flier.segments_at_once(data, len(rest[0].coordinates)))
        found: Jacobian = pieces(data, *rest)
        return found

    return over_devices(segmentwise)


@lru_cache(maxsize=16)
def _shared_sums(flier: Flier, derivatives: bool) -> Callable[..., SegmentSums]:
    """Return the sums over all devices for S points, compiled once however often used."""

    def some(data: SegmentData, model: Tunable, coefficients: Array, *rest: Any) -> SegmentSums:
        def at(point: tuple[Array, Array]) -> SegmentSums:
            vector, offsets = point
            own = eqx.tree_at(lambda d: d.offsets, data, offsets)
            return flier.sums(own, model, vector, *rest, derivatives=derivatives)

        # one start after the other: segments and columns fill the processor already
        found: SegmentSums = lax.map(at, (coefficients, data.offsets))
        return found

    def segmentwise(data: SegmentData, *rest: Any) -> SegmentSums:
        moving = len(rest[0].coordinates) if derivatives or data.states is not None else 0
        pieces = in_pieces(some, flier.segments_at_once(data, moving))
        found: SegmentSums = pieces(data, *rest)
        return found

    return over_devices(segmentwise)


@dataclass(frozen=True)
class Flier:
    """The static half of an objective: its methods are functions of arrays alone."""

    schedule: Schedule
    capacity: int
    """Samples that a log has room for."""
    limits: Limits
    memory: int = MEMORY

    def segments_at_once(self, data: SegmentData, moving: int) -> int:
        """Return how many segments a device flies at a time: what fits its cache and the memory.

        ``moving`` is how many parameters it differentiates by; zero if it does not.
        """
        starts = 0 if data.states is None else len(data.states)
        columns = moving + starts if moving else 1
        recorded = sum(
            m.values.shape[0] * m.values.shape[1] for m in data.segments.measured.values()
        )
        logged = self.capacity * sum(m.values.shape[1] for m in data.segments.measured.values())
        # the flown derivatives twice, those of the residuals as such and weighted
        one = 8 * (columns + 1) * (2 * logged + 2 * recorded)
        share = self.memory // len(jax.devices())
        return max(1, min(piece_that_fits(8, columns), share // one))

    def fly(
        self,
        model: Tunable,
        segments: Segments,
        coefficients: Array,
        horizon: Array | None,
        states: Array | None = None,
    ) -> Trace:
        """Simulate some segments with a search vector (K,) up to a horizon in samples, or whole."""
        return fly(
            model.at(coefficients),
            segments,
            self.schedule,
            samples=self.capacity,
            horizon=horizon,
            limits=self.limits,
            states=states,
        )

    def compared(
        self,
        data: SegmentData,
        model: Tunable,
        coefficients: Array,
        horizon: Array,
        *,
        whole: bool = False,
    ) -> tuple[Trace, dict[str, Array]]:
        """Return the simulation and channel -> (n, k, F) residuals in standard deviations.

        Reverse mode needs the ``whole`` flights flown; the residuals end at the horizon anyway.
        """
        flown = None if whole else horizon
        trace = self.fly(model, data.segments, coefficients, flown, data.states)
        return trace, self._compare(data, horizon, trace, data.offsets)

    def _compare(
        self, data: SegmentData, horizon: Array, trace: Trace, offsets: Array
    ) -> dict[str, Array]:
        return residuals(
            trace,
            data.segments,
            offsets * OFFSET_UNIT,
            data.held,
            rate=float(self.schedule.log_rate),
            horizon=horizon,
        )

    def sums(
        self,
        data: SegmentData,
        model: Tunable,
        coefficients: Array,
        horizon: Array,
        huber: Array,
        *,
        derivatives: bool,
    ) -> SegmentSums:
        """Return what some segments contribute; see `Objective.sums`."""
        if derivatives or data.states is not None:
            trace, errors, columns = self._with_columns(data, model, coefficients, horizon)
        else:
            trace, errors = self.compared(data, model, coefficients, horizon)
            columns = None
        squares = {name: jnp.sum(e * e, axis=(0, 1)) for name, e in errors.items()}
        rate = float(self.schedule.log_rate)
        counts = {name: _count(data.segments, name, rate, horizon) for name in errors}
        scaled = {name: e / data.scale[name] for name, e in errors.items()}
        loss = robust_loss(scaled, huber)
        segments = jnp.shape(data.offsets)[-1]
        size = len(coefficients) + len(OFFSETS)
        gradient, hessian, states = (
            jnp.zeros((size, segments)),
            jnp.zeros((size, size, segments)),
            None,
        )
        if columns is not None:
            gradient, hessian = _normal(columns, scaled, data.scale, huber)
        if data.states is not None:
            loss, gradient, hessian, states = eliminated(loss, gradient, hessian, data.states)
            change = states - data.states
            for name, column in (columns or {}).items():
                there = errors[name] + jnp.einsum("lnkf,lf->nkf", column[size:], change)
                squares[name] = jnp.sum(there * there, axis=(0, 1))
        return SegmentSums(loss, gradient, hessian, squares, counts, trace.crash_time, states)

    def jacobian(
        self, data: SegmentData, model: Tunable, coefficients: Array, horizon: Array
    ) -> Jacobian:
        """Return every residual of some segments and its derivatives."""
        trace, errors, columns = self._with_columns(data, model, coefficients, horizon)
        return Jacobian(errors, columns, trace.crash_time)

    @partial(jax.jit, static_argnums=0)
    def _with_columns(
        self, data: SegmentData, model: Tunable, coefficients: Array, horizon: Array
    ) -> tuple[Trace, dict[str, Array], dict[str, Array]]:
        """Return simulation, residuals and channel -> (Q, n, k, F) derivatives.

        An offset does not enter the simulation, so that its column costs an interpolation. Compiled
        by name, so that all that builds on it is traced only once.
        """
        offsets = data.offsets
        trace, moved = _jacobian_forward(
            lambda vector, starts: self.fly(model, data.segments, vector, horizon, starts),
            coefficients,
            data.states,
        )

        def compare(flown: Trace, late: Array) -> dict[str, Array]:
            return self._compare(data, horizon, flown, late)

        by_flight = jax.vmap(
            lambda change: jax.jvp(lambda flown: compare(flown, offsets), (trace,), (change,))[1]
        )(moved)
        each = jnp.eye(len(offsets), dtype=offsets.dtype)[:, :, None] * jnp.ones_like(offsets)
        by_offset = jax.vmap(
            lambda change: jax.jvp(lambda late: compare(trace, late), (offsets,), (change,))[1]
        )(each)
        count = len(coefficients)
        columns = {
            name: jnp.concatenate([flown[:count], by_offset[name], flown[count:]])
            for name, flown in by_flight.items()
        }
        return trace, compare(trace, offsets), columns


def _jacobian_forward(
    simulate: Callable[[Array, Array | None], Trace], vector: Array, states: Array | None
) -> tuple[Trace, Trace]:
    """Return a simulation and its derivatives, first by a vector (K,), then by starts (L, F).

    All segments' starts move at once: a segment depends on its own alone.
    """
    basis = jnp.eye(len(vector) + (0 if states is None else len(states)), dtype=vector.dtype)

    def push(direction: Array) -> tuple[Trace, Trace]:
        if states is None:
            flown, moved = jax.jvp(lambda v: simulate(v, None), (vector,), (direction,))
            return flown, moved
        turned = direction[len(vector) :, None] * jnp.ones_like(states)
        flown, moved = jax.jvp(simulate, (vector, states), (direction[: len(vector)], turned))
        return flown, moved

    pushed: tuple[Trace, Trace] = jax.vmap(push, out_axes=(None, 0))(basis)
    return pushed


def _normal(
    columns: dict[str, Array], scaled: dict[str, Array], scale: dict[str, Array], huber: Array
) -> tuple[Array, Array]:
    gradient: Array = jnp.zeros(())
    hessian: Array = jnp.zeros(())
    for name, error in scaled.items():
        size = jnp.abs(error)
        weight = jnp.where(size > huber, huber / jnp.where(size > 0, size, 1.0), 1.0)
        column = columns[name] / scale[name]
        weighted = column * weight
        gradient = gradient + jnp.einsum("pnkf,nkf->pf", weighted, error)
        hessian = hessian + jnp.einsum("pnkf,qnkf->pqf", weighted, column)
    return gradient, hessian


def robust_loss(scaled: dict[str, Array], huber: Array) -> Array:
    """Return half the robust sum of squares (F,) of channel -> (n, k, F) scaled residuals."""
    sums = (jnp.sum(robust(error, huber), axis=(0, 1)) for error in scaled.values())
    return 0.5 * sum(sums, jnp.zeros(()))


def robust(error: Array, limit: Array) -> Array:
    """Return Huber's loss of an error: its square, growing linearly beyond a limit."""
    size = jnp.abs(error)
    return jnp.where(size > limit, 2.0 * limit * size - limit * limit, error * error)


def _count(segments: Segments, name: str, rate: float, horizon: Array) -> Array:
    measured = segments.measured[name]
    flown = measured.time * rate < horizon - 1
    return jnp.sum((measured.weight > 0) & flown[:, None], axis=(0, 1)).astype(float)
