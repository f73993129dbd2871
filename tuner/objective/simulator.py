"""A simulation of some segments, compared with their recordings and differentiated forwards.

Everything here is a function of arrays, to be compiled; `tuner.objective.normal` gives it a fit's
data, on all devices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from sim_jax.crash import Limits
from sim_jax.schedule import Schedule
from tuner.objective.criterion import (
    OFFSET_UNIT,
    Jacobian,
    SegmentData,
    SegmentSums,
    units_of,
)
from tuner.objective.initial_conditions import eliminated
from tuner.objective.loss import count, gauss_newton, robust_loss
from tuner.objective.residuals import Trace, residuals, simulate_segments, trace_of
from tuner.objective.segments import OFFSETS, Segments
from tuner.objective.tunable import Tunable
from tuner.parallel import piece_that_fits

MEMORY = 2**30
"""bytes that derivatives take at most by default while they are computed, on all devices."""
FEW = 4
"""Segments of a device below which they fly one at a time, if they are differentiated: nothing lies
between a segment's columns then, and these fill the vector registers, which so few segments do not.
On the four reference flights a Jacobian by twelve columns takes 0.23 s of processor time so, and
0.42 s with a device's two segments at once; of eight flights 0.44 s, and 0.39 s with four."""


@dataclass(frozen=True)
class Simulator:
    """The static half of an objective: its methods are functions of arrays alone."""

    schedule: Schedule
    capacity: int
    """Samples of a log, those that pad it included."""
    limits: Limits
    memory: int = MEMORY
    conditions: tuple[str, ...] = ()
    """What surrounds each flight and enters its simulation, behind the offsets."""

    def segments_at_once(self, data: SegmentData, moving: int) -> int:
        """Return how many of a device's segments fly at a time: what fits its cache and the memory.

        ``moving`` is how many parameters it differentiates by; zero if only by free starts.
        """
        starts = 0 if data.states is None else len(data.states)
        columns = moving + len(self.conditions) + starts if moving else 1 + starts
        recorded = sum(
            m.values.shape[0] * m.values.shape[1] for m in data.segments.measured.values()
        )
        logged = self.capacity * sum(m.values.shape[1] for m in data.segments.measured.values())
        # the flown derivatives twice, those of the residuals as such and weighted
        bytes_of_segment = 8 * (columns + 1) * (2 * logged + 2 * recorded)
        share = self.memory // len(jax.devices())
        if moving and data.segments.count < FEW:
            return 1
        return max(1, min(piece_that_fits(8, columns), share // bytes_of_segment))

    def fly(
        self,
        model: Tunable,
        segments: Segments,
        coefficients: Array,
        horizon: Array | None,
        *,
        states: Array | None = None,
        conditions: Array | None = None,
    ) -> Trace:
        """Simulate some segments with a search vector (K,) up to a horizon in samples, or whole.

        What surrounds them are (conditions, F) in the units of `units_of`.
        """
        surroundings = {}
        if conditions is not None:
            units = units_of(self.conditions)
            surroundings = {
                name: conditions[row] * units[row] for row, name in enumerate(self.conditions)
            }
        moved = model.at(coefficients)
        flown = simulate_segments(
            moved,
            segments,
            self.schedule,
            samples=self.capacity,
            horizon=horizon,
            limits=self.limits,
            states=states,
            conditions=surroundings,
        )
        return trace_of(flown, moved, segments, surroundings)

    def conditions_in(self, offsets: Array) -> Array | None:
        """Return what surrounds the segments, (conditions, F), of their rows of a point."""
        return offsets[len(OFFSETS) :] if self.conditions else None

    def compared(
        self, data: SegmentData, model: Tunable, coefficients: Array, horizon: Array
    ) -> tuple[Trace, dict[str, Array]]:
        """Return the simulation and channel -> (n, k, F) residuals in standard deviations."""
        conditions = self.conditions_in(data.offsets)
        trace = self.fly(
            model,
            data.segments,
            coefficients,
            horizon,
            states=data.states,
            conditions=conditions,
        )
        return trace, self.residuals(data, horizon, trace, data.offsets)

    def residuals(
        self, data: SegmentData, horizon: Array, trace: Trace, offsets: Array
    ) -> dict[str, Array]:
        """Return channel -> (n, k, F) residuals of a simulation at some offsets (offsets, F)."""
        return residuals(
            trace,
            data.segments,
            offsets[: len(OFFSETS)] * OFFSET_UNIT,
            data.reference_offset,
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
            trace, errors, columns = self._with_columns(
                data, model, coefficients, horizon, starts_only=not derivatives
            )
        else:
            trace, errors = self.compared(data, model, coefficients, horizon)
            columns = None
        squares = {name: jnp.sum(e * e, axis=(0, 1)) for name, e in errors.items()}
        rate = float(self.schedule.log_rate)
        counts = {name: count(data.segments, name, rate, horizon) for name in errors}
        scaled = {name: e / data.scale[name] for name, e in errors.items()}
        loss = robust_loss(scaled, huber)
        segments = jnp.shape(data.offsets)[-1]
        size = len(coefficients) + len(data.offsets)
        gradient, hessian, states = (
            jnp.zeros((size, segments)),
            jnp.zeros((size, size, segments)),
            None,
        )
        if columns is not None:
            slope, square = gauss_newton(columns, scaled, data.scale, huber)
            if data.states is not None:
                loss, slope, square, states = eliminated(loss, slope, square, data.states)
                for name, column in columns.items():
                    by_start = column[len(column) - len(states) :]
                    change = jnp.einsum("lnkf,lf->nkf", by_start, states - data.states)
                    squares[name] = jnp.sum((errors[name] + change) ** 2, axis=(0, 1))
            if derivatives:
                gradient, hessian = slope, square
        return SegmentSums(loss, gradient, hessian, squares, counts, trace.crash_time, states)

    def jacobian(
        self, data: SegmentData, model: Tunable, coefficients: Array, horizon: Array
    ) -> Jacobian:
        """Return every residual of some segments and its derivatives."""
        trace, errors, columns = self._with_columns(data, model, coefficients, horizon)
        return Jacobian(errors, columns, trace.crash_time)

    @partial(jax.jit, static_argnums=0, static_argnames="starts_only")
    def _with_columns(
        self,
        data: SegmentData,
        model: Tunable,
        coefficients: Array,
        horizon: Array,
        *,
        starts_only: bool = False,
    ) -> tuple[Trace, dict[str, Array], dict[str, Array]]:
        """Return simulation, residuals and channel -> (Q, n, k, F) derivatives.

        By coefficients, offsets, what surrounds a flight, and starts; or by the last alone, which
        is all that a loss without them needs. An offset does not enter the simulation, so that its
        column costs an interpolation; what surrounds a flight does. Compiled by name, so that what
        builds on it is traced only once.
        """
        offsets = data.offsets[: len(OFFSETS)]
        trace, moved = _jacobian_forward(
            lambda vector, states, conditions: self.fly(
                model, data.segments, vector, horizon, states=states, conditions=conditions
            ),
            coefficients,
            data.states,
            self.conditions_in(data.offsets),
            starts_only=starts_only,
        )

        def compare(flown: Trace, late: Array) -> dict[str, Array]:
            return self.residuals(data, horizon, flown, late)

        by_flight = jax.vmap(
            lambda change: jax.jvp(lambda flown: compare(flown, offsets), (trace,), (change,))[1]
        )(moved)
        if starts_only:
            return trace, compare(trace, offsets), by_flight
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
    simulate: Callable[[Array, Array | None, Array | None], Trace],
    vector: Array,
    states: Array | None,
    conditions: Array | None,
    *,
    starts_only: bool,
) -> tuple[Trace, Trace]:
    """Return a simulation and its derivatives by a vector (K,), conditions and starts (rows, F).

    Or by the starts alone. All segments' starts, or conditions, move at once: a segment depends on
    its own alone.
    """
    count, rows = len(vector), 0 if conditions is None else len(conditions)
    basis = jnp.eye(count + rows + (0 if states is None else len(states)), dtype=vector.dtype)
    basis = basis[count + rows :] if starts_only else basis

    def push(direction: Array) -> tuple[Trace, Trace]:
        if states is None and conditions is None:
            flown, moved = jax.jvp(lambda v: simulate(v, None, None), (vector,), (direction,))
            return flown, moved

        def turned(values: Array | None, first: int) -> Array | None:
            if values is None:
                return None
            return direction[first : first + len(values), None] * jnp.ones_like(values)

        flown, moved = jax.jvp(
            simulate,
            (vector, states, conditions),
            (direction[:count], turned(states, count + rows), turned(conditions, count)),
        )
        return flown, moved

    pushed: tuple[Trace, Trace] = jax.vmap(push, out_axes=(None, 0))(basis)
    return pushed
