"""Maximum-likelihood estimation of coefficients, clocks and strengths of disturbances together.

Gauss-Newton steps on the likelihood of the innovations. Biased coefficients make disturbances look
stronger and slower than they are, and wrong strengths bias the coefficients in turn: estimated one
after the other they converge slowly.

Innovations are differentiated with fixed gains: at the maximum the gains' own derivatives multiply
innovations that are independent of the past. The likelihood at a step's end comes from a filter
with its own gains. Close to the estimate the two differ by as much as a step gains; there one more
step is as good as any (Le Cam's one-step estimate; van der Vaart, "Asymptotic statistics", 1998,
5.7).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array, scaled_solve
from tuner.disturbances.disturbances import MAX_STRENGTHS, MIN_STRENGTHS, STRENGTHS, clipped
from tuner.disturbances.predictor import Predictor, unscaled
from tuner.disturbances.ticks import samples_of_ticks
from tuner.objective.criterion import OFFSET_SD, OFFSET_UNIT, Criterion, Point, SegmentSums
from tuner.objective.normal_equations import Objective, normal_equations
from tuner.objective.residuals import gauss_newton, huber_loss
from tuner.objective.segments import CLOCKS
from tuner.objective.space import Space
from tuner.recordings.flight import Flight

Mask = NDArray[np.bool_]

MAX_STEPS = 16
"""Default largest number of steps."""
DAMPING_LEVELS = (0.0, 0.1, 1.0, 10.0, 100.0)
"""Shares of the Hessian's diagonal added to it until a step lowers the loss (Levenberg)."""
MAX_STRENGTH_RATIO = 4.0
"""Largest ratio of a strength to that of the step before: further on the likelihood is another."""
LEAST_CHANGE = 0.5 * (MAX_STRENGTH_RATIO**-2 - 1.0)
"""That ratio downwards, as half the relative change of a variance."""
IS_AMPLITUDE = ~np.isin(STRENGTHS, ["gust_lasts", "turbulence_lasts"])
"""Whether a strength is a standard deviation, not a time."""
MAX_CLOCK_SHIFT = 0.25
"""Share of a tick by which a clock moves before samples are assigned to ticks again: until then the
line through their old two ticks is extrapolated."""
MIN_STEP_GAIN = 0.1
"""Least predicted gain of a step, in the log-likelihood."""
NEAR_GAIN, FINAL_GAIN = 4.0, 0.3
"""Predicted gains below which a step is taken untested, and below which it is the last. Strengths
are of the first part of each flight: where they are likeliest, chance alone makes whole flights
less likely by half their number."""
FINAL_SHIFT = 0.25
"""Standard errors of a coefficient or clock: a step near the estimate that moves none by more is
the last. The next would move it by an eighth of that. One that gains less than `FINAL_GAIN`, too,
is not taken."""


def maximise_likelihood(
    predictor: Predictor,
    flights: Sequence[Flight],
    problem: tuple[Objective, Point, Criterion],
    free: Mask,
    steps: int = MAX_STEPS,
) -> tuple[Predictor, Point]:
    """Return predictor and point of the maximum likelihood.

    Parameters
    ----------
    predictor, flights
        The predictor of N flights, with the initial strengths.
    problem
        Objective, initial point and criterion.
    free
        (K + offsets·N,) which parameters may move.
    steps
        Largest number of steps.
    """
    objective, point, criterion = problem
    criterion = unscaled(criterion)
    point = Point(point.coefficients, predictor.inputs.offsets)
    laid, rate = point.offsets, float(objective.schedule.log_rate)
    predictor = predictor.at(objective, point)
    for _ in range(steps):
        equations = _equations(predictor, objective, point, criterion, free)
        change = equations.step(objective.space, point)
        if change is None:
            break
        gain, shift = equations.gain(change), equations.shift(change)
        if gain < FINAL_GAIN and shift < FINAL_SHIFT:
            break
        predictor = predictor.without_gains  # memory holds those of one point
        lower = _descent(equations, predictor, objective, point, criterion, near=gain < NEAR_GAIN)
        if lower is None:
            return predictor.at(objective, point), point
        if gain < FINAL_GAIN or (gain < NEAR_GAIN and shift < FINAL_SHIFT):
            return lower
        predictor, point = lower
        del lower
        noise, moved = predictor.estimated_noise, np.abs(point.offsets - laid)[: len(CLOCKS)].max()
        if noise != predictor.noise or moved * OFFSET_UNIT * rate > MAX_CLOCK_SHIFT:
            predictor = predictor.without_gains
            if moved * OFFSET_UNIT * rate > MAX_CLOCK_SHIFT:
                laid = point.offsets
                predictor = predictor.laid(objective, point, flights)
            predictor = replace(predictor, noise=noise).at(objective, point)
    return predictor, point


def _loss(predictor: Predictor, objective: Objective, point: Point, criterion: Criterion) -> float:
    """Return the negative log-likelihood of the recordings, with that of the priors."""
    assert predictor.found is not None
    own = criterion.prior * objective.space.prior_residuals(point.coefficients)
    of_flights = np.asarray(point.offsets) / OFFSET_SD
    priors = 0.5 * float(np.sum(own**2) + np.sum(of_flights**2))
    return float(np.sum(predictor.found.loss)) + priors


class _Equations(NamedTuple):
    """Gradient (P + 8,) and Hessian of the loss, by P parameters and then by the strengths."""

    gradient: Array
    hessian: Array
    free: Mask

    def gain(self, change: Array) -> float:
        """Return the predicted reduction of the loss by a step."""
        return -float((self.gradient + 0.5 * self.hessian @ change) @ change)

    def shift(self, change: Array) -> float:
        """Return the largest step of a parameter that is no strength, in standard errors."""
        moves = np.flatnonzero(change)
        covariance = scaled_solve(self.hessian[np.ix_(moves, moves)], np.eye(len(moves)))
        of_others = moves < len(change) - len(STRENGTHS)
        shifts = np.abs(change[moves]) / np.sqrt(np.diag(covariance))
        return float(shifts[of_others].max(initial=0.0))

    def step(self, space: Space, point: Point, damping: float = 0.0) -> Array | None:
        """Return the damped Gauss-Newton step; parameters that would leave their bounds stay.

        Strengths move as variances, see `_strengths_step`: one that would fall below none falls as
        far as it may, and others move as that asks of them.
        None where its gain is too small, or not a number as the filter has lost a flight.
        """
        free, change = self.free.copy(), np.zeros(len(self.gradient))
        hessian = self.hessian + damping * np.diag(np.diag(self.hessian))
        amplitudes = len(change) - len(STRENGTHS) + np.flatnonzero(IS_AMPLITUDE)
        while True:
            moves = np.flatnonzero(free)
            left = self.gradient + hessian @ np.where(free, 0.0, change)
            change[moves] = -scaled_solve(hessian[np.ix_(moves, moves)], left[moves])
            share = _share_after(space, point, change)
            leaves = np.flatnonzero(free[: len(space)] & ((share <= 0.0) | (share >= 1.0)))
            vanish = amplitudes[free[amplitudes] & (change[amplitudes] < LEAST_CHANGE)]
            if not len(leaves) and not len(vanish):
                return change if self.gain(change) >= MIN_STEP_GAIN else None
            free[leaves], change[leaves] = False, 0.0
            free[vanish], change[vanish] = False, LEAST_CHANGE


def _equations(
    predictor: Predictor, objective: Objective, point: Point, criterion: Criterion, free: Mask
) -> _Equations:
    space, flight = objective.space, np.asarray(objective.segments.flight)
    (kinds, flights), count = point.offsets.shape, len(space)
    size = count + kinds
    by_kind = free[count:].reshape(kinds, flights).any(axis=1)
    moved = [*np.flatnonzero(free[:count]), *(count + np.flatnonzero(by_kind))]
    slope, information, moves, _ = predictor.slopes(objective, point)
    by_strengths = samples_of_ticks(moves, predictor.inputs.widths, predictor.rows)
    del moves  # derivatives take most of the memory
    jacobian = predictor.jacobian(objective, point, moved)
    segments, total = jacobian.crash_time.shape[0], size + len(slope)
    gradient, hessian = np.zeros((segments, total)), np.zeros((segments, total, total))
    loss, huber = np.zeros(segments), criterion.huber
    for name, more in by_strengths.items():
        errors = np.moveaxis(np.asarray(jacobian.residuals[name]), -1, 0)
        columns = [np.moveaxis(c, (0, -1), (-1, 0)) for c in (jacobian.columns.pop(name), more)]
        scale = criterion.scale[name]
        along, bend = gauss_newton(np.concatenate(columns, axis=-1), errors, scale, huber)
        gradient += along
        hessian += bend
        loss += 0.5 * huber_loss(errors, huber).sum(axis=(1, 2))
    gradient, hessian = np.moveaxis(gradient, 0, -1), np.moveaxis(hessian, 0, -1)
    sums = SegmentSums(
        loss=loss,
        gradient=gradient[:size],
        hessian=hessian[:size, :size],
        squares={},
        counts={},
        crash_time=jacobian.crash_time,
        states=None,
    )
    _, own, among = map(np.asarray, normal_equations(objective, point, criterion, sums))
    across = np.asarray(hessian[:size, size:])
    owner = flight[:, None] == np.arange(flights)
    of_flights = np.moveaxis(across[count:] @ owner, -1, 1).reshape(kinds * flights, -1)
    across = np.concatenate([across[:count].sum(axis=-1), of_flights])
    bend = information + 1e-9 * np.eye(len(slope))
    held = _held(predictor.strengths, slope, information)
    return _Equations(
        np.concatenate([own, slope]),
        np.block([[among, across], [across.T, bend]]),
        np.concatenate([free, ~held]),
    )


def _descent(
    equations: _Equations,
    predictor: Predictor,
    objective: Objective,
    point: Point,
    criterion: Criterion,
    *,
    near: bool,
) -> tuple[Predictor, Point] | None:
    """Return predictor and point after a step that lowers the loss; None if there is none.

    Where the estimate is ``near`` a step need not lower the loss.
    """
    space, strengths = objective.space, predictor.strengths
    here = _loss(predictor, objective, point, criterion)
    for damping in DAMPING_LEVELS:
        change = equations.step(space, point, damping)
        if change is None:
            return None
        by_strengths = _strengths_step(change[-len(strengths) :])
        to = _moved(space, point, change[: -len(strengths)])
        tried = replace(predictor, strengths=clipped(strengths + by_strengths)).at(objective, to)
        if _loss(tried, objective, to, criterion) < here or (near and not tried.is_lost):
            return tried, to
        del tried  # its gains are large
    return None


def _strengths_step(change: Array) -> Array:
    """Return the step (8,) of the strengths' logarithms for a change that their slopes ask for.

    That is of variances: the innovations' covariance is linear in them, and scoring for one that
    stands alone ends in one step (Harvey 1989, 4.3.3).
    """
    step = change.copy()
    step[IS_AMPLITUDE] = 0.5 * np.log(1.0 + 2.0 * change[IS_AMPLITUDE])
    return np.clip(step, -np.log(MAX_STRENGTH_RATIO), np.log(MAX_STRENGTH_RATIO))


def _held(strengths: Array, slope: Array, information: Array) -> Mask:
    """Return which strengths (8,) stay: those at a bound that their slopes point beyond.

    And those near none. The logarithm of a strength that tends to zero has no curvature, so that a
    round-off would choose its step. It stays where it is known to no better than a factor of e and
    where without it recordings would be no likelier by `MIN_STEP_GAIN`, as long as they would be
    likelier with less of it.
    """
    none = IS_AMPLITUDE & (np.diag(information) < 1.0) & (0.5 * slope < MIN_STEP_GAIN)
    lower = (slope > 0.0) & (none | (strengths <= MIN_STRENGTHS))
    return np.asarray(lower | (slope < 0.0) & (strengths >= MAX_STRENGTHS))


def _share_after(space: Space, point: Point, change: Array) -> Array:
    """Return the coefficients' places between their bounds after a step in scaled coordinates.

    The search's own coordinate is logistic: next to a bound a step in it has no effect.
    """
    vector = np.asarray(point.coefficients)
    moved = space.slope(vector) * change[: len(vector)] / space.width
    return np.asarray(space.share(vector) + moved)


def _moved(space: Space, point: Point, change: Array) -> Point:
    vector, moved = np.asarray(point.coefficients), change[: len(point.coefficients)] != 0.0
    after = np.where(moved, space.at_share(_share_after(space, point, change)), vector)
    offsets = change[len(vector) :].reshape(point.offsets.shape)
    return Point(after, np.asarray(point.offsets) + offsets)
