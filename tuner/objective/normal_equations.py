"""Loss, gradient and Gauss-Newton Hessian of a fit, segment by segment, keeping no Jacobian.

A compiled kernel simulates (`tuner.objective.simulation`); NumPy reads the simulation at recorded
stamps and sums up. In these sums segments come first in every array, columns of derivatives last.
Each of F segments contributes a loss, a gradient and a Hessian from which its own start has been
eliminated; the normal equations add them up, with the priors. The weight of each channel of each
flight follows from its residuals.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, field, replace
from functools import cache
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike, NDArray

from lanes import Program
from sim_jax.schedule import Schedule
from sim_jax.state import Limits
from tuner.core.numerics import Array
from tuner.core.runtime import cores
from tuner.engine import Report, current
from tuner.objective.criterion import (
    OFFSET_SD,
    OFFSET_UNIT,
    Criterion,
    Jacobian,
    Point,
    SegmentSums,
    picked,
    units_of,
)
from tuner.objective.initial_conditions import eliminate_states
from tuner.objective.residuals import Block, Reading, gauss_newton, huber_loss, residuals
from tuner.objective.segments import CLOCKS, OFFSETS, Segments
from tuner.objective.simulation import EFFECTS, SimulatedChannels, flight_program, fly
from tuner.objective.space import Space
from tuner.vehicle.model import Model, with_coefficients

R = TypeVar("R")

MEMORY = 2**30
"""Default largest size of derivatives in memory, bytes."""
LOG_SHARE = 8
"""Memory over that of the logs simulated at a time, where residuals are kept."""
VECTORS_AT_ONCE = 16
"""Vectors simulated side by side: enough to fill the processor, few enough for its memory."""
MATCHED_RATIO = 3.0
"""Largest ratio of the worst channel's residuals to the noise of a matched flight."""
STRAY_RATIO = 3.0
"""Residuals over those of the median flight from which a flight has a smaller weight."""


STATIC = {"static": True}
"""Of what is no leaf of a pytree."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Objective:
    """A fit as a function of a point.

    A pytree, but no module of equinox: the methods of one are modules that each call makes.

    Attributes
    ----------
    model
        Fixed coefficients and the controllers.
    segments
        The data.
    space
        Free coefficients.
    schedule, samples, limits
        Rates and limits of the simulation, and the largest number of logged samples.
    """

    model: Model
    segments: Segments
    space: Space = field(metadata=STATIC)
    schedule: Schedule = field(metadata=STATIC)
    samples: int = field(metadata=STATIC)
    limits: Limits = field(metadata=STATIC)
    memory: int = field(default=MEMORY, metadata=STATIC)
    """Largest size of derivatives, bytes: segments beyond it take turns."""
    conditions: tuple[str, ...] = field(default=(), metadata=STATIC)
    """Names of the estimated per-flight conditions, of `tuner.vehicle.conditions`."""
    multiplicity: Float[Array, " N"] | None = None
    """Multiplicity of each flight in loss, gradient and Hessian; None is 1."""
    differentiated: bool = field(default=True, metadata=STATIC)
    """Whether it is differentiated, too: the same program then computes values alone."""

    @property
    def of_flight(self) -> tuple[str, ...]:
        """Names of the per-flight parameters, in the order of a point's rows."""
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
        """The measured channels, sorted: sums do not depend on their order in the recording."""
        return tuple(sorted(self.segments.measured))

    def model_at(self, vector: ArrayLike) -> Model:
        """Return the model with the coefficients of a search vector (K,)."""
        values = self.space.values(np.asarray(vector))
        return with_coefficients(self.model, {name: np.asarray(v) for name, v in values.items()})

    def start(self, vector: ArrayLike) -> Point:
        """Return a point with a search vector and no offset."""
        return Point(np.asarray(vector), np.zeros((len(self.of_flight), self.flights)))

    def conditions_at(self, point: Point) -> dict[str, Array]:
        """Return the per-flight conditions at a point: name -> (N,), in its unit."""
        rows, units = np.asarray(point.offsets)[len(OFFSETS) :], units_of(self.conditions)
        return {name: rows[row] * units[row] for row, name in enumerate(self.conditions)}

    def fly(
        self, point: Point, criterion: Criterion, moving: Mapping[str, int] = MappingProxyType({})
    ) -> SimulatedChannels:
        """Fly the segments up to the criterion's horizon.

        Parameters
        ----------
        point
            Its coefficients are a search vector (K,), or (F, K), each segment's own.
        criterion
            Gives the horizon and the starts.
        moving
            Variables of the derivatives -> their number of columns: ``coefficients``,
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
            states=criterion.states,
            conditions={name: values[self.flight] for name, values in conditions.items()},
            tangents=self._directions(point, moving) or None,
            differentiated=self.differentiated and np.ndim(point.coefficients) == 1,
        )

    @property
    def has_terms(self) -> bool:
        """Whether terms beyond the base model are among what is fitted."""
        return bool(self.conditions or {*EFFECTS} & {*self.space.names})

    def program(self, *, with_terms: bool, moves: bool = True) -> Program:
        """Return the program by which the segments fly, with derivatives if it ``moves``."""
        return flight_program(
            self.model,
            self.segments,
            self.schedule,
            limits=self.limits,
            with_terms=with_terms,
            moves=moves,
        )

    def compare(
        self, point: Point, criterion: Criterion, moving: Mapping[str, int] = MappingProxyType({})
    ) -> tuple[Array, Iterator[tuple[str, Callable[[], Block]]]]:
        """Fly the segments; return (F,) times of crashes, and what returns blocks of residuals.

        The arguments are those of `fly`. Where conditions move, so do the offsets. Each block
        comes with its channel.
        """
        flown = self.fly(point, criterion, moving)
        reading = Reading(
            np.asarray(point.offsets)[: len(OFFSETS), self.flight] * OFFSET_UNIT,
            criterion.reference_offset[:, self.flight],
            float(self.schedule.log_rate),
            criterion.horizon,
            sum(moving.values()),
            moving.get("coefficients", 0) if "conditions" in moving else None,
        )
        blocks = (
            (name, block)
            for name in self.channels
            for block in residuals(flown, self.segments, name, reading)
        )
        return flown.crash_time, blocks

    def clock_sums(
        self,
        flown: SimulatedChannels,
        criterion: Criterion,
        offsets: Array,
        channels: Collection[str],
    ) -> tuple[Array, Array, Array]:
        """Return each flight's loss (N,) by some channels alone, read exactly at given offsets.

        Beside it are gradient (N, offsets) and Hessian (N, offsets, offsets) of it by the offsets.

        Parameters
        ----------
        flown
            As of `fly`, without derivatives.
        criterion
            Gives horizon, scales and robust limit.
        offsets
            (offsets, N) in the units of a `Point`.
        channels
            Which count.
        """
        late = offsets[: len(OFFSETS), self.flight] * OFFSET_UNIT
        rate, kinds = float(self.schedule.log_rate), len(OFFSETS)
        reading = Reading(late, late[: len(CLOCKS)], rate, criterion.horizon, coefficients=0)
        loss, gradient = np.zeros(self.flights), np.zeros((self.flights, kinds))
        hessian = np.zeros((self.flights, kinds, kinds))
        for name in channels:
            for block in (made() for made in residuals(flown, self.segments, name, reading)):
                owner = self.flight[block.segments]
                scale = criterion.scale[name][owner]
                scaled = block.errors / scale[:, None, None]
                normal = gauss_newton(block.columns, scaled, scale, criterion.huber)
                own = 0.5 * huber_loss(scaled, criterion.huber).sum(axis=(1, 2))
                for total, part in zip((loss, gradient, hessian), (own, *normal), strict=True):
                    np.add.at(total, owner, part)
        return loss, gradient, hessian

    def sums(
        self, point: Point, criterion: Criterion, *, derivatives: bool = True, still: bool = False
    ) -> SegmentSums:
        """Return every segment's contribution at a point.

        With ``still`` coefficients, derivatives are those by per-flight parameters alone.
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
        """Return the variables of derivatives: at least free starts, to eliminate them."""
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
        crash_time, blocks = self.compare(point, criterion, moving)
        segments, total, huber = self.segments.count, _columns(moving), criterion.huber
        loss, gradient = np.zeros(segments), np.zeros((segments, total))
        hessian, starts = np.zeros((segments, total, total)), moving.get("states", 0)
        squares, counts = ({n: np.zeros(segments) for n in self.channels} for _ in range(2))
        slope = {name: np.zeros((segments, starts)) for name in self.channels}
        bend = {name: np.zeros((segments, starts, starts)) for name in self.channels}

        def summed(name: str, block: Block) -> _BlockSums:
            scale = criterion.scale[name][self.flight[block.segments]]
            scaled = block.errors / scale[:, None, None]
            own = block.columns[..., total - starts :]
            return _BlockSums(
                name,
                block.segments,
                np.einsum("fnk,fnk->f", block.errors, block.errors),
                block.counts.sum(axis=(1, 2)),
                0.5 * huber_loss(scaled, huber).sum(axis=(1, 2)),
                gauss_newton(block.columns, scaled, scale, huber) if total else (0.0, 0.0),
                np.einsum("fnk,fnkl->fl", block.errors, own) if starts else 0.0,
                np.einsum("fnkl,fnkm->flm", own, own) if starts else 0.0,
            )

        for of in side_by_side(summed, blocks):
            squares[of.name][of.some] += of.squares
            counts[of.name][of.some] += of.counts
            loss[of.some] += of.loss
            gradient[of.some] += of.normal[0]
            hessian[of.some] += of.normal[1]
            slope[of.name][of.some] += of.slope
            bend[of.name][of.some] += of.bend
        best = None
        if criterion.states is not None:
            loss, gradient, hessian, best = eliminate_states(
                loss, gradient, hessian, criterion.states
            )
            change = (best - criterion.states).T
            for name in self.channels:
                pull = 2.0 * slope[name] + np.einsum("flm,fm->fl", bend[name], change)
                squares[name] += np.einsum("fl,fl->f", change, pull)
        if "conditions" not in moving:
            size = len(self.space) + len(self.of_flight)
            gradient, hessian = np.zeros((segments, size)), np.zeros((segments, size, size))
        return SegmentSums(
            loss,
            np.moveaxis(gradient, 0, -1),
            np.moveaxis(hessian, 0, -1),
            squares,
            counts,
            crash_time,
            best,
        )

    def _laid_out(
        self, point: Point, criterion: Criterion, moving: Mapping[str, int]
    ) -> tuple[dict[str, Array], dict[str, Array], Array]:
        """Return channel -> (n, k, F) residuals and (Q, n, k, F) columns; (F,) times of crashes.

        Segments are simulated in turn, so that logs take less memory than the result.
        """
        errors, columns, crash_time = {}, {}, np.zeros(self.segments.count)
        for name in self.channels:
            n, k, segments = np.shape(self.segments.measured[name].weight)
            errors[name] = np.zeros((segments, n, k))
            columns[name] = np.zeros((segments, n, k, _columns(moving)))
        for some, part, of_part in self._in_turn(criterion, moving, self.memory // LOG_SHARE):
            crash_time[some], blocks = part.compare(point, of_part, moving)

            def lay(
                name: str, block: Block, some: slice = some, count: int = part.segments.count
            ) -> None:
                place = np.arange(count)[block.segments, None], block.stamps
                errors[name][some][place] = block.errors
                columns[name][some][place] = block.columns

            deque(side_by_side(lay, blocks), maxlen=0)
        return (
            {name: np.moveaxis(error, 0, -1) for name, error in errors.items()},
            {name: np.moveaxis(column, (-1, 0), (0, -1)) for name, column in columns.items()},
            crash_time,
        )


class _BlockSums(NamedTuple):
    """What a block of residuals adds to the sums of its segments, as `SegmentSums` has them."""

    name: str
    some: slice
    squares: Array
    counts: NDArray[np.intp]
    loss: Array
    normal: tuple[Array | float, Array | float]
    slope: Array | float
    bend: Array | float


def side_by_side(
    work: Callable[[str, Block], R], blocks: Iterable[tuple[str, Callable[[], Block]]]
) -> Iterator[R]:
    """Return what is made of each block of residuals, in their order, made by several threads."""
    context = copy_context()

    def one(named: tuple[str, Callable[[], Block]]) -> R:
        return context.copy().run(lambda: work(named[0], named[1]()))

    return _threads().map(one, blocks)


@cache
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="residuals")


def _columns(moving: Mapping[str, int]) -> int:
    return sum(moving.values()) + len(OFFSETS) * ("conditions" in moving)


def some_segments(
    objective: Objective, criterion: Criterion, which: slice | NDArray[np.generic]
) -> tuple[Objective, Criterion]:
    """Return problem and criterion of some segments alone; flights keep their numbers."""
    states = None if criterion.states is None else criterion.states[:, which]
    kept = picked(objective.segments, (..., which))
    return replace(objective, segments=kept), replace(criterion, states=states)


def flight_batches(
    objective: Objective, point: Point, criterion: Criterion
) -> Iterator[tuple[NDArray[np.intp], tuple[Objective, Point, Criterion]]]:
    """Yield batches of consecutive flights whose Jacobian fits the objective's memory.

    Each has the flights' numbers, and their problem, point and criterion. One flight is always
    taken, however large it is.
    """
    starts = 0 if criterion.states is None else len(criterion.states)
    columns = len(objective.space) + len(point.offsets) + starts
    measured = objective.segments.measured.values()
    compared = sum(int(np.prod(np.shape(m.weight)[:2])) for m in measured)
    sizes = np.bincount(objective.flight) * 8 * (columns + 1) * compared
    begins, taken = list[int](), 0
    for number, size in enumerate(sizes):
        if taken and taken + size > objective.memory:
            begins.append(number)
            taken = 0
        taken += size
    for flights in np.split(np.arange(len(sizes)), begins):
        yield flights, flight_batch(objective, point, criterion, flights)


def flight_batch(
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
    """Return a problem with more per-flight conditions, and its point with these at zero.

    ``names`` are of `tuner.vehicle.conditions`.
    """
    added = tuple(name for name in names if name not in objective.conditions)
    wider = replace(objective, conditions=(*objective.conditions, *added))
    nothing = np.zeros((len(added), objective.flights))
    return wider, Point(point.coefficients, np.concatenate([point.offsets, nothing]))


class NormalEquations(NamedTuple):
    """Loss c, gradient (P,) and Hessian (P, P) of a fit at a point, per compared value.

    The parameters are the coefficients, then the flights' offsets, one kind after the other.
    """

    loss: float
    gradient: Array
    hessian: Array


def normal_equations(
    objective: Objective, point: Point, criterion: Criterion, sums: SegmentSums
) -> NormalEquations:
    """Return loss, gradient and Hessian over all segments, priors included.

    Everything is divided by the number of compared values, so that damping means the same at every
    horizon.

    Parameters
    ----------
    objective
        Gives the priors, and which flight each segment belongs to.
    point, criterion, sums
        The point, the criterion, and the segments' contributions there.
    """
    space, vector, offsets = objective.space, *map(np.asarray, (point.coefficients, point.offsets))
    count, (kinds, flights), prior = len(space), offsets.shape, criterion.prior
    compared = max(float(sums.compared), 1.0)
    rows = prior * space.prior_rows * space.slope(vector)
    pull, offset_pull = prior * space.prior_residuals(vector), offsets / OFFSET_SD
    loss = float(np.sum(sums.loss)) + 0.5 * float(np.sum(pull**2) + np.sum(offset_pull**2))
    owner = np.eye(flights)[np.asarray(objective.flight)]  # (F, N)
    by_segment = np.asarray(sums.gradient)
    gradient = np.concatenate(
        [
            by_segment[:count].sum(axis=-1) + rows.T @ pull,
            (by_segment[count:] @ owner + offset_pull / OFFSET_SD).ravel(),
        ]
    )
    hessian = np.zeros((count + kinds * flights,) * 2)
    curved = np.asarray(sums.hessian)
    hessian[:count, :count] = curved[:count, :count].sum(axis=-1) + rows.T @ rows
    across = (curved[:count, count:] @ owner).reshape(count, -1)
    hessian[:count, count:], hessian[count:, :count] = across, across.T
    # a flight's offsets meet only each other
    own = hessian[count:, count:].reshape(kinds, flights, kinds, flights)
    each = np.arange(flights)
    own[:, each, :, each] = np.moveaxis(curved[count:, count:] @ owner, -1, 0)
    own_diagonal = np.arange(count, len(hessian))
    hessian[own_diagonal, own_diagonal] += 1.0 / OFFSET_SD**2
    return NormalEquations(loss / compared, gradient / compared, hessian / compared)


def root_mean_squares(objective: Objective, sums: SegmentSums) -> dict[str, Array]:
    """Return channel -> (S, N) root mean square residual in σ of each flight, NaN without any.

    ``objective`` says which segment belongs to which flight; the segments' sums have S first.
    """
    owner, residual = np.eye(objective.flights)[objective.flight], {}
    for name, squares in sums.squares.items():
        counts, finite = np.asarray(sums.counts[name]) @ owner, np.isfinite(squares)
        mean = np.where(finite, squares, 0.0) @ owner / np.maximum(counts, 1.0)
        mean[~finite @ owner > 0] = np.inf  # and no other flight's
        residual[name] = np.where(counts > 0, np.sqrt(mean), np.nan)
    return residual


def position_rmse(
    objective: Objective, squares: Mapping[str, Array], counts: Mapping[str, Array]
) -> float:
    """Return the position RMSE in m, of channel -> squares in σ and counts; NaN without any."""
    if "position" not in counts:
        return float("nan")
    sigma = 1.0 / np.asarray(objective.segments.measured["position"].weight).max(initial=1e-30)
    compared = float(np.sum(counts["position"])) or np.nan
    return float(sigma * np.sqrt(3.0 * float(np.sum(squares["position"])) / compared))


def downweighting(residual: dict[str, Array], noise_inflation: float) -> dict[str, Array]:
    """Return scales that reduce the weight of flights matched far worse than the others."""
    table = np.stack(list(residual.values())) / noise_inflation
    with np.errstate(all="ignore"):
        per_flight = np.nan_to_num(np.nanmedian(table, axis=0), nan=1.0)
    typical = max(float(np.median(per_flight)), 1.0)
    stray = per_flight > STRAY_RATIO * typical
    return {
        name: np.where(stray & np.isfinite(values), np.maximum(values / noise_inflation, 1.0), 1.0)
        for name, values in residual.items()
    }


def misfit(residual: dict[str, Array]) -> dict[str, Array]:
    """Return residuals over noise of each channel on each flight, at least 1."""
    return {
        name: np.maximum(np.nan_to_num(values, nan=1.0), 1.0) for name, values in residual.items()
    }


class Batch(eqx.Module):
    """The losses of S vectors.

    Attributes
    ----------
    loss
        (S, F) half the robust sum of squares.
    squares
        Channel -> (S, k, F) plain sum of squares in unscaled standard deviations.
    crash_time
        (S, F) s, infinite for a segment that flew.
    """

    loss: Float[Array, "S F"]
    squares: dict[str, Float[Array, "S k F"]]
    crash_time: Float[Array, "S F"]


def evaluate(objective: Objective, vectors: Array, point: Point, criterion: Criterion) -> Batch:
    """Fly all segments with every vector, in chunks that fit the memory.

    The engine in force computes them.

    Parameters
    ----------
    objective, criterion
        The problem.
    vectors
        (S, K) search vectors.
    point
        Its clock offsets hold for all.
    """
    engine = current()
    problem = engine.share((objective, point, criterion))
    chunks = [
        vectors[first : first + VECTORS_AT_ONCE]
        for first in range(0, len(vectors), VECTORS_AT_ONCE)
    ]
    parts = engine.map(_evaluated, [(problem, chunk) for chunk in chunks])
    joined: Batch = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return joined


def _evaluated(
    task: tuple[Callable[[], tuple[Objective, Point, Criterion]], Array], _report: Report
) -> Batch:
    """Return the losses of some vectors: all segments of all vectors are simulated side by side."""
    (objective, point, criterion), vectors = task[0](), task[1]
    count, segments = len(vectors), objective.segments.count
    together = np.tile(np.arange(segments), count)
    objective, criterion = some_segments(objective, criterion, together)
    point = Point(np.repeat(vectors, segments, axis=0), point.offsets)
    crash_time, blocks = objective.compare(point, criterion)
    loss = np.zeros(len(together))
    squares = {
        name: np.zeros((len(together), np.shape(measured.weight)[1]))
        for name, measured in objective.segments.measured.items()
    }

    def summed(name: str, block: Block) -> tuple[str, slice, Array, Array]:
        scale = criterion.scale[name][objective.flight[block.segments]]
        own = huber_loss(block.errors / scale[:, None, None], criterion.huber).sum(axis=(1, 2))
        squares = np.einsum("fnk,fnk->fk", block.errors, block.errors)
        return name, block.segments, 0.5 * own, squares

    for name, some, own_loss, own_squares in side_by_side(summed, blocks):
        loss[some] += own_loss
        squares[name][some] += own_squares
    by_axis = {n: np.moveaxis(s.reshape(count, segments, -1), -1, 1) for n, s in squares.items()}
    return Batch(loss.reshape(count, segments), by_axis, crash_time.reshape(count, segments))


def sums_at(
    objective: Objective,
    points: Point,
    criterion: Criterion,
    *,
    derivatives: bool = True,
    still: bool = False,
) -> SegmentSums:
    """Return every segment's contribution at S points; all leaves have S first.

    With ``still`` coefficients, derivatives by them are not computed, and zero. The engine in force
    computes the points, a task each; one alone stays here.
    """
    alone = [
        Point(coefficients, offsets)
        for coefficients, offsets in zip(points.coefficients, points.offsets, strict=True)
    ]
    if len(alone) == 1:
        parts = [_sums_of((objective, criterion, derivatives, still), alone[0])]
    else:
        engine = current()
        problem = engine.share((objective, criterion, derivatives, still))
        parts = engine.map(_sums, [(problem, point) for point in alone])
    joined: SegmentSums = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    return joined


def _sums(task: tuple[Callable[[], _Asked], Point], _report: Report) -> SegmentSums:
    return _sums_of(task[0](), task[1])


_Asked = tuple[Objective, Criterion, bool, bool]
"""Problem and criterion, whether derivatives are computed, and whether coefficients are still."""


def _sums_of(asked: _Asked, point: Point) -> SegmentSums:
    objective, criterion, derivatives, still = asked
    if not (derivatives and still):
        return objective.sums(point, criterion, derivatives=derivatives)
    sums, more = objective.sums(point, criterion, still=True), (len(objective.space), 0)
    return replace(
        sums,
        gradient=np.pad(sums.gradient, (more, (0, 0))),
        hessian=np.pad(sums.hessian, (more, more, (0, 0))),
    )
