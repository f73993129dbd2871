"""What the data say, cut into flights, channels and stretches of time.

Everything here is in the scaled coordinates of the `Space` (logarithm or number). Each segment's
start and each flight's offsets are nuisances: they are eliminated, so that what is left speaks of
the coefficients alone and can be added up and split at will.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Criterion, Jacobian, Point
from tuner.objective.normal import Objective
from tuner.search.normal_equations import OFFSET_SD

Array = NDArray[np.float64]

BLOCK = 2.0
"""s; residuals further apart than this are taken to be independent."""


@dataclass(frozen=True)
class FisherInformation:
    """Gradient and information of a fit, in C channels, F segments, B blocks, K coefficients.

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
    clock_prior
        (K, K): what the priors of offsets and starts contribute.
    prior
        (K, K): what the priors of the coefficients contribute.
    crashed
        (F,) which simulated segments crashed.
    """

    channels: tuple[str, ...]
    flight: NDArray[np.int_]
    blocks: Array
    score: Array
    spread: Array
    clock_prior: Array
    prior: Array
    crashed: NDArray[np.bool_]

    @staticmethod
    def joined(parts: Sequence[FisherInformation]) -> FisherInformation:
        """Return what flights say of which each part holds the next ones."""
        first = parts[0]
        before = np.cumsum([0, *(int(part.flight.max()) + 1 for part in parts)])
        return FisherInformation(
            channels=first.channels,
            flight=np.concatenate(
                [part.flight + begin for part, begin in zip(parts, before, strict=False)]
            ),
            blocks=np.concatenate([part.blocks for part in parts], axis=1),
            score=np.concatenate([part.score for part in parts], axis=1),
            spread=np.concatenate([part.spread for part in parts], axis=1),
            clock_prior=np.sum([part.clock_prior for part in parts], axis=0),
            prior=first.prior,
            crashed=np.concatenate([part.crashed for part in parts]),
        )

    @property
    def data(self) -> Array:
        """The information (K, K) of all flights."""
        return np.asarray(self.blocks.sum(axis=(0, 1, 2)) + self.clock_prior)

    @property
    def total(self) -> Array:
        """The information (K, K) of flights and priors."""
        return np.asarray(self.data + self.prior)


def information_at(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    *,
    clocks: NDArray[np.bool_] | None = None,
    block: float = BLOCK,
) -> FisherInformation:
    """Evaluate the Jacobian at a point and sum it up.

    Parameters
    ----------
    objective, point, criterion
        A fit and where it stands.
    clocks
        (offsets, N) which offsets were fitted; by default those that are not exactly zero.
    block
        s of one flight that are summed up together.
    """
    jacobian = objective.jacobian(point, criterion)
    return information_from_jacobian(
        objective, point, criterion, jacobian, clocks=clocks, block=block
    )


def information_from_jacobian(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    jacobian: Jacobian,
    *,
    clocks: NDArray[np.bool_] | None = None,
    block: float = BLOCK,
) -> FisherInformation:
    """Sum a Jacobian up; see `information_at`."""
    count, segments = len(objective.space), objective.segments.count
    channels = tuple(jacobian.residuals)
    blocks = _block_count(objective, criterion, block)
    states = 0 if criterion.states is None else len(criterion.states)
    size = count + point.offsets.shape[0] + states
    information = np.zeros((len(channels), segments, blocks, size, size))
    score = np.zeros((len(channels), segments, blocks, size))
    spread = np.ones((len(channels), segments))
    for number, channel in enumerate(channels):
        columns = np.asarray(jacobian.columns[channel])
        residuals = np.asarray(jacobian.residuals[channel])
        weight = np.asarray(objective.segments.measured[channel].weight)
        time = np.asarray(objective.segments.measured[channel].time)
        scale = np.asarray(criterion.scale[channel])[np.asarray(objective.segments.flight)]
        for segment in range(segments):
            rows = columns[..., segment] / scale[segment]
            error = residuals[..., segment] / scale[segment]
            size_of = np.abs(error)
            robust = np.minimum(1.0, float(criterion.huber) / np.maximum(size_of, 1e-300))
            which = np.minimum((time[:, segment] / block).astype(int), blocks - 1)
            for one in range(blocks):
                here = which == one
                part = rows[:, here].reshape(size, -1)
                heavy = part * robust[here].ravel()
                information[number, segment, one] = heavy @ part.T
                score[number, segment, one] = heavy @ error[here].ravel()
            compared = (weight[..., segment] > 0) & np.any(rows != 0, axis=0)
            if compared.any():
                spread[number, segment] = np.mean((robust * error**2)[compared])
    raw = _Raw(channels, information, score, spread)
    fitted = np.asarray(point.offsets) != 0.0 if clocks is None else clocks
    return _without_clocks(
        objective,
        point,
        criterion,
        raw,
        clocks=fitted,
        crashed=np.isfinite(np.asarray(jacobian.crash_time)),
    )


@dataclass(frozen=True)
class _Raw:
    """Sums with the nuisances still in them, in the search's coordinates."""

    channels: tuple[str, ...]
    blocks: Array
    score: Array
    spread: Array


def _block_count(objective: Objective, criterion: Criterion, block: float) -> int:
    seconds = float(criterion.horizon) / float(objective.schedule.log_rate)
    return max(int(seconds / block), 1)


def _without_clocks(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    raw: _Raw,
    *,
    clocks: NDArray[np.bool_],
    crashed: NDArray[np.bool_],
) -> FisherInformation:
    """Change to scaled coordinates; eliminate the segments' starts, then the flights' offsets."""
    space, segments = objective.space, objective.segments.count
    count, kinds = len(space), len(clocks)
    slope = space.slope(np.asarray(point.coefficients))
    stretch = np.concatenate([1.0 / slope, np.ones(raw.score.shape[-1] - count)])
    blocks = raw.blocks * stretch[:, None] * stretch
    score = raw.score * stretch
    flight = np.asarray(objective.segments.flight)
    eliminate = np.zeros((segments, count, len(stretch)))
    nuisance_prior = np.zeros((count, count))
    for number in range(int(flight.max()) + 1):
        own = np.flatnonzero(flight == number)
        first, whole = {}, np.zeros((count + kinds, count + kinds))
        for segment in own:
            first[segment] = _without_start(blocks[:, segment].sum(axis=(0, 1)), count + kinds)
            whole += _kept(blocks[:, segment].sum(axis=(0, 1)), first[segment])
        projection = _projection(whole, clocks[:, number], count)
        second = np.hstack([np.eye(count), projection])
        nuisance_prior += projection @ projection.T / OFFSET_SD**2
        for segment in own:
            eliminate[segment] = second @ first[segment]
            follow = second @ first[segment][:, count + kinds :]
            nuisance_prior += follow @ follow.T
    reduced = np.einsum("lap,clbpq,ldq->clbad", eliminate, blocks, eliminate, optimize=True)
    return FisherInformation(
        channels=raw.channels,
        flight=flight,
        blocks=reduced,
        score=np.einsum("lap,clbp->clba", eliminate, score),
        spread=raw.spread,
        clock_prior=nuisance_prior,
        prior=np.diag(float(criterion.prior) ** 2 / space.prior_sd**2),
        crashed=crashed,
    )


def _without_start(whole: Array, kept: int) -> Array:
    """Return (kept, Q): how all parameters change when a segment's best start follows the others.

    In its standard deviations the prior of a start is one.
    """
    own = whole[kept:, kept:] + np.eye(len(whole) - kept)
    return np.hstack([np.eye(kept), -np.linalg.solve(own, whole[kept:, :kept]).T])


def _kept(whole: Array, along: Array) -> Array:
    """Return the information along some directions, the prior of a start included."""
    kept = len(along)
    return np.asarray(along @ whole @ along.T + along[:, kept:] @ along[:, kept:].T)


def _projection(whole: Array, movable: NDArray[np.bool_], count: int) -> Array:
    """Return (K, offsets): how a flight's best offsets follow the coefficients."""
    projection = np.zeros((count, len(movable)))
    free = np.flatnonzero(movable)
    own = whole[np.ix_(count + free, count + free)] + np.eye(len(free)) / OFFSET_SD**2
    projection[:, free] = -np.linalg.solve(own, whole[count + free, :count]).T
    return projection
