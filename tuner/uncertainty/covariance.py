"""The covariance of the fitted coefficients: the sandwich estimate, for residuals that wander."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Inverse, scaled_root, symmetric_eigen
from tuner.objective.information import FisherInformation
from tuner.uncertainty.overdispersion import IndependentErrors, Stretches, stretches_of

Array = NDArray[np.float64]

WIDE = 100.0
"""Factor on the priors' widths that leaves practically the information of the flights alone."""
FULL_LEVERAGE = 0.5
"""Leverage of a stretch of time on the fit up to which its score is corrected in full."""
MAX_LEVERAGE = 0.999
"""Leverage beyond which it is corrected no further."""
RIDGE = 1e-13
"""Of the scaled information: below rounding errors of what flights and priors add up to."""


@dataclass(frozen=True)
class Covariance:
    """Covariance of the K estimates, in the scaled coordinates.

    Attributes
    ----------
    matrix
        (K, K), flights and priors together, inflated where residuals are correlated in time. The
        errors are those of normal distributions with the 95 % intervals that are meant.
    data_only
        (K, K), the same from the flights alone; huge where they carry no information.
    inflation
        (K,) standard error over that of independent residuals, at least 1.
    beyond_noise
        (K,) standard error over that of independent residuals as large as assumed.
    """

    matrix: Array
    data_only: Array
    inflation: Array
    beyond_noise: Array

    def widened(self, error: Array) -> Covariance:
        """Return the covariance with larger standard errors (K,) and the same correlations."""
        factor = error / self.error
        wider = np.outer(factor, factor)
        return replace(
            self,
            matrix=self.matrix * wider,
            data_only=self.data_only * wider,
            beyond_noise=self.beyond_noise * factor,
        )

    @property
    def error(self) -> Array:
        """Standard errors (K,)."""
        return np.asarray(np.sqrt(np.diag(self.matrix)))

    @property
    def data_error(self) -> Array:
        """Standard errors (K,) from the flights alone."""
        return np.asarray(np.sqrt(np.diag(self.data_only)))

    @property
    def shape(self) -> Array:
        """``data_only`` (K, K), but widened alike for all: what trades off exactly still does."""
        own = np.outer(self.beyond_noise, self.beyond_noise)
        return np.asarray(self.data_only / own * np.median(self.beyond_noise) ** 2)

    @property
    def correlation(self) -> Array:
        """Correlation matrix (K, K)."""
        return np.asarray(self.matrix / np.outer(self.error, self.error))


def covariance_of(information: FisherInformation) -> Covariance:
    """Return the covariance of a fit.

    With independent residuals the covariance is H⁻¹ B H⁻¹, B each channel's information times its
    residuals' mean square. Gusts and model error are no white noise: stretches of time are summed
    up and their scores' spread takes the place of B (the sandwich estimate). A score is corrected
    for the stretch's own leverage on the fit, in full as the jackknife has it (CV3): half of that,
    which is exact for white noise, is too little for what wanders slowly, for a fit of many
    coefficients takes much of it out (MacKinnon, Nielsen and Webb, "Fast and reliable jackknife and
    bootstrap methods for cluster-robust inference", 2023). What one stretch alone determines the
    others tell so little of that the jackknife would multiply white noise without bound: beyond a
    leverage of one half, half of the correction is for it, and white noise counts no more than
    twice. Few stretches make that estimate erratic: what is allowed for is weighed against what
    independent residuals would say, by the degrees of freedom that the stretches amount to
    (`overdispersion_factors`; Bell and McCaffrey, "Bias reduction in standard errors for linear
    regression with multi-stage samples", 2002).
    """
    independent = IndependentErrors.of(information)
    inverse, matrix = independent.inverse, independent.matrix
    meat, freedom = scatter(stretches_of(information), information.total)
    observed = np.diag(inverse.sandwiched(meat, np.zeros_like(meat)))
    inflation = independent.widened(observed, freedom) / np.sqrt(np.diag(matrix))
    data = information.data + information.prior / WIDE**2
    data_inverse = Inverse.of(data, information.prior / WIDE**2).matrix
    matrix = matrix * np.outer(inflation, inflation)
    beyond_noise = np.sqrt(np.diag(matrix) / np.diag(inverse.matrix))
    return Covariance(
        matrix=matrix,
        data_only=data_inverse * np.outer(beyond_noise, beyond_noise),
        inflation=inflation,
        beyond_noise=beyond_noise,
    )


def scatter(stretches: Stretches, total: Array) -> tuple[Array, Array]:
    """Return the sum (K, K) over stretches of the corrected scores' outer products, the "meat".

    And the degrees of freedom (K,) of the variances that it gives: were the scores' covariances
    the stretches' information, less what the fit takes out, those would be quadratic forms whose
    first two moments are those of a χ² with so many.
    """
    factor, unit = scaled_root(total, RIDGE)
    scale = np.outer(unit, unit)
    white = np.linalg.inv(factor)
    leverage = white @ (stretches.information * scale) @ white.T
    values, vectors = symmetric_eigen(leverage)
    left = 1.0 - np.clip(values, 0.0, MAX_LEVERAGE)
    by = np.sqrt(left * np.maximum(left, 1.0 - FULL_LEVERAGE))
    correct = (vectors / by[:, None]) @ vectors.transpose(0, 2, 1)
    corrected = np.einsum("nij,nj->ni", correct, (stretches.score * unit) @ white.T) @ factor.T
    meat = corrected.T @ corrected / scale

    weight = correct @ white  # how each variance weighs the scores
    taken = leverage @ weight
    own = np.einsum("nik,nik->nk", weight, taken)
    squares = np.einsum("nik,nik->nk", taken, taken)
    together = np.einsum("nik,njk->kij", taken, taken, optimize=True)
    mean = own.sum(axis=0) - squares.sum(axis=0)
    half_variance = (own**2 - 2.0 * own * squares).sum(axis=0) + (together**2).sum(axis=(1, 2))
    return np.asarray(meat), np.asarray(mean**2 / np.maximum(half_variance, 1e-300))
