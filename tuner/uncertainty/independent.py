"""What errors would be were residuals independent, and how much wider they are seen to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Inverse
from tuner.objective.information import FisherInformation
from tuner.uncertainty.overdispersion import allowed_for

Array = NDArray[np.float64]

ROUNDING = 1e-9
"""Share of a variance that the flights must have in it to say anything of it."""
LEAST = 1e-3
"""Of what is expected of a sum of squares: less is chance."""
HARDLY = 0.1
"""Share of a variance that, if a fit leaves no more of it to be seen, halves what is made of it."""


@dataclass(frozen=True)
class IndependentErrors:
    """Errors of K estimates with independent residuals, as large as they are seen to be.

    Attributes
    ----------
    inverse
        Of the information.
    matrix
        (K, K) covariance H⁻¹ B H⁻¹, B each channel's information times its residuals' mean square.
    from_flights
        (K,) the flights' share of the variances.
    disturbed
        (K,) how many times their share the channels and times that determine each coefficient are
        disturbed; how much they differ is meant, not how large they are.
    """

    inverse: Inverse
    matrix: Array
    from_flights: Array
    disturbed: Array

    @staticmethod
    def of(information: FisherInformation) -> IndependentErrors:
        """Return the errors of a fit."""
        inverse = Inverse.of(information.total, information.given)
        white = np.einsum("cf,cfbpq->pq", information.spread, information.blocks)
        from_flights = np.diag(inverse.sandwiched(white, np.zeros_like(white)))
        return IndependentErrors(
            inverse=inverse,
            matrix=_positive(inverse.sandwiched(white, information.given), inverse.matrix),
            from_flights=from_flights,
            disturbed=_disturbed(information, inverse.matrix, from_flights),
        )

    def widened(self, observed: Array, freedom: Array) -> Array:
        """Return the standard errors (K,) that an observed scatter speaks for.

        Parameters
        ----------
        observed
            (K,) the variances that the flights are seen to have.
        freedom
            (K,) degrees of freedom of what was observed; see `allowed_for`.
        """
        variance = np.diag(self.matrix)
        # where the prior alone speaks, what is left of the flights' share is rounding, of any sign
        speaks = self.from_flights > ROUNDING * variance
        ratio = np.where(speaks, observed / np.where(speaks, self.from_flights, 1.0), 1.0)
        covariance = self.inverse.matrix
        own = np.sqrt(np.diag(covariance))
        allowed = allowed_for(ratio, freedom, covariance / np.outer(own, own), self.disturbed)
        beyond = np.where(speaks, self.from_flights * (allowed**2 - 1.0), 0.0)
        return np.asarray(np.sqrt(variance + beyond))


def _positive(matrix: Array, inverse: Array) -> Array:
    """Return a covariance (K, K) whose variances are positive.

    What learnt strengths take is no noise and counts as negative in the sandwich. Where it takes
    all that small residuals leave, residuals are as large as assumed.
    """
    left = np.diag(matrix) > LEAST * np.diag(inverse)
    return np.where(np.outer(left, left), matrix, inverse)


def _disturbed(information: FisherInformation, inverse: Array, from_flights: Array) -> Array:
    """Return how disturbed what determines each coefficient (K,) is, over independent residuals.

    What each channel says of each block of time would move the estimates by so much, each by
    itself: squares are summed up over what is expected of them. Correlation in time and between
    channels is not in it, which is what the stretches are for; but each block of each channel is a
    degree of freedom, and there are many. Of what a block alone determines, the fit leaves nothing
    to be seen: so much of the expectation as it took out counts as disturbed like the rest.
    """
    scores = information.score - information.blocks @ (inverse @ information.slope)
    seen = np.square(scores @ inverse).sum(axis=(0, 1, 2))
    follow = information.blocks @ inverse
    taken = np.einsum(
        "cf,cfbpk,pq,cfbqk->k", information.spread, follow, inverse, follow, optimize=True
    )
    speaks = from_flights > ROUNDING * np.diag(inverse)
    share = np.clip(1.0 - taken / np.where(speaks, from_flights, np.inf), 0.0, 1.0) * speaks
    expected = np.where(share > 0.0, share * from_flights, 1.0)
    log_ratio = np.log(np.maximum(seen / expected, LEAST))
    told = share / (share + HARDLY)
    centre = told @ log_ratio / max(told.sum(), LEAST)
    return np.asarray(np.exp(told * (log_ratio - centre)))
