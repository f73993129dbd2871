"""Inverses of information that spans many powers of ten."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

ROUNDING = 1e-12
"""Share of the largest eigenvalue, at unit diagonal, below which information is rounding error."""


@dataclass(frozen=True)
class Inverse:
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
    def of(matrix: Array, prior: Array) -> Inverse:
        """Return the inverse of information (K, K), of which ``prior`` is no sum over flights."""
        unit = 1.0 / np.sqrt(np.diag(matrix))
        scale = np.outer(unit, unit)
        values, vectors = np.linalg.eigh(matrix * scale)
        along = np.einsum("pk,pq,qk->k", vectors, prior * scale, vectors, optimize=True)
        rounded = values < ROUNDING * values.max()
        values = np.where(rounded, np.maximum(along, 1e-30 * values.max()), values)
        return Inverse(unit, values, vectors, rounded)

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
