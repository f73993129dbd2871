"""Loss, gradient and Gauss-Newton Hessian of a fit, segment by segment, keeping no Jacobian."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from sim_jax.crash import Limits
from sim_jax.numeric import Array
from sim_jax.schedule import Schedule
from tuner.objective.criterion import (
    Criterion,
    Jacobian,
    Point,
    SegmentData,
    SegmentSums,
)
from tuner.objective.segments import OFFSETS, Segments
from tuner.objective.simulator import MEMORY, Simulator
from tuner.objective.space import Space
from tuner.objective.tunable import Tunable, tunable_of
from tuner.vehicle.model import Model


class Objective(eqx.Module):
    """A fit as a function of a point.

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
    """What surrounds each flight and is estimated with it, of `tuner.vehicle.conditions`."""
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
        return Point(np.asarray(vector), np.zeros((len(self.of_flight), self.flights)))

    @property
    def simulator(self) -> Simulator:
        """The static half."""
        return Simulator(self.schedule, self.samples, self.limits, self.memory, self.conditions)

    @property
    def tunable(self) -> Tunable:
        """The model and what moves it."""
        return tunable_of(self.model, self.space)

    def sums(
        self, point: Point, criterion: Criterion, *, derivatives: bool = True, still: bool = False
    ) -> SegmentSums:
        """Return every segment's contribution at a point.

        Where coefficients are ``still``, derivatives are those by what each flight has of its own.
        """
        sums = self.simulator.sums(
            self.data(point.offsets, criterion),
            self.tunable,
            np.asarray(point.coefficients),
            int(criterion.horizon),
            float(criterion.huber),
            derivatives=derivatives,
            still=still,
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

    def sums_of(
        self, points: Point, criterion: Criterion, *, derivatives: bool = True
    ) -> SegmentSums:
        """Return every segment's contribution at S points; all leaves have S first."""
        coefficients, offsets = np.asarray(points.coefficients), np.asarray(points.offsets)
        parts = [
            self.sums(Point(vector, late), criterion, derivatives=derivatives)
            for vector, late in zip(coefficients, offsets, strict=True)
        ]
        together: SegmentSums = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
        return together

    def jacobian(self, point: Point, criterion: Criterion) -> Jacobian:
        """Return every residual's derivatives."""
        return self.simulator.jacobian(
            self.data(point.offsets, criterion),
            self.tunable,
            np.asarray(point.coefficients),
            int(criterion.horizon),
        )

    def residuals(self, point: Point, criterion: Criterion) -> dict[str, NDArray[np.float64]]:
        """Return channel -> (n, k, F) residuals, without derivatives."""
        return self.simulator.errors(
            self.data(point.offsets, criterion),
            self.tunable,
            np.asarray(point.coefficients),
            int(criterion.horizon),
        )[1]

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
        Of `tuner.vehicle.conditions`.
    """
    added = tuple(name for name in names if name not in objective.conditions)
    wider = replace(objective, conditions=(*objective.conditions, *added))
    nothing = np.zeros((len(added), objective.flights))
    return wider, Point(point.coefficients, np.concatenate([point.offsets, nothing]))
