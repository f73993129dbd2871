"""Bayesian model averaging: the shift of a fit's coefficients by the terms left out of it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from tuner.core.numerics import Z95, Array, scaled_solve, symmetric_eigen
from tuner.objective.space import Space
from tuner.search.continuation import RIDGE
from tuner.terms.linearisation import Columns, LinearisedLoss
from tuner.terms.score import long_run_covariance
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
    linear: LinearisedLoss,
    model: Columns,
    groups: Iterable[tuple[Columns, float]],
    substitutes: Iterable[Substitute] = (),
) -> Array:
    """Return the root mean square shift of each parameter (P,) of the model by omitted groups.

    Each group is added by itself, to first order. A priori it is absent, or its coefficients are
    normal about their neutral values with a log-uniform size, from negligible to usual. Models
    without the group and with it in each size are averaged by their posterior probabilities. So an
    insignificant term adds little however far a refit would move, and one that is likely but not
    significant adds its full shift. A group in place of one in the model (`substitutes_of`) adds
    its shift by its probability, and so much that the interval holds it where flights do not
    exclude it. The mean squares of all groups add up.

    Parameters
    ----------
    linear
        The loss about the fit.
    model
        Columns of the model's parameters.
    groups
        Columns of each omitted group, and the prior probability that the vehicle has it.
    substitutes
        Omitted groups that may be there in place of one in the model.

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
        evidence = Evidence.of(linear, square, alone, model, linear.seen(group))
        squares[model] += evidence.mean_square(presence)
    for one in substitutes:
        share = max(one.probability, Z95**-2 if one.is_not_excluded else 0.0)
        squares[model] += share * one.change[model] ** 2
    return np.asarray(np.sqrt(squares))


MAX_CHANCE = 0.05
"""Probability below which flights exclude a group in place of another."""


@dataclass(frozen=True)
class Substitute:
    """A fit with an omitted group in place of a group in the model, to first order.

    Attributes
    ----------
    kept
        The group in the model.
    values
        Coefficient of the omitted group -> its value in that fit.
    change
        (P,) change from the model's minimum to that fit's.
    probability
        Of that fit, if one of the two is true and both are equally likely a priori.
    """

    kept: str
    values: Mapping[str, float]
    change: Array
    probability: float

    @property
    def is_not_excluded(self) -> bool:
        """Whether flights leave it possible."""
        return self.probability > MAX_CHANCE


def substitutes_of(
    linear: LinearisedLoss,
    space: Space,
    model: Columns,
    kept: Mapping[str, Columns],
    left_out: Iterable[Columns],
) -> list[Substitute]:
    """Return the fits with each omitted group in place of each kept one.

    Notes
    -----
    The likelihood ratio of two models that are not nested (Cox, "Tests of separate families of
    hypotheses", 1961). Errors that are correlated in time scatter the scores of stretches more
    than noise would along the change from one minimum to the other, and the logarithm of the ratio
    is divided by that factor.
    """

    def loss(change: Array) -> float:
        prior = (linear.pull + 0.5 * linear.prior @ change) @ change
        return float(linear.change_of_loss(change).sum() + prior)

    alone, square = linear.step(model), linear.information()
    scores, before, found = linear.gradients(alone), loss(alone), list[Substitute]()
    outside = list(left_out)
    for group, own in kept.items():
        without, rest = linear.to_neutral(own), np.setdiff1d(model, own)
        for columns in outside:
            there = linear.step(np.append(rest, linear.seen(columns)), from_=without)
            change = there - alone
            spread = float(long_run_covariance((scores @ change)[:, None], linear.flight)[0, 0])
            excess = max(spread / max(float(change @ square @ change), 1e-300), 1.0)
            probability = float(expit((before - loss(there)) / excess))
            scaled = linear.scaled + there
            values = {  # conditions of flights are columns beyond the space's
                linear.names[i]: space.parameters[i].value_at(scaled[i])
                for i in columns
                if i < len(space)
            }
            found.append(Substitute(group, values, change, probability))
    return found


def values_instead(substitutes: Iterable[Substitute]) -> dict[str, dict[str, float]]:
    """Return kept group -> values of coefficients that flights do not exclude in its place."""
    found: dict[str, dict[str, float]] = {}
    for one in substitutes:
        if one.is_not_excluded:
            found.setdefault(one.kept, {}).update(one.values)
    return found


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
