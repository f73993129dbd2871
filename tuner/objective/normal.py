"""Loss, gradient and Gauss-Newton Hessian of a fit, segment by segment, keeping no Jacobian.

Flying is a kernel's (`tuner.objective.simulation`); reading a simulation at the recorded stamps and
summing up is linear, and NumPy's. While sums are made, segments come first in every array, columns
of derivatives last.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

from sim_jax.schedule import Schedule
from sim_jax.state import Limits
from tuner.objective.criterion import (
    OFFSET_UNIT,
    Criterion,
    Jacobian,
    Point,
    SegmentSums,
    units_of,
)
from tuner.objective.initial_conditions import eliminated
from tuner.objective.residuals import Reading, gauss_newton, residuals, robust
from tuner.objective.segments import OFFSETS, Segments
from tuner.objective.simulation import Flown, fly
from tuner.objective.space import Space
from tuner.vehicle.model import Model, with_coefficients

Array = NDArray[np.float64]

MEMORY = 2**30
"""bytes that derivatives take at most by default while they are computed."""
LOGGED = 8
"""Share of them, one in so many, that is logged at a time where residuals are kept."""


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
        How the simulation runs, and how many samples a log has at most.
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
    def flight(self) -> NDArray[np.intp]:
        """The number (F,) of the flight that each segment belongs to."""
        return np.asarray(self.segments.flight)

    @property
    def flights(self) -> int:
        """How many flights the segments belong to."""
        return int(np.max(self.flight)) + 1

    @property
    def channels(self) -> tuple[str, ...]:
        """What was measured, in the order of jax's trees: sums do not depend on how it was laid."""
        return tuple(sorted(self.segments.measured))

    def model_at(self, vector: ArrayLike) -> Model:
        """Return the model with the coefficients of a search vector (K,)."""
        values = self.space.values(np.asarray(vector))
        return with_coefficients(self.model, {name: np.asarray(v) for name, v in values.items()})

    def start(self, vector: ArrayLike) -> Point:
        """Return a point with a search vector and no offset."""
        return Point(np.asarray(vector), np.zeros((len(self.of_flight), self.flights)))

    def conditions_at(self, point: Point) -> dict[str, Array]:
        """Return what surrounds each flight at a point: name -> (N,), in its unit."""
        rows, units = np.asarray(point.offsets)[len(OFFSETS) :], units_of(self.conditions)
        return {name: rows[row] * units[row] for row, name in enumerate(self.conditions)}

    def fly(
        self,
        point: Point,
        criterion: Criterion,
        moving: Mapping[str, int] = MappingProxyType({}),
    ) -> Flown:
        """Fly the segments up to the criterion's horizon.

        Parameters
        ----------
        point
            Its coefficients are a search vector (K,), or (F, K), each segment's own.
        criterion
            Gives the horizon and the starts.
        moving
            By what is differentiated, and by how many columns each: ``coefficients``,
            ``conditions``, ``states``, in this order.
        """
        conditions = self.conditions_at(point)
        return fly(
            self.model,
            self.segments,
            self.schedule,
            samples=min(criterion.horizon, self.samples),
            limits=self.limits,
            coefficients=self.space.values(point.coefficients),
            states=None if criterion.states is None else criterion.states,
            conditions={name: values[self.flight] for name, values in conditions.items()},
            tangents=self._directions(point, moving) or None,
        )

    def reading(
        self,
        point: Point,
        criterion: Criterion,
        moving: Mapping[str, int] = MappingProxyType({}),
    ) -> Reading:
        """Return how such a simulation is read to be compared; the arguments are those of `fly`."""
        return Reading(
            np.asarray(point.offsets)[: len(OFFSETS), self.flight] * OFFSET_UNIT,
            criterion.reference_offset[:, self.flight],
            float(self.schedule.log_rate),
            criterion.horizon,
            sum(moving.values()),
            moving.get("coefficients", 0) if "conditions" in moving else None,
            OFFSET_UNIT,
        )

    def sums(
        self, point: Point, criterion: Criterion, *, derivatives: bool = True, still: bool = False
    ) -> SegmentSums:
        """Return every segment's contribution at a point.

        Where coefficients are ``still``, derivatives are those by what each flight has of its own.
        """
        moving = self._moving(criterion, derivatives=derivatives, still=still)
        parts = [
            part._sums(point, of_part, moving)
            for _, part, of_part in self._in_turn(criterion, moving, self.memory)
        ]
        sums: SegmentSums = jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=-1), *parts)
        if self.multiplicity is None:
            return sums
        often = np.asarray(self.multiplicity)[self.flight]
        return replace(
            sums,
            loss=sums.loss * often,
            gradient=sums.gradient * often,
            hessian=sums.hessian * often,
        )

    def jacobian(self, point: Point, criterion: Criterion) -> Jacobian:
        """Return every residual's derivatives."""
        return Jacobian(*self._laid_out(point, criterion, self._moving(criterion)))

    def residuals(self, point: Point, criterion: Criterion) -> dict[str, Array]:
        """Return channel -> (n, k, F) residuals, without derivatives."""
        return self._laid_out(point, criterion, {})[0]

    def _moving(
        self, criterion: Criterion, *, derivatives: bool = True, still: bool = False
    ) -> dict[str, int]:
        """Return by what sums are differentiated: by their starts at least, to eliminate these."""
        moving = {} if criterion.states is None else {"states": len(criterion.states)}
        if derivatives:
            moving = {"conditions": len(self.conditions), **moving}
        return moving if still or not derivatives else {"coefficients": len(self.space), **moving}

    def _directions(self, point: Point, moving: Mapping[str, int]) -> dict[str, Array]:
        """Return the directions of all columns: of coefficients, conditions and starts."""
        own: dict[str, dict[str, Array]] = {}
        for part, count in moving.items():
            if part == "coefficients":
                own[part] = self.space.slopes(point.coefficients)
            elif part == "conditions":
                rows = np.diag(units_of(self.conditions))
                own[part] = dict(zip(self.conditions, rows, strict=True))
            else:
                own[part] = {part: np.eye(count)} if count else {}
        first, directions = 0, {}
        for part, count in moving.items():
            for name, rows in own[part].items():
                directions[name] = np.zeros((sum(moving.values()), *rows.shape[1:]))
                directions[name][first : first + count] = rows
            first += count
        return directions

    def _in_turn(
        self, criterion: Criterion, moving: Mapping[str, int], memory: int
    ) -> Iterator[tuple[slice, Objective, Criterion]]:
        """Return the segments in parts whose logged derivatives fit some bytes of memory."""
        measured = self.segments.measured.values()
        logged = min(criterion.horizon, self.samples) * sum(np.shape(m.values)[1] for m in measured)
        one = 8 * (sum(moving.values()) + 1) * logged
        size = max(int(memory // max(one, 1)), 1)
        for first in range(0, self.segments.count, size):
            some = slice(first, first + size)
            if size >= self.segments.count:
                yield some, self, criterion
            else:
                yield some, *some_segments(self, criterion, some)

    def _sums(self, point: Point, criterion: Criterion, moving: Mapping[str, int]) -> SegmentSums:
        """Return what all segments contribute at once."""
        flown, reading = self.fly(point, criterion, moving), self.reading(point, criterion, moving)
        segments, total, huber = self.segments.count, reading.total, criterion.huber
        gradient, hessian = np.zeros((segments, total)), np.zeros((segments, total, total))
        loss, squares, counts, by_start = np.zeros(segments), {}, {}, {}
        starts = moving.get("states", 0)
        for name in self.channels:
            scale = criterion.scale[name][self.flight]
            square, count = np.zeros(segments), np.zeros(segments)
            slope, bend = np.zeros((segments, starts)), np.zeros((segments, starts, starts))
            for block in residuals(flown, self.segments, name, reading):
                some = block.segments
                square[some] += np.einsum("fnk,fnk->f", block.errors, block.errors)
                count[some] += block.counts.sum(axis=(1, 2))
                scaled = block.errors / scale[some, None, None]
                loss[some] += 0.5 * robust(scaled, huber).sum(axis=(1, 2))
                if total:
                    along, across = gauss_newton(block.columns, scaled, scale[some], huber)
                    gradient[some] += along
                    hessian[some] += across
                if starts:
                    own = block.columns[..., -starts:]
                    slope[some] += np.einsum("fnk,fnkl->fl", block.errors, own)
                    bend[some] += np.einsum("fnkl,fnkm->flm", own, own)
            squares[name], counts[name], by_start[name] = square, count, (slope, bend)
        best = None
        if criterion.states is not None:
            states = criterion.states
            loss, gradient, hessian, best = eliminated(loss, gradient, hessian, states)
            change = (best - states).T
            for name, (slope, bend) in by_start.items():
                squares[name] = squares[name] + np.einsum(
                    "fl,fl->f", change, 2.0 * slope + np.einsum("flm,fm->fl", bend, change)
                )
        if "conditions" not in moving:
            size = len(self.space) + len(self.of_flight)
            gradient, hessian = np.zeros((segments, size)), np.zeros((segments, size, size))
        return SegmentSums(
            loss,
            np.moveaxis(gradient, 0, -1),
            np.moveaxis(hessian, 0, -1),
            squares,
            counts,
            flown.crash_time,
            best,
        )

    def _laid_out(
        self, point: Point, criterion: Criterion, moving: Mapping[str, int]
    ) -> tuple[dict[str, Array], dict[str, Array], Array]:
        """Return channel -> (n, k, F) residuals and (Q, n, k, F) columns; (F,) times of crashes.

        Segments are flown in turn, so that what is logged takes less than what is laid out.
        """
        total = self.reading(point, criterion, moving).total
        errors, columns, crash_time = {}, {}, np.zeros(self.segments.count)
        for name in self.channels:
            n, k, segments = np.shape(self.segments.measured[name].weight)
            errors[name] = np.zeros((segments, n, k))
            columns[name] = np.zeros((segments, n, k, total))
        for some, part, of_part in self._in_turn(criterion, moving, self.memory // LOGGED):
            flown, reading = part.fly(point, of_part, moving), part.reading(point, of_part, moving)
            crash_time[some] = flown.crash_time
            for name in self.channels:
                for block in residuals(flown, part.segments, name, reading):
                    place = np.arange(part.segments.count)[block.segments, None], block.stamps
                    errors[name][some][place] = block.errors
                    columns[name][some][place] = block.columns
        return (
            {name: np.moveaxis(error, 0, -1) for name, error in errors.items()},
            {name: np.moveaxis(column, (-1, 0), (0, -1)) for name, column in columns.items()},
            crash_time,
        )


def some_segments(
    objective: Objective, criterion: Criterion, which: slice | NDArray[np.generic]
) -> tuple[Objective, Criterion]:
    """Return problem and criterion of some segments alone; flights keep their numbers."""
    kept: Segments = jax.tree.map(lambda leaf: np.asarray(leaf)[..., which], objective.segments)
    states = None if criterion.states is None else criterion.states[:, which]
    return replace(objective, segments=kept), replace(criterion, states=states)


def portions(
    objective: Objective, point: Point, criterion: Criterion
) -> Iterator[tuple[NDArray[np.intp], tuple[Objective, Point, Criterion]]]:
    """Return flights that follow each other and whose Jacobian fits the objective's memory.

    Their numbers, and the problem, point and criterion of them alone. A flight alone is taken
    however large it is.
    """
    starts = 0 if criterion.states is None else len(criterion.states)
    columns = len(objective.space) + len(point.offsets) + starts
    measured = objective.segments.measured.values()
    compared = sum(int(np.prod(np.shape(m.weight)[:2])) for m in measured)
    sizes = np.bincount(objective.flight) * 8 * (columns + 1) * compared
    first, taken = 0, 0
    for number, size in enumerate(sizes):
        if number > first and taken + size > objective.memory:
            flights = np.arange(first, number)
            yield flights, portion(objective, point, criterion, flights)
            first, taken = number, 0
        taken += size
    flights = np.arange(first, len(sizes))
    yield flights, portion(objective, point, criterion, flights)


def portion(
    objective: Objective, point: Point, criterion: Criterion, flights: NDArray[np.intp]
) -> tuple[Objective, Point, Criterion]:
    """Return problem, point and criterion of some flights alone, numbered anew."""
    segments = np.flatnonzero(np.isin(objective.flight, flights))
    some, criterion = some_segments(objective, criterion, segments)
    renumbered = np.searchsorted(flights, some.flight)
    return (
        replace(some, segments=replace(some.segments, flight=renumbered)),
        Point(point.coefficients, point.offsets[:, flights]),
        replace(
            criterion,
            scale={name: scale[flights] for name, scale in criterion.scale.items()},
            reference_offset=criterion.reference_offset[:, flights],
        ),
    )


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
