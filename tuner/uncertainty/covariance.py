"""How uncertain the fitted coefficients are, residuals that are not white noise included."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.uncertainty.information import FisherInformation

Array = NDArray[np.float64]

WIDE = 100.0
"""Factor on the priors' widths that leaves practically the information of the flights alone."""
ROUNDING = 1e-12
"""Share of the largest eigenvalue, at unit diagonal, below which information is rounding error."""
MAX_LEVERAGE = 0.95
"""Leverage of a stretch of time on the fit beyond which its score is corrected no further."""


@dataclass(frozen=True)
class Covariance:
    """Covariance of the K estimates, in the scaled coordinates.

    Attributes
    ----------
    matrix
        (K, K), flights and priors together, inflated where residuals are correlated in time.
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

    @property
    def error(self) -> Array:
        """Standard errors (K,)."""
        return np.asarray(np.sqrt(np.diag(self.matrix)))

    @property
    def data_error(self) -> Array:
        """Standard errors (K,) from the flights alone."""
        return np.asarray(np.sqrt(np.diag(self.data_only)))

    @property
    def correlation(self) -> Array:
        """Correlation matrix (K, K)."""
        return np.asarray(self.matrix / np.outer(self.error, self.error))


def covariance_of(information: FisherInformation) -> Covariance:
    """Return the covariance of a fit.

    With independent residuals the covariance is H⁻¹ B H⁻¹, B each channel's information times its
    residuals' mean square. Model error is no white noise: stretches of a few seconds are summed up
    and their scores' spread takes the place of B (the sandwich estimate), each score corrected for
    the stretch's own leverage on the fit as in Bell and McCaffrey, "Bias reduction in standard
    errors for linear regression with multi-stage samples", 2002. Few stretches make that estimate
    erratic: it may widen an interval but never narrow it, and one standard deviation of what chance
    does to white noise is taken off first.
    """
    total = information.total
    unit = 1.0 / np.sqrt(np.diag(total))
    priors = information.prior + information.nuisance_prior
    if information.ground is not None:  # its noise is as large as it says
        priors = priors + information.ground
    inverse = _Inverse.of(total, unit, priors)
    white = np.einsum("cf,cfbpq->pq", information.spread, information.blocks)
    independent = inverse.sandwiched(white, priors)
    clustered = inverse.sandwiched(_score_products(information, unit), priors)
    ratio = np.diag(clustered) / np.diag(independent) - np.sqrt(
        2.0 / _effective_stretches(information, inverse.matrix)
    )
    inflation = np.sqrt(np.maximum(ratio, 1.0))
    data = information.data + information.prior / WIDE**2
    data_inverse = _Inverse.of(
        data, 1.0 / np.sqrt(np.diag(data)), information.prior / WIDE**2
    ).matrix
    matrix = independent * np.outer(inflation, inflation)
    beyond_noise = np.sqrt(np.diag(matrix) / np.diag(inverse.matrix))
    return Covariance(
        matrix=matrix,
        data_only=data_inverse * np.outer(beyond_noise, beyond_noise),
        inflation=inflation,
        beyond_noise=beyond_noise,
    )


def _effective_stretches(information: FisherInformation, inverse: Array) -> Array:
    """Return the number (K,) of stretches with equal information that each parameter amounts to."""
    along = inverse / np.diag(inverse)
    by_stretch = np.einsum("pk,clbpq,qk->lbk", along, information.blocks, along, optimize=True)
    by_stretch = by_stretch.reshape(-1, len(inverse))
    squares = np.maximum((by_stretch**2).sum(axis=0), 1e-300)
    return np.asarray(np.maximum(by_stretch.sum(axis=0) ** 2 / squares, 1.0))


@dataclass(frozen=True)
class _Inverse:
    """The inverse of a positive definite matrix whose diagonal spans many powers of ten.

    Attributes
    ----------
    unit
        (K,) that scales the matrix to a unit diagonal.
    values, vectors
        (K,) and (K, K) eigenvalues and eigenvectors of the scaled matrix.
    rounded
        (K,) along which of them the flights only leave rounding errors. However much they know of
        the rest, the rounding errors of that are no knowledge: the prior alone counts there.
    """

    unit: Array
    values: Array
    vectors: Array
    rounded: NDArray[np.bool_]

    @staticmethod
    def of(matrix: Array, unit: Array, prior: Array) -> _Inverse:
        """Return the inverse of information (K, K), of which ``prior`` is no sum over flights."""
        scale = np.outer(unit, unit)
        values, vectors = np.linalg.eigh(matrix * scale)
        along = np.einsum("pk,pq,qk->k", vectors, prior * scale, vectors, optimize=True)
        rounded = values < ROUNDING * values.max()
        values = np.where(rounded, np.maximum(along, 1e-30 * values.max()), values)
        return _Inverse(unit, values, vectors, rounded)

    @property
    def matrix(self) -> Array:
        """The inverse (K, K)."""
        scale = np.outer(self.unit, self.unit)
        return np.asarray((self.vectors / self.values) @ self.vectors.T * scale)

    def sandwiched(self, meat: Array, priors: Array) -> Array:
        """Return H⁻¹ (meat + priors) H⁻¹, the flights' meat without rounding errors."""
        scale = np.outer(self.unit, self.unit)
        from_flights = self.vectors.T @ (meat * scale) @ self.vectors
        from_flights[self.rounded] = 0.0
        from_flights[:, self.rounded] = 0.0
        inside = from_flights + self.vectors.T @ (priors * scale) @ self.vectors
        divided = inside / np.outer(self.values, self.values)
        return np.asarray(self.vectors @ divided @ self.vectors.T * scale)


def _score_products(information: FisherInformation, unit: Array) -> Array:
    """Return the sum (K, K) over stretches of the corrected scores' outer products, the "meat"."""
    total = information.total * np.outer(unit, unit)
    factor = np.linalg.cholesky(total + 1e-13 * np.eye(len(total)))
    blocks = information.blocks.sum(axis=0) * np.outer(unit, unit)
    score = information.score.sum(axis=0) * unit
    products = np.zeros_like(total)
    for segment in range(score.shape[0]):
        for block in range(score.shape[1]):
            if not np.any(blocks[segment, block]):
                continue
            leverage = np.linalg.solve(factor, blocks[segment, block])
            leverage = np.linalg.solve(factor, leverage.T)
            values, vectors = np.linalg.eigh(0.5 * (leverage + leverage.T))
            remaining = np.sqrt(1.0 - np.clip(values, 0.0, MAX_LEVERAGE))
            whitened = vectors @ (
                (vectors.T @ np.linalg.solve(factor, score[segment, block])) / remaining
            )
            corrected = factor @ whitened
            products += np.outer(corrected, corrected)
    return np.asarray(products / np.outer(unit, unit))
