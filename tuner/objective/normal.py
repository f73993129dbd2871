"""Loss, gradient and Gauss-Newton Hessian of a fit, segment by segment, keeping no Jacobian."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from sim_jax.crash import Limits
from sim_jax.schedule import Schedule
from tuner.coefficients.space import Space
from tuner.model import Model, with_coefficients
from tuner.objective.criterion import (
    Criterion,
    Jacobian,
    Point,
    SegmentData,
    SegmentSums,
)
from tuner.objective.segments import OFFSETS, Segments
from tuner.objective.simulator import MEMORY, Simulator
from tuner.objective.tunable import Tunable, tunable_of
from tuner.parallel import in_pieces, over_devices, padded_size


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
    conditions: tuple[str, ...] = eqx.field(static=True, default=())
    """What surrounds each flight and is estimated with it, of `tuner.coefficients.conditions`."""
    multiplicity: Float[Array, " N"] | None = None
    """How often each flight counts in loss, gradient and Hessian; None is once."""

    @property
    def of_flight(self) -> tuple[str, ...]:
        """What each flight has of its own, in the order of a point's rows."""
        return (*OFFSETS, *self.conditions)

    @property
    def flights(self) -> int:
        """How many flights the segments belong to."""
        return int(np.max(np.asarray(self.segments.flight))) + 1

    def start(self, vector: np.ndarray[Any, Any]) -> Point:
        """Return a point with a search vector and no offset."""
        return Point(jnp.asarray(vector), jnp.zeros((len(self.of_flight), self.flights)))

    @property
    def simulator(self) -> Simulator:
        """The static half, by which compiled functions are kept."""
        return Simulator(
            self.schedule,
            padded_size(self.samples),
            self.limits,
            self.memory,
            self.conditions,
        )

    @property
    def tunable(self) -> Tunable:
        """The model and what moves it."""
        return tunable_of(self.model, self.space)

    def sums(self, point: Point, criterion: Criterion, *, derivatives: bool = True) -> SegmentSums:
        """Return every segment's contribution at a point, computed on all devices."""
        alone = jax.tree.map(lambda leaf: np.asarray(leaf)[None], point)
        sums: SegmentSums = jax.tree.map(
            lambda leaf: leaf[0], self.sums_of(alone, criterion, derivatives=derivatives)
        )
        return sums

    def sums_of(
        self, points: Point, criterion: Criterion, *, derivatives: bool = True
    ) -> SegmentSums:
        """Return every segment's contribution at S points; all leaves have S first."""
        sums: SegmentSums = _shared_sums(self.simulator, derivatives)(
            self.data(points.offsets, criterion),
            self.tunable,
            np.asarray(points.coefficients),
            np.asarray(criterion.horizon),
            np.asarray(criterion.huber),
        )
        if self.multiplicity is None:
            return sums
        often = np.asarray(self.multiplicity)[np.asarray(self.segments.flight)]
        return replace(
            sums,
            loss=sums.loss * often,
            gradient=sums.gradient * often,
            hessian=sums.hessian * often,
        )

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
            jacobian = _shared_jacobian(self.simulator)(
                data, tunable_of(model, some, count=count), moved, np.asarray(criterion.horizon)
            )
            parts.append((len(some), jacobian))
        return _beside(count, parts)

    def data(self, offsets: Array, criterion: Criterion) -> SegmentData:
        """Return what each device needs of its segments; offsets are (\\*starts, offsets, N)."""
        flight = np.asarray(self.segments.flight)
        by_segment: SegmentData = jax.tree.map(
            np.asarray,
            SegmentData(
                segments=self.segments,
                offsets=offsets[..., flight],
                scale={name: scale[flight] for name, scale in criterion.scale.items()},
                reference_offset=criterion.reference_offset[:, flight],
                states=criterion.states,
            ),
        )
        return by_segment


def with_conditions(
    objective: Objective, point: Point, names: Sequence[str]
) -> tuple[Objective, Point]:
    """Return a problem in which more surrounds each flight, and its point, where that is nothing.

    Parameters
    ----------
    objective, point
        The problem, and where it stands.
    names
        Of `tuner.coefficients.conditions`.
    """
    added = tuple(name for name in names if name not in objective.conditions)
    wider = replace(objective, conditions=(*objective.conditions, *added))
    nothing = jnp.zeros((len(added), objective.flights))
    return wider, Point(point.coefficients, jnp.concatenate([point.offsets, nothing]))


def _beside(count: int, parts: Sequence[tuple[int, Jacobian]]) -> Jacobian:
    """Return as one the Jacobians by some parameters each, all followed by the flights' offsets."""
    moved, first = parts[0]
    if moved == count and len(parts) == 1:
        return first
    columns: dict[str, Any] = {
        name: np.concatenate(
            [part.columns[name][:moved] for moved, part in parts] + [column[count:]]
        )
        for name, column in first.columns.items()
    }
    return Jacobian(first.residuals, columns, first.crash_time)


@lru_cache(maxsize=16)
def _shared_jacobian(simulator: Simulator) -> Callable[..., Jacobian]:
    def segmentwise(data: SegmentData, *rest: Any) -> Jacobian:
        pieces = in_pieces(
            simulator.jacobian, simulator.segments_at_once(data, len(rest[0].coordinates))
        )
        jacobian: Jacobian = pieces(data, *rest)
        return jacobian

    return over_devices(segmentwise, name=("jacobian", simulator))


@lru_cache(maxsize=16)
def _shared_sums(simulator: Simulator, derivatives: bool) -> Callable[..., SegmentSums]:
    """Return the sums over all devices for S points, compiled once however often used."""

    def some(data: SegmentData, model: Tunable, coefficients: Array, *rest: Any) -> SegmentSums:
        def at(point: tuple[Array, Array]) -> SegmentSums:
            vector, offsets = point
            at_offsets = eqx.tree_at(lambda d: d.offsets, data, offsets)
            return simulator.sums(at_offsets, model, vector, *rest, derivatives=derivatives)

        # one start after the other: segments and columns fill the processor already
        sums: SegmentSums = lax.map(at, (coefficients, data.offsets))
        return sums

    def segmentwise(data: SegmentData, *rest: Any) -> SegmentSums:
        moving = len(rest[0].coordinates) if derivatives else 0
        pieces = in_pieces(some, simulator.segments_at_once(data, moving))
        sums: SegmentSums = pieces(data, *rest)
        return sums

    return over_devices(segmentwise, name=("sums", simulator, derivatives))
