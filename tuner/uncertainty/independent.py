"""What errors would be were residuals independent, and how much wider they are seen to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.uncertainty.information import FisherInformation
from tuner.uncertainty.inverse import Inverse
from tuner.uncertainty.overdispersion import allowed_for

Array = NDArray[np.float64]

ROUNDING = 1e-9
"""Share of a variance that the flights must have in it to say anything of it."""


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
    """

    inverse: Inverse
    matrix: Array
    from_flights: Array

    @staticmethod
    def of(information: FisherInformation) -> IndependentErrors:
        """Return the errors of a fit."""
        inverse = Inverse.of(information.total, information.given)
        white = np.einsum("cf,cfbpq->pq", information.spread, information.blocks)
        from_flights = np.diag(inverse.sandwiched(white, np.zeros_like(white)))
        return IndependentErrors(
            inverse, inverse.sandwiched(white, information.given), from_flights
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
        allowed = allowed_for(ratio, freedom, covariance / np.outer(own, own))
        beyond = np.where(speaks, self.from_flights * (allowed**2 - 1.0), 0.0)
        return np.asarray(np.sqrt(variance + beyond))
