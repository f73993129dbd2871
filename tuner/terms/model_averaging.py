"""Bayesian model averaging: the shift of a fit's coefficients by the terms left out of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tuner.core.numerics import Array, scaled_solve, symmetric_eigen
from tuner.search.continuation import RIDGE
from tuner.terms.linearisation import Columns, LinearisedLoss
from tuner.uncertainty.covariance import STRETCH_S, overdispersion_factors, scatter

NEGLIGIBLE_SE, NEGLIGIBLE_SIZE = 0.4, 0.1
"""Shares of a term's standard error and of its usual size (its prior's standard deviation): below
the smaller of the two a term makes no difference that flights could show."""
SIZE_GRID_POINTS = 40
"""Sizes averaged over, from negligible to usual, equally spaced in logarithm."""
MIN_RELATIVE_INFORMATION = 1e-10
"""Least information of a direction, relative to the group's largest and its prior's: anything less
is rounding, and the prior decides."""


def selection_shifts(
    linear: LinearisedLoss, model: Columns, groups: Iterable[tuple[Columns, float]]
) -> Array:
    """Return the root mean square shift of each parameter (P,) of the model by omitted groups.

    Each group is added by itself, to first order. A priori it is absent, or its coefficients are
    normal about their neutral values with a log-uniform size, from negligible to usual. Models
    without the group and with it in each size are averaged by their posterior probabilities. So an
    insignificant term adds little however far a refit would move, and one that is likely but not
    significant adds its full shift. The mean squares of all groups add up.

    Parameters
    ----------
    linear
        The loss about the fit.
    model
        Columns of the model's parameters.
    groups
        Columns of each omitted group, and the prior probability that the vehicle has it.

    Notes
    -----
    Hoeting, Madigan, Raftery and Volinsky, "Bayesian model averaging: a tutorial", 1999. The
    errors in the evidence include gusts: they come from the scatter of stretches of time about a
    fit with the group, corrected for the fitted degrees of freedom
    (`tuner.uncertainty.covariance.scatter`; twenty coefficients and a group fitted to a minute of
    flight leave a fraction of it). They are compared with noise as a fit's own errors are
    (`tuner.uncertainty.covariance`), along the axes of the noise: the scatter of a few stretches
    always has an axis along which it is far too small. The shift of a refit alone is no measure:
    where flights hardly separate a term from the model it is chance.
    """
    square = linear.information() + linear.prior
    alone = linear.step(model)
    squares = np.zeros(len(linear.scaled))
    for group, presence in groups:
        evidence = Evidence.of(linear, square, alone, model, group)
        squares[model] += evidence.mean_square(presence)
    return np.asarray(np.sqrt(squares))


@dataclass(frozen=True)
class Evidence:
    """Estimates of a group's coefficients in units of their usual sizes, along independent axes.

    Attributes
    ----------
    moves
        (K, L) shift of the model's coefficients per unit along each axis.
    value, variance
        (L,) the estimate along each axis.
    """

    moves: Array
    value: Array
    variance: Array

    @staticmethod
    def of(
        linear: LinearisedLoss, square: Array, alone: Array, model: Columns, group: Columns
    ) -> Evidence:
        """Return the evidence beside a model whose minimum is at ``alone`` (P,)."""
        usual = linear.prior_sd[group]
        own, across = square[np.ix_(model, model)], square[np.ix_(model, group)]
        follow = -scaled_solve(own, across, RIDGE)
        left = square[np.ix_(group, group)] + square[np.ix_(group, model)] @ follow
        pull = linear.pull + linear.prior @ alone
        slope = (linear.gradients(alone).sum(axis=0) + pull)[group] * usual
        known = left * np.outer(usual, usual) - np.eye(len(group))  # by the flights alone
        values, axes = symmetric_eigen(known)
        values = np.maximum(values, MIN_RELATIVE_INFORMATION * max(values[-1], 1.0))
        slope, moves = axes.T @ slope, follow * usual @ axes
        both = np.concatenate([model, group])
        along = np.zeros((len(square), len(group)))
        along[both] = np.vstack([moves, usual[:, None] * axes])
        wider = alone - along @ (slope / (values + 1.0))
        turned = np.hstack([np.eye(len(square))[:, model], along])[both]
        meat, freedom = scatter(
            linear.stretches(both, wider, STRETCH_S).projected(turned),
            turned.T @ square[np.ix_(both, both)] @ turned,
        )
        seen, freedom = np.diag(meat)[len(model) :] / values, freedom[len(model) :]
        alike = np.ones(len(group))
        allowed = overdispersion_factors(seen, freedom, np.diag(alike), alike)
        return Evidence(moves, -slope / values, allowed**2 / values)

    def mean_square(self, presence: float) -> Array:
        """Return the mean square shifts (K,) over the posterior of the group's size.

        ``presence`` is the prior probability of a size other than zero.
        """
        std_error = np.exp(0.5 * np.mean(np.log(np.maximum(self.variance, 1e-300))))
        smallest = min(NEGLIGIBLE_SIZE, NEGLIGIBLE_SE * float(std_error))
        present = np.exp(2.0 * np.linspace(np.log(smallest), 0.0, SIZE_GRID_POINTS))
        sizes = np.append(present, 0.0)[:, None]
        prior = np.append(np.full(SIZE_GRID_POINTS, presence / SIZE_GRID_POINTS), 1.0 - presence)
        allowed = np.maximum(sizes + self.variance, 1e-300)
        log_likelihood = -0.5 * (np.log(allowed) + self.value**2 / allowed).sum(axis=1)
        weight = prior * np.exp(log_likelihood - log_likelihood.max())
        weight /= weight.sum()
        centres = (sizes / allowed * self.value) @ self.moves.T
        scatters = (sizes * self.variance / allowed) @ (self.moves**2).T
        return np.asarray(weight @ (centres**2 + scatters))
