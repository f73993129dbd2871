"""Fisher information of the data, by flights, channels and stretches of time.

Everything here is in the scaled coordinates of the `Space` (logarithm or number). Each segment's
start and each flight's offsets are nuisance parameters: they are eliminated, so that the rest is
information on the coefficients alone and adds up over any part of the data.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_jax.inlet import ReferenceInlet
from tuner.core.numerics import Array, Inverse, huber_weights
from tuner.objective.criterion import OFFSET_SD, Criterion, Jacobian, Point
from tuner.objective.normal_equations import Objective, flight_batches
from tuner.objective.residuals import is_informative
from tuner.objective.space import Space
from tuner.vehicle import COEFFICIENTS

NEUTRAL_TOLERANCE = 1e-3
"""Steps from its neutral value within which a coefficient is at it."""
MIN_REMAINING_SHARE = 0.25
"""Least share left of the coefficient that a new one acts as, at the new one's start value."""
BLOCK_S = 2.0
"""Length of a block of time, the unit of stretches: beyond most correlation of residuals."""
DIVERGED_RATIO = 2.0
"""Mean square of residuals over the variance of the recorded signal from which a flight refutes the
fit. Disturbances are in the recording, too, so that the right model leaves at most 1; two unrelated
flights leave 2."""


class ResidualChange(NamedTuple):
    """The change of residuals of C channels and F segments in B stretches by another simulation.

    Attributes
    ----------
    across
        (C, F, B, K): JᵀW times the change, nuisances eliminated.
    own, score
        (C, F, B): the change's weighted square, and its product with the residuals.
    """

    across: Array
    own: Array
    score: Array

    @property
    def gradient(self) -> Array:
        """Change of the slope of the loss (K,)."""
        return np.asarray(self.across.sum(axis=(0, 1, 2)))


_SQUARES = ("nuisance_prior", "prior", "ground", "lost")
_ROWS = ("selection_shifts", "pull", "nuisance_pull")
"""Fields of `FisherInformation` of (K, K) and of (K,)."""


@dataclass(frozen=True)
class FisherInformation:
    """Score and information of C channels, F segments, B stretches of time, about K coefficients.

    Attributes
    ----------
    channels
        C names.
    flight
        (F,) number of the flight that each segment belongs to.
    blocks
        (C, F, B, K, K): JᵀWJ in the scaled coordinates, nuisances eliminated.
    score
        (C, F, B, K): JᵀWr, likewise.
    spread
        (C, F) mean square of the weighted residuals: 1 where they are as large as assumed.
    nuisance_prior
        (K, K): contribution of the priors of offsets and starts.
    prior
        (K, K): contribution of the priors of the coefficients.
    crashed
        (F,) which simulated segments crashed, or tumble: their derivatives exceed
        `tuner.objective.residuals.MAX_DERIVATIVE`.
    begins
        (F,) s since the flights' starts at which the segments begin.
    scale
        (C, F) factors on the standard deviations of the measurement noise that residuals have.
    ground
        (K, K): contribution of ground measurements, as data; None without.
    lost
        (K, K): information lost to nuisances that all flights share; None without.
    changes
        Source of error -> change of the residuals.
    selection_shifts
        (K,) shifts of the estimates by omitted terms; None if none was tried.
    diverged
        (F,) which segments of a closed loop crashed, or exceed `DIVERGED_RATIO`; None in open loop.
    pull, nuisance_pull
        (K,) slopes of the priors' losses at the point, of the coefficients' own and of the
        nuisances'; None where the whole slope is zero.
    """

    channels: tuple[str, ...]
    flight: NDArray[np.int_]
    blocks: Array
    score: Array
    spread: Array
    nuisance_prior: Array
    prior: Array
    crashed: NDArray[np.bool_]
    begins: Array
    scale: Array
    ground: Array | None = None
    lost: Array | None = None
    changes: Mapping[str, ResidualChange] = field(default_factory=dict)
    selection_shifts: Array | None = None
    diverged: NDArray[np.bool_] | None = None
    pull: Array | None = None
    nuisance_pull: Array | None = None

    @cached_property
    def inverse(self) -> Inverse:
        """The inverse of all information, priors included."""
        return Inverse.of(self.total, self.given)

    def in_stretches(
        self, numbers: NDArray[np.intp]
    ) -> tuple[Array, Array, NDArray[np.intp], NDArray[np.intp]]:
        """Return information (S, K, K), score (S, K), flight and number (S,) of stretches of time.

        ``numbers`` (N, B) are the stretches, within its flight, of each segment's blocks.
        """
        size = self.score.shape[-1]
        keys = np.stack([np.repeat(self.flight, numbers.shape[1]), numbers.ravel()], axis=-1)
        found, member = np.unique(keys, axis=0, return_inverse=True)
        known, score = np.zeros((len(found), size, size)), np.zeros((len(found), size))
        np.add.at(known, member, self.blocks.sum(axis=0).reshape(-1, size, size))
        np.add.at(score, member, self.score.sum(axis=0).reshape(-1, size))
        return known, score, found[:, 0], found[:, 1]

    @staticmethod
    def joined(parts: Sequence[FisherInformation]) -> FisherInformation:
        """Return the information of all flights from that of consecutive groups of them."""
        first = parts[0]
        begins = np.cumsum([0, *(int(part.flight.max()) + 1 for part in parts)])
        flights = [part.flight + number for part, number in zip(parts, begins, strict=False)]

        def of_all(*names: str, by: Callable[..., Any]) -> dict[str, Any]:
            known = [name for name in names if getattr(first, name) is not None]
            return {name: by([getattr(part, name) for part in parts]) for name in known}

        along_segments = partial(np.concatenate, axis=1)
        changes = {
            name: ResidualChange(
                *map(along_segments, zip(*(p.changes[name] for p in parts), strict=True))
            )
            for name in first.changes
        }
        return replace(
            first,
            flight=np.concatenate(flights),
            changes=changes,
            **of_all("blocks", "score", "spread", "scale", by=along_segments),
            **of_all("crashed", "begins", "diverged", by=np.concatenate),
            **of_all("nuisance_prior", "nuisance_pull", by=partial(np.sum, axis=0)),
        )

    def with_resting(self, where: NDArray[np.bool_]) -> FisherInformation:
        """Return the same with no slope along coefficients (K,) that are held or at a bound."""
        if self.pull is None:
            return self
        return replace(self, pull=np.where(where, self.pull - self.slope, self.pull))

    @property
    def at_minimum(self) -> FisherInformation:
        """The same at the minimum of the loss, to first order."""
        step = -(self.inverse.matrix @ self.slope)
        return replace(self, score=self.score + self.blocks @ step, pull=None, nuisance_pull=None)

    def about(self, indices: NDArray[np.intp]) -> FisherInformation:
        """Return the information about some coefficients while the others are fixed."""
        square = np.ix_(indices, indices)
        return self._with_each(
            lambda matrix: matrix[square],
            lambda row: row[indices],
            blocks=self.blocks[..., indices, :][..., indices],
            score=self.score[..., indices],
            changes={
                name: change._replace(across=change.across[..., indices])
                for name, change in self.changes.items()
            },
        )

    def with_change(self, change: ResidualChange) -> FisherInformation:
        """Return the same with the size of a change as the last of K + 1 coefficients.

        It is 0 in this simulation and 1 with the change; it has no prior.
        """
        beside = np.append(change.across, change.own[..., None], axis=-1)
        blocks = np.concatenate([self.blocks, change.across[..., None, :]], axis=-2)
        return replace(self, selection_shifts=None)._with_each(
            lambda matrix: np.pad(matrix, (0, 1)),
            lambda row: np.append(row, 0.0),
            blocks=np.append(blocks, beside[..., None], axis=-1),
            score=np.append(self.score, change.score[..., None], axis=-1),
            changes={},
        )

    def _with_each(
        self, square: Callable[[Array], Array], row: Callable[[Array], Array], **more: Any
    ) -> FisherInformation:
        """Return the same with each (K, K) and each (K,) that is there changed."""
        for names, change in ((_SQUARES, square), (_ROWS, row)):
            for name in names:
                value = getattr(self, name)
                more[name] = None if value is None else change(value)
        return replace(self, **more)

    @property
    def refuted(self) -> bool:
        """Whether the flights contradict the fit.

        It crashes where the recorded vehicle flew, or most simulated flights have little to do with
        the recorded ones. Derivatives along them are not those along the recorded ones.
        """
        return self.diverged is not None and _is_refuting(self.diverged, self.crashed)

    @property
    def slope(self) -> Array:
        """The slope (K,) of the whole loss at the point, zero where a fit has converged."""
        if self.pull is None or self.nuisance_pull is None:
            return np.zeros(self.score.shape[-1])
        return np.asarray(self.score.sum(axis=(0, 1, 2)) + self.pull + self.nuisance_pull)

    @property
    def data(self) -> Array:
        """The information (K, K) of all flights and ground measurements."""
        return np.asarray(self.blocks.sum(axis=(0, 1, 2)) + self._beside_flights)

    @property
    def total(self) -> Array:
        """The information (K, K) of flights, ground measurements and priors."""
        return np.asarray(self.data + self.prior)

    @property
    def given(self) -> Array:
        """The part (K, K) of the total that is no sum over flights: its noise is known."""
        return np.asarray(self.prior + self._beside_flights)

    @property
    def _beside_flights(self) -> Array:
        """The information beside that of flights and of the coefficients' priors."""
        beside = self.nuisance_prior
        if self.ground is not None:
            beside = beside + self.ground
        return beside if self.lost is None else beside - self.lost


def is_refuted(objective: Objective, point: Point, criterion: Criterion) -> bool:
    """Return whether the flights contradict a fit, as of `FisherInformation.refuted`."""
    parts = [information_at(*batch) for _, batch in flight_batches(objective, point, criterion)]
    return FisherInformation.joined(parts).refuted


def leaves_flights(objective: Objective, point: Point, criterion: Criterion) -> bool:
    """Return whether a fit crashes, or most simulated flights are far from the recorded ones.

    Unlike `is_refuted`, derivatives may grow along flights that it meets: a model that lacks terms
    may make up for them at the edge of stability, where no term could be tried otherwise.
    """
    crashed, diverged = list[np.bool_](), list[np.bool_]()
    for _, (part, at, weights) in flight_batches(objective, point, criterion):
        jacobian = part.jacobian(at, weights)
        crashes = np.isfinite(np.asarray(jacobian.crash_time))
        of_flights = _diverged(part, jacobian, crashes)
        if of_flights is None:
            return False
        crashed.extend(crashes)
        diverged.extend(of_flights)
    return _is_refuting(np.array(diverged), np.array(crashed))


def _is_refuting(diverged: NDArray[np.bool_], crashed: NDArray[np.bool_]) -> bool:
    return bool(np.any(diverged & crashed) or np.mean(diverged) > 0.5)


def with_start_values(space: Space, vector: ArrayLike, names: Collection[str]) -> Array:
    """Return a search vector with new coefficients at their start values.

    A coefficient that one of them acts as is reduced by as much, at most to a quarter.
    """
    values = space.numbers(np.asarray(vector))
    moved = {name: at for name in names if (at := COEFFICIENTS[name].begin) is not None}
    if not moved:
        return np.asarray(vector)
    for name, at in tuple(moved.items()):
        other = COEFFICIENTS[name].equivalent_to
        if other in values:
            moved[other] = max(values[other] - at, MIN_REMAINING_SHARE * values[other])
    there = space.vector_of({**values, **moved})
    return np.where([name in moved for name in space.names], there, np.asarray(vector))


def with_secants(
    jacobian: Jacobian,
    space: Space,
    point: Point,
    residuals: Callable[[Point], Mapping[str, Array]],
) -> Jacobian:
    """Return a Jacobian with secants for coefficients with start values, at neutral values.

    To first order these act there like another coefficient; the secant leads to the start value.
    """
    values = space.numbers(np.asarray(point.coefficients))
    for index, name in enumerate(space.names):
        row = COEFFICIENTS.get(name)
        if row is None or row.begin is None or row.neutral is None:
            continue
        if abs(values[name] - row.neutral) > NEUTRAL_TOLERANCE * row.step:
            continue
        there = with_start_values(space, point.coefficients, (name,))
        change = there - np.asarray(point.coefficients)
        width, change[index] = change[index], 0.0
        beside = np.flatnonzero(change)
        columns = dict(jacobian.columns)
        for channel, moved in residuals(Point(there, point.offsets)).items():
            column = np.array(columns[channel])
            others = np.tensordot(change[beside], column[beside], axes=1)
            column[index] = (moved - jacobian.residuals[channel] - others) / width
            columns[channel] = column
        jacobian = replace(jacobian, columns=columns)
    return jacobian


def information_at(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    jacobian: Jacobian | None = None,
    *,
    offsets_fitted: NDArray[np.bool_] | None = None,
    alternatives: Mapping[str, Mapping[str, Array]] = MappingProxyType({}),
) -> FisherInformation:
    """Return the information at a point.

    Parameters
    ----------
    objective, point, criterion
        The problem and the point.
    jacobian
        The Jacobian there; it is evaluated by default.
    offsets_fitted
        (offsets, N) which offsets were fitted; by default those that are not exactly zero.
    alternatives
        Source of error -> channel -> (n, k, F) residuals with it changed.
    """
    jacobian = objective.jacobian(point, criterion) if jacobian is None else jacobian
    space, flight, segments = objective.space, objective.flight, objective.segments.count
    channels = tuple(jacobian.residuals)
    scales = np.stack([criterion.scale[channel][flight] for channel in channels])
    seconds = criterion.horizon / float(objective.schedule.log_rate)
    blocks = max(int(seconds / BLOCK_S), 1)
    states = 0 if criterion.states is None else len(criterion.states)
    size = len(space) + point.offsets.shape[0] + states
    every = size + len(alternatives)  # a change of the residuals is a column like a derivative
    information = np.zeros((len(channels), segments, blocks, every, every))
    score = np.zeros((len(channels), segments, blocks, every))
    spread = np.ones((len(channels), segments))
    crashed = np.isfinite(np.asarray(jacobian.crash_time))
    for number, channel in enumerate(channels):
        columns = np.asarray(jacobian.columns[channel])
        residuals = np.asarray(jacobian.residuals[channel])
        weight = np.asarray(objective.segments.measured[channel].weight)
        time = np.asarray(objective.segments.measured[channel].time)
        for segment, scale in enumerate(scales[number]):
            error = residuals[..., segment] / scale
            rows = np.empty((*error.shape, every))
            np.divide(np.moveaxis(columns[..., segment], 0, -1), scale, out=rows[..., :size])
            for place, changed in enumerate(alternatives.values(), size):
                rows[..., place] = changed[channel][..., segment] / scale - error
            robust = huber_weights(error, criterion.huber)
            stretch = np.minimum((time[:, segment] / BLOCK_S).astype(int), blocks - 1)
            for index in range(blocks):
                inside = stretch == index
                own = rows[inside].reshape(-1, every)
                weighted = (own * robust[inside].reshape(-1, 1)).T
                curved = weighted @ own
                if not is_informative(curved[:size, :size], len(own)):
                    rows[inside], crashed[segment] = 0.0, True
                    continue
                information[number, segment, index] = curved
                score[number, segment, index] = weighted @ error[inside].ravel()
            compared = (weight[..., segment] > 0) & np.any(rows[..., :size] != 0, axis=-1)
            if compared.any():
                spread[number, segment] = np.mean((robust * error**2)[compared])
    slope = space.slope(np.asarray(point.coefficients))
    to_scaled = np.append(1.0 / slope, np.ones(every - len(space)))
    information, score = information * to_scaled[:, None] * to_scaled, score * to_scaled
    fitted = np.asarray(point.offsets) != 0.0 if offsets_fitted is None else offsets_fitted
    of_point = information[..., :size, :size]
    along, prior, pull = _nuisance_directions(objective, point, criterion, of_point, fitted)
    movable = np.hstack([fitted[:, flight].T, np.ones((segments, states), bool)])
    return FisherInformation(
        channels=channels,
        flight=flight,
        blocks=np.einsum("lap,clbpq,ldq->clbad", along, of_point, along, optimize=True),
        score=np.einsum("lap,clbp->clba", along, score[..., :size]),
        spread=spread,
        nuisance_prior=prior,
        prior=np.diag(criterion.prior**2 / space.prior_sd**2),
        crashed=crashed,
        begins=objective.segments.begins,
        scale=scales,
        changes={
            name: _change(information, score, number, along, movable)
            for number, name in enumerate(alternatives, size)
        },
        ground=None
        if space.joint_prior is None
        else criterion.prior**2 * space.joint_rows.T @ space.joint_rows,
        diverged=_diverged(objective, jacobian, crashed),
        pull=criterion.prior**2 * (space.prior_rows.T @ space.prior_residuals(point.coefficients)),
        nuisance_pull=pull,
    )


def _diverged(
    objective: Objective, jacobian: Jacobian, crashed: NDArray[np.bool_]
) -> NDArray[np.bool_] | None:
    """Return which segments (F,) of a closed loop crashed or exceed `DIVERGED_RATIO` in a channel.

    An attitude has no mean.
    """
    segments = objective.segments
    if segments.windowed or not isinstance(segments.inlet, ReferenceInlet):
        return None
    furthest = np.zeros(objective.segments.count)
    for channel, measured in objective.segments.measured.items():
        values, weight = np.asarray(measured.values), np.asarray(measured.weight)
        if channel == "attitude" or channel not in jacobian.residuals:
            continue
        used = weight > 0.0
        counts = np.maximum(used.sum(axis=(0, 2), keepdims=True), 1)
        mean = np.where(used, values, 0.0).sum(axis=(0, 2), keepdims=True) / counts
        own = np.maximum(used.sum(axis=(0, 1)), 1)
        of_recorded = np.square(np.where(used, values - mean, 0.0) * weight).sum() / own.sum()
        of_residuals = np.square(np.asarray(jacobian.residuals[channel])).sum(axis=(0, 1)) / own
        furthest = np.maximum(furthest, of_residuals / max(of_recorded, 1.0))
    return np.asarray(crashed | (furthest > DIVERGED_RATIO))


def _nuisance_directions(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    information: Array,
    offsets_fitted: NDArray[np.bool_],
) -> tuple[Array, Array, Array]:
    """Return how all parameters follow the coefficients: (F, K, Q), starts and offsets at best.

    Given the information (C, F, B, Q, Q) in the scaled coordinates. And the contributions of the
    priors of starts and offsets to the information (K, K) and to the slope (K,).
    """
    whole = information.sum(axis=(0, 2))
    count, (kinds, flights), states = len(objective.space), point.offsets.shape, criterion.states
    kept = count + kinds
    along = np.zeros((len(whole), count, whole.shape[-1]))
    prior, pull = np.zeros((count, count)), np.zeros(count)
    for number in range(flights):
        segments = np.flatnonzero(objective.flight == number)
        # how all parameters change when a segment's best start follows the others, starts in
        # units of their prior's standard deviations
        first = {}
        for segment in segments:
            square = whole[segment][kept:, kept:] + np.eye(whole.shape[-1] - kept)
            start = -np.linalg.solve(square, whole[segment][kept:, :kept]).T
            first[segment] = np.hstack([np.eye(kept), start])
        together = np.zeros((kept, kept))
        for segment, along_start in first.items():  # the prior of a start included
            together = together + (
                along_start @ whole[segment] @ along_start.T
                + along_start[:, kept:] @ along_start[:, kept:].T
            )
        projection = _projection(together, offsets_fitted[:, number], count)
        second = np.hstack([np.eye(count), projection])
        prior += projection @ projection.T / OFFSET_SD**2
        pull += projection @ np.asarray(point.offsets)[:, number] / OFFSET_SD**2
        for segment in segments:
            along[segment] = second @ first[segment]
            follow = along[segment][:, kept:]
            prior += follow @ follow.T
            if states is not None:
                pull += follow @ np.asarray(states)[:, segment]
    return along, prior, pull


def _change(
    information: Array, score: Array, number: int, along: Array, movable: NDArray[np.bool_]
) -> ResidualChange:
    """Return a change of the residuals, one of the columns, with nuisances at best.

    ``movable`` (F, N) says which of a segment's nuisances move.
    """
    size = along.shape[-1]
    across, score, own = information[..., :size, number], score[..., number], score[..., :size]
    whole, right = information.sum(axis=(0, 2)), across.sum(axis=(0, 2))
    follow = np.zeros_like(right)
    for segment, moves in enumerate(movable):
        there = size - len(moves) + np.flatnonzero(moves)
        square = whole[segment][np.ix_(there, there)] + np.eye(len(there)) / OFFSET_SD**2
        follow[segment, there] = -np.linalg.solve(square, right[segment, there])
    beside = across + np.einsum("clbpq,lq->clbp", information[..., :size, :size], follow)
    return ResidualChange(
        np.einsum("lap,clbp->clba", along, beside),
        information[..., number, number] + np.einsum("clbp,lp->clb", beside + across, follow),
        score + np.einsum("clbp,lp->clb", own, follow),
    )


def _projection(whole: Array, movable: NDArray[np.bool_], count: int) -> Array:
    """Return (K, offsets): how a flight's best offsets follow the coefficients."""
    projection = np.zeros((count, len(movable)))
    free = np.flatnonzero(movable)
    of_offsets = whole[np.ix_(count + free, count + free)] + np.eye(len(free)) / OFFSET_SD**2
    projection[:, free] = -np.linalg.solve(of_offsets, whole[count + free, :count]).T
    return projection
