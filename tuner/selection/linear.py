"""A fit in linear approximation about a point: what adding, freeing or leaving out would change.

The loss of each stretch of time is a quadratic in the coefficients, from one Jacobian:
``L(x + δ) = L(x) + sᵀδ + ½ δᵀHδ`` in the scaled coordinates, each segment's start and each flight's
offsets eliminated. A group of coefficients is added by letting its δ move; one in the model is
taken away by the δ that leads back to its neutral value.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import Criterion, Jacobian, Point
from tuner.objective.flight_batches import portion, portions
from tuner.objective.normal import Objective
from tuner.uncertainty.information import FisherInformation, information_from_jacobian

Array = NDArray[np.float64]
Columns = NDArray[np.intp]

SECTIONS = 3
"""Into how many sections in time flights are cut, where sections are left out."""
COLUMNS = 16
"""Parameters to differentiate by at a time, whatever the number in the model: one program."""
RIDGE = 1e-12
"""Added to a Hessian of unit diagonal: what it lets move is what nothing determines."""


@dataclass(frozen=True)
class Linear:
    """The loss about a point, stretch by stretch; K coefficients, S stretches.

    Attributes
    ----------
    scaled
        (K,) the point.
    hessian, score
        (S, K, K) and (S, K).
    prior, pull
        (K, K) information of all priors, and (K,) gradient of those of the coefficients.
    flight, section
        (S,) where each stretch belongs.
    loss
        Half the robust sum of squares of all flights.
    """

    scaled: Array
    hessian: Array
    score: Array
    prior: Array
    pull: Array
    flight: NDArray[np.intp]
    section: NDArray[np.intp]
    loss: float

    def step(
        self, free: Columns, *, inside: NDArray[np.bool_], from_: Array | None = None
    ) -> Array:
        """Return the change (K,) that minimises the loss of some stretches.

        Parameters
        ----------
        free
            What may move.
        inside
            (S,) which stretches are fitted.
        from_
            (K,) change that is made anyway; none by default.
        """
        change = np.zeros(len(self.scaled)) if from_ is None else from_.copy()
        hessian = self.hessian[inside].sum(axis=0) + self.prior
        slope = self.score[inside].sum(axis=0) + self.pull + hessian @ change
        square = hessian[np.ix_(free, free)]
        unit = 1.0 / np.sqrt(np.maximum(np.diag(square), 1e-300))
        scaled = square * np.outer(unit, unit) + RIDGE * np.eye(len(free))
        change[free] -= unit * np.linalg.solve(scaled, unit * slope[free])
        return change

    def change_of_loss(self, change: Array) -> Array:
        """Return by how much each stretch's loss (S,) changes."""
        quadratic = np.einsum("p,spq,q->s", change, self.hessian, change, optimize=True)
        return np.asarray(self.score @ change + 0.5 * quadratic)

    def folds(self, by: NDArray[np.intp]) -> Iterator[NDArray[np.bool_]]:
        """Return which stretches (S,) each fold leaves out."""
        for number in np.unique(by):
            yield by == number


def linear_at(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    *,
    offsets_fitted: NDArray[np.bool_],
) -> Linear:
    """Return the linear approximation of a fit, from one Jacobian by all of its parameters.

    Flights whose Jacobian would not fit the objective's memory take turns.
    """
    parts, loss = [], 0.0
    for flights in portions(objective, point, criterion):
        batch = portion(objective, point, criterion, flights)
        jacobian = batch[0].jacobian(*batch[1:], columns=COLUMNS)
        parts.append(
            information_from_jacobian(*batch, jacobian, offsets_fitted=offsets_fitted[:, flights])
        )
        loss += _loss_of(batch[0], batch[2], jacobian)
    information = FisherInformation.joined(parts)
    scaled = np.asarray(objective.space.scaled(jnp.asarray(point.coefficients)))
    return linear_of(information, scaled, objective.space.prior_mean, loss)


def linear_of(information: FisherInformation, scaled: Array, mean: Array, loss: float) -> Linear:
    """Return the linear approximation from the information at a point and its loss."""
    segments, blocks = information.blocks.shape[1:3]
    count = len(scaled)
    section = np.minimum(np.arange(blocks) * SECTIONS // blocks, SECTIONS - 1)
    hessian = information.blocks.sum(axis=0).reshape(-1, count, count)
    flown = np.einsum("spp->s", hessian) > 0
    return Linear(
        scaled=scaled,
        hessian=hessian[flown],
        score=information.score.sum(axis=0).reshape(-1, count)[flown],
        prior=information.prior + information.nuisance_prior,
        pull=np.diag(information.prior) * (scaled - mean),
        flight=np.repeat(information.flight, blocks)[flown],
        section=np.tile(section, segments)[flown],
        loss=loss,
    )


def _loss_of(objective: Objective, criterion: Criterion, jacobian: Jacobian) -> float:
    """Return half the robust sum of squares, as the search counts it."""
    flight, limit, total = np.asarray(objective.segments.flight), float(criterion.huber), 0.0
    for channel, residuals in jacobian.residuals.items():
        size = np.abs(np.asarray(residuals) / np.asarray(criterion.scale[channel])[flight])
        with np.errstate(invalid="ignore"):
            squares = np.where(size > limit, 2.0 * limit * size - limit**2, size**2)
        total += 0.5 * float(squares.sum())
    return total
