"""Bayesian model averaging: how far a fit would move with the terms that are not in it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tuner.core.numerics import scaled_solve, symmetric_eigen
from tuner.terms.linearisation import RIDGE, Array, Columns, Linear
from tuner.uncertainty.covariance import STRETCH, overdispersion_factors, scatter

HIDDEN, SMALLEST = 0.4, 0.1
"""Of the standard error with which the flights tell a term, and of its usual size (its prior's
standard deviation): below the smaller of the two it is as good as absent."""
SIZES = 40
"""Sizes that are looked at, from the smallest to the usual one, equally far apart in logarithm."""
FLAT = 1e-10
"""Share of a group's information, and of its prior's, that every direction is taken to have at
least: what is less is rounding, and leaves it to the prior."""


def in_doubt(linear: Linear, model: Columns, groups: Iterable[tuple[Columns, float]]) -> Array:
    """Return how far each parameter (P,) of the model would move with what it lacks.

    Each group is added by itself, to first order, as large as the flights let it be: a priori it is
    absent, or its coefficients are normal about their neutral values, as likely small as large (the
    logarithm of their size is uniform, from what is as good as absent to the usual size), and
    models without the group and with it in each of these sizes are averaged by what the flights say
    of them. So a term that chance explains counts for little however much a refit would move with
    it, and one that the flights call for, but not surely enough to be added, for all of its move.
    The moves of all groups count together as the root of the sum of their mean squares.

    Parameters
    ----------
    linear
        The loss about the fit.
    model
        Columns of what is in the model.
    groups
        Columns of each group that is not, and the probability a priori that the vehicle has it.

    Notes
    -----
    Hoeting, Madigan, Raftery and Volinsky, "Bayesian model averaging: a tutorial", 1999. Its
    evidence takes errors as large as they are, gusts included: they are those of a fit with the
    group, by how much stretches of time scatter about it, corrected for what it takes out of them
    (`tuner.uncertainty.covariance.scatter`; a fit of twenty coefficients and a group to a minute of
    flight leaves a fraction). They are weighed against those of noise as a fit's own are
    (`tuner.uncertainty.covariance`), along axes that noise chooses: of a few stretches' scatter
    there is always an axis along which it is far too small. What a refit would do is no measure
    where the flights can hardly tell a term from the model: that is chance.
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
    """What the flights say of a group's coefficients, in units of their usual sizes.

    Attributes
    ----------
    moves
        (K, L) how far the model's coefficients follow along each axis.
    value, variance
        (L,) an estimate along each axis, independent of the others.
    """

    moves: Array
    value: Array
    variance: Array

    @staticmethod
    def of(linear: Linear, square: Array, alone: Array, model: Columns, group: Columns) -> Evidence:
        """Return the evidence beside a model whose minimum is at ``alone`` (P,)."""
        usual = linear.prior_sd[group]
        own, across = square[np.ix_(model, model)], square[np.ix_(model, group)]
        follow = -scaled_solve(own, across, RIDGE)
        left = square[np.ix_(group, group)] + square[np.ix_(group, model)] @ follow
        pull = linear.pull + linear.prior @ alone
        slope = (linear.slopes(alone).sum(axis=0) + pull)[group] * usual
        known = left * np.outer(usual, usual) - np.eye(len(group))  # by the flights alone
        values, axes = symmetric_eigen(known)
        values = np.maximum(values, FLAT * max(values[-1], 1.0))
        slope, moves = axes.T @ slope, follow * usual @ axes
        both = np.concatenate([model, group])
        along = np.zeros((len(square), len(group)))
        along[both] = np.vstack([moves, usual[:, None] * axes])
        wider = alone - along @ (slope / (values + 1.0))
        turned = np.hstack([np.eye(len(square))[:, model], along])[both]
        meat, freedom = scatter(
            linear.stretches(both, wider, STRETCH).projected(turned),
            turned.T @ square[np.ix_(both, both)] @ turned,
        )
        seen, freedom = np.diag(meat)[len(model) :] / values, freedom[len(model) :]
        alike = np.ones(len(group))
        allowed = overdispersion_factors(seen, freedom, np.diag(alike), alike)
        return Evidence(moves, -slope / values, allowed**2 / values)

    def mean_square(self, presence: float) -> Array:
        """Return mean squares (K,) of the moves, over all sizes by what the flights say of each.

        Parameters
        ----------
        presence
            Probability a priori of a size other than zero.
        """
        told = np.exp(0.5 * np.mean(np.log(np.maximum(self.variance, 1e-300))))
        smallest = min(SMALLEST, HIDDEN * float(told))
        present = np.exp(2.0 * np.linspace(np.log(smallest), 0.0, SIZES))
        sizes = np.append(present, 0.0)[:, None]
        prior = np.append(np.full(SIZES, presence / SIZES), 1.0 - presence)
        allowed = np.maximum(sizes + self.variance, 1e-300)
        log_likelihood = -0.5 * (np.log(allowed) + self.value**2 / allowed).sum(axis=1)
        weight = prior * np.exp(log_likelihood - log_likelihood.max())
        weight /= weight.sum()
        centres = (sizes / allowed * self.value) @ self.moves.T
        scatters = (sizes * self.variance / allowed) @ (self.moves**2).T
        return np.asarray(weight @ (centres**2 + scatters))
