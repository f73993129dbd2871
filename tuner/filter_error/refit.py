"""The coefficients that predict best: Gauss-Newton on whitened innovations.

Strengths of the disturbances, gains, and the ticks at which samples are taken stay while a point is
descended to, then follow it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.coefficients.space import Space
from tuner.filter_error.predictor import Predictor, unscaled
from tuner.flights.flight import Flight
from tuner.objective.criterion import Criterion, Jacobian, Point, SegmentSums
from tuner.objective.loss import gauss_newton, robust_loss
from tuner.objective.normal import Objective
from tuner.search.normal_equations import normal_equations

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

LEARNT_FROM = (6.0, 18.0)
"""s of each flight from which strengths are learnt, each time before a descent: at first roughly,
what least squares leaves of the disturbances in its coefficients is still in them."""
MORE = 6
"""Times that they are learnt and descended from again, at most, until little is gained by it."""
SETTLED = 20.0
"""Gain of the logarithmic likelihood from one time to the next that is little."""
STEPS = 3
"""Of Gauss and Newton with gains that stay, at most."""
HALVINGS = 3
ENOUGH = 0.3
"""Gain of the loss, in half a unit of χ², below which a step was the last."""


def with_least_innovations(
    predictor: Predictor,
    flights: Sequence[Flight],
    problem: tuple[Objective, Point, Criterion],
    free: Mask,
    *,
    learnt_from: Sequence[float] = LEARNT_FROM,
) -> tuple[Predictor, Point]:
    """Return the predictor whose innovations are least, and the point at which they are.

    Parameters
    ----------
    predictor, flights
        The predictor of N flights.
    problem
        With the point where the descent begins, and its criterion.
    free
        (K + offsets·N,) what may move.
    learnt_from
        s of each flight from which strengths are learnt, before each descent; the last of them as
        often as it takes where the descent began far off.
    """
    objective, point, criterion = problem
    point = Point(point.coefficients, predictor.feed.offsets)
    loss = np.inf
    for number, seconds in enumerate((*learnt_from, *[learnt_from[-1]] * MORE)):
        predictor = predictor.learnt(objective, point, seconds)
        assert predictor.found is not None
        before, loss = loss, float(np.sum(predictor.found.loss))
        if number >= len(learnt_from) and before - loss < SETTLED:
            break
        point = _descended(predictor, objective, point, unscaled(criterion), free)
        laid = Predictor.of(objective, point, flights)
        assert laid is not None
        predictor = replace(laid, strengths=predictor.strengths, noise=predictor.noise)
    return predictor.at(objective, point), point


def _descended(
    predictor: Predictor, objective: Objective, point: Point, criterion: Criterion, free: Mask
) -> Point:
    """Return the point of least loss, by steps that are halved if they lead up."""
    kinds, flights = np.shape(point.offsets)
    count = len(objective.space)
    moved = [
        *np.flatnonzero(free[:count]),
        *(count + np.flatnonzero(free[count:].reshape(kinds, flights).any(axis=1))),
    ]

    def equations(at: Point) -> tuple[float, Array, Array]:
        sums = _sums(predictor.jacobian(objective, at, moved), criterion)
        loss, gradient, hessian = normal_equations(
            objective.space, objective.segments.flight, at, criterion, sums
        )
        return float(loss), np.asarray(gradient), np.asarray(hessian)

    here = equations(point)
    for _ in range(STEPS):
        change = _step(objective.space, point, here[1], here[2], free)
        for halving in range(HALVINGS + 1):
            tried = _moved(objective.space, point, change * 0.5**halving)
            there = equations(tried)
            if there[0] < here[0]:
                break
        else:
            return point
        gained, here, point = here[0] - there[0], there, tried
        if gained < ENOUGH:
            break
    return point


def _sums(jacobian: Jacobian, criterion: Criterion) -> SegmentSums:
    """Return each segment's loss with its derivatives, not divided by how much was compared."""
    segments = len(jacobian.crash_time)
    gradient, hessian = gauss_newton(
        jacobian.columns, jacobian.residuals, criterion.scale, criterion.huber
    )
    return SegmentSums(
        loss=robust_loss(jacobian.residuals, criterion.huber),
        gradient=gradient,
        hessian=hessian,
        squares={},
        counts={},
        crash_time=jnp.full(segments, jnp.inf),
        states=None,
    )


def _step(space: Space, point: Point, gradient: Array, hessian: Array, free: Mask) -> Array:
    """Return the Gauss-Newton step in which what would leave its bounds stays where it is."""
    free = free.copy()
    while True:
        moves = np.flatnonzero(free)
        unit = 1.0 / np.sqrt(np.diag(hessian)[moves])
        scaled = hessian[np.ix_(moves, moves)] * np.outer(unit, unit)
        change = np.zeros(len(gradient))
        change[moves] = -unit * np.linalg.solve(scaled, unit * gradient[moves])
        share = _share_after(space, point, change)
        leaves = np.flatnonzero(free[: len(space)] & ((share <= 0.0) | (share >= 1.0)))
        if not len(leaves):
            return change
        free[leaves] = False


def _share_after(space: Space, point: Point, change: Array) -> Array:
    """Return where between their bounds the coefficients lie after a step, linear in scaled ones.

    The search's own coordinate is logistic: next to a bound a step in it goes nowhere.
    """
    vector = np.asarray(point.coefficients)
    moved = space.slope(vector) * change[: len(vector)] / space.width
    return np.asarray(space.share(vector) + moved)


def _moved(space: Space, point: Point, change: Array) -> Point:
    vector, moved = np.asarray(point.coefficients), change[: len(point.coefficients)] != 0.0
    after = np.where(moved, space.at_share(_share_after(space, point, change)), vector)
    offsets = change[len(vector) :].reshape(point.offsets.shape)
    return Point(jnp.asarray(after), point.offsets + jnp.asarray(offsets))
