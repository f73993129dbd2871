"""Cross-validation by flights: each predicted by a fit to the others, one linear step away.

A flight that is alone is predicted section by section, by fits to its other sections.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_jax.numeric import Array
from tuner.core.numerics import scaled_solve
from tuner.objective.criterion import OFFSET_SD, Point, SegmentSums
from tuner.objective.space import Space
from tuner.search.fitted import Fitted
from tuner.terms.linearisation import Columns, Linear

LONGEST_STEP = 1.0
"""Standard deviations of a prior that a coefficient may move in one linear step."""


def predicted_losses(
    fitted: Fitted, linear: Linear, model: Columns, own: Columns, scale: Mapping[str, Array]
) -> NDArray[np.float64]:
    """Return the loss (N,) of each flight with the coefficients that the others ask for.

    One linear step leads from the joint fit to the fit without the flight; there the flight is
    simulated. Its own offsets follow. A flight that is alone is simulated with the joint fit; what
    its sections lose by fits without them is the linear approximation's.

    Parameters
    ----------
    fitted, linear
        The joint fit, and the loss about it.
    model, own
        Columns of ``linear`` that may move, and those of the fit's own space in its order.
    scale
        Channel -> (N,) factor on the standard deviations.
    """
    objective, criterion = fitted.objective, replace(fitted.criterion, scale=dict(scale))
    space, flight = objective.space, objective.flight
    movable, losses = offsets_fitted(fitted), []
    alone = objective.flights == 1
    for number in range(objective.flights):
        change = np.zeros(len(own))
        if not alone:
            change = linear.step(model, inside=linear.flight != number)[own]
        vector = vector_after(space, fitted.point.coefficients, change)
        sums = objective.sums(
            Point(vector, fitted.point.offsets),
            criterion,
            derivatives=bool(movable.any()),
            still=True,
        )
        inside = flight == number
        loss = float(np.asarray(sums.loss)[inside].sum())
        losses.append(loss - _gain_of_offsets(sums, inside, movable[:, number]))
    return np.array(losses) * (lost_by_sections(linear, model) if alone else 1.0)


def lost_by_sections(linear: Linear, model: Columns) -> float:
    """Return the loss of sections by fits without them, over that of the fit to all."""
    lost = 0.0
    for out in linear.folds(linear.section):
        lost += float(linear.change_of_loss(linear.step(model, inside=~out))[out].sum())
    return 1.0 + lost / linear.loss


def vector_after(space: Space, vector: Array, change: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the search vector (K,) after a change of the scaled coordinates, inside the bounds."""
    far = LONGEST_STEP * space.prior_sd
    scaled = space.scaled(vector) + np.clip(change, -far, far)
    return space.vector_at(scaled)


def offsets_fitted(fitted: Fitted) -> NDArray[np.bool_]:
    """Return which offsets (offsets, N) a fit moved: those that are not exactly zero."""
    return np.asarray(np.asarray(fitted.point.offsets) != 0.0)


def _gain_of_offsets(
    sums: SegmentSums, inside: NDArray[np.bool_], movable: NDArray[np.bool_]
) -> float:
    """Return by how much a flight's loss falls when its offsets follow, in one linear step."""
    free = np.flatnonzero(movable)
    if not len(free):
        return 0.0
    gradient = np.asarray(sums.gradient)[free][:, inside].sum(axis=-1)
    hessian = np.asarray(sums.hessian)[np.ix_(free, free)][..., inside].sum(axis=-1)
    hessian = hessian + np.eye(len(free)) / OFFSET_SD**2
    return float(0.5 * gradient @ scaled_solve(hessian, gradient))
