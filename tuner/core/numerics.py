"""Mathematics that many rooms need once: solves that always have an answer, robust statistics.

Information about coefficients spans many powers of ten, and flights may leave a coefficient or a
combination of them unknown. So every matrix is scaled to a unit diagonal before it is factorised,
and a direction of which it says less than rounding errors counts as known to `ROUNDING`: its
variance is large, and finite.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

Z95 = 1.959963984540054
"""Standard deviations of a normal distribution that a 95 % interval reaches to either side: its
quantile at 0.975. (`scipy.special` takes a third of the time in which `tune inspect` answers.)"""
MAD_TO_SD = 1.4826
"""Standard deviations of a normal distribution in its median absolute deviation."""
ROUNDING = 1e-12
"""Share of the largest eigenvalue, at unit diagonal, below which information is rounding error."""
MIN_EIGENVALUE_SHARE = 1e-24
"""Likewise, what a direction that nothing is known of counts as known to: its variance is larger
than any other, and what rounding errors mix of it into other coefficients is not seen in theirs."""
MIN_KNOWN_SHARE = 1e-6
"""Share of a coefficient in unknown directions from which it is unknown."""


def finite_rows(values: Array) -> NDArray[np.bool_]:
    """Return in which rows of (n, k) values all are finite, a tenth of `all(axis=1)`'s time."""
    columns = np.isfinite(values).T
    return functools.reduce(np.logical_and, columns, np.ones(len(values), dtype=bool))


def robust_sd(values: ArrayLike) -> Array:
    """Return a robust standard deviation about zero: that of the median absolute value."""
    return np.asarray(MAD_TO_SD * np.median(np.abs(values)))


def student_factor(freedom: int) -> float:
    """Return the factor by which few degrees of freedom widen a 95 % interval (Student's t)."""
    from scipy.special import stdtrit  # noqa: PLC0415 (scipy.stats takes a second to import)

    return float(stdtrit(max(freedom, 1), 0.975) / Z95)


def huber_weights(error: Array, limit: float) -> Array:
    """Return Huber's weights: 1 up to a limit of the scaled error, then falling as its inverse."""
    return np.asarray(1.0 / np.maximum(1.0, np.abs(error) / limit))


def unit_diagonal(matrix: Array) -> Array:
    """Return (K,) by which rows and columns (K, K) are multiplied for a unit diagonal.

    Where rounding errors made the diagonal negative it becomes minus one, and zero stays zero.
    """
    diagonal = np.abs(np.diag(matrix))
    return np.asarray(1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)))


def symmetric_eigen(matrix: Array) -> tuple[Array, Array]:
    """Return ascending eigenvalues (..., K) and eigenvectors (..., K, K) of symmetric matrices.

    Raises
    ------
    numpy.linalg.LinAlgError
        A number is not finite.
    """
    if not np.isfinite(matrix).all():
        raise np.linalg.LinAlgError("the information holds numbers that are not finite")
    symmetric = 0.5 * (matrix + np.swapaxes(matrix, -1, -2))
    try:
        values, vectors = np.linalg.eigh(symmetric)
    except np.linalg.LinAlgError:  # divide and conquer may fail where the QR iteration does not
        if symmetric.ndim > 2:
            pairs = [symmetric_eigen(each) for each in symmetric]
            return np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])
        from scipy import linalg  # noqa: PLC0415 (slow to import, seldom needed)

        values, vectors = linalg.eigh(symmetric, driver="ev")
    return np.asarray(values), np.asarray(vectors)


def scaled_root(matrix: Array, ridge: float = 0.0) -> tuple[Array, Array]:
    """Return F (K, K) and s (K,): F Fᵀ is the matrix times s sᵀ, plus a ridge.

    F is Cholesky's lower triangle where that exists, else made of the eigenvalues that rounding
    errors left above zero.

    Parameters
    ----------
    matrix
        (K, K) positive semidefinite, but for rounding errors.
    ridge
        What is added to the unit diagonal.
    """
    unit = unit_diagonal(matrix)
    scaled = matrix * np.outer(unit, unit) + ridge * np.eye(len(matrix))
    try:
        return np.asarray(np.linalg.cholesky(scaled)), unit
    except np.linalg.LinAlgError:
        values, vectors = symmetric_eigen(scaled)
        least = ROUNDING * max(float(values.max(initial=0.0)), 1.0)
        return np.asarray(vectors * np.sqrt(np.maximum(values, least))), unit


def scaled_solve(matrix: Array, right: Array, ridge: float = 0.0) -> Array:
    """Return the solution (K, ...) of a positive semidefinite system; see `scaled_root`."""
    if not len(matrix):
        return np.asarray(right, float)
    factor, unit = scaled_root(matrix, ridge)
    by = unit.reshape(-1, *[1] * (np.ndim(right) - 1))
    inverse = np.linalg.inv(factor)
    return np.asarray(by * (inverse.T @ (inverse @ (by * right))))


def scaled_inverse(matrix: Array, ridge: float = 0.0) -> Array:
    """Return the inverse (K, K) of a positive semidefinite matrix; see `scaled_root`."""
    return scaled_solve(matrix, np.eye(len(matrix)), ridge)


def std_errors_of(information: Array) -> Array:
    """Return the standard errors (K,) that an information (K, K) leaves."""
    return np.asarray(np.sqrt(np.diag(scaled_inverse(information))))


def log_determinant(matrix: Array) -> float:
    """Return the logarithm of a positive semidefinite matrix's determinant; see `scaled_root`."""
    factor, unit = scaled_root(matrix)
    return float(np.linalg.slogdet(factor @ factor.T)[1] - 2.0 * np.log(unit).sum())


@dataclass(frozen=True)
class Inverse:
    """The inverse of information that flights and a prior make up.

    Attributes
    ----------
    unit
        (K,) that scales the matrix to a unit diagonal.
    values, vectors
        (K,) and (K, K) eigenvalues and eigenvectors of the scaled matrix.
    rounded
        (K,) along which of them the flights only leave rounding errors. However much they know of
        the rest, the rounding errors of that are no knowledge: the prior alone counts there.
    unknown
        (K,) along which of them the prior says nothing either.
    """

    unit: Array
    values: Array
    vectors: Array
    rounded: NDArray[np.bool_]
    unknown: NDArray[np.bool_]

    @staticmethod
    def of(matrix: Array, prior: Array) -> Inverse:
        """Return the inverse of information (K, K), of which ``prior`` is no sum over flights."""
        unit = unit_diagonal(matrix)
        scale = np.outer(unit, unit)
        values, vectors = symmetric_eigen(matrix * scale)
        along = np.einsum("pk,pq,qk->k", vectors, prior * scale, vectors, optimize=True)
        largest = max(float(values.max(initial=0.0)), 1.0)
        rounded, nothing = values < ROUNDING * largest, MIN_EIGENVALUE_SHARE * largest
        values = np.where(rounded, np.maximum(along, nothing), values)
        return Inverse(unit, values, vectors, rounded, rounded & (along <= nothing))

    @property
    def known(self) -> NDArray[np.bool_]:
        """(K,) whether flights and prior determine it, all but rounding errors of it."""
        return np.asarray((self.vectors[:, self.unknown] ** 2).sum(axis=1) < MIN_KNOWN_SHARE)

    @property
    def matrix(self) -> Array:
        """The inverse (K, K)."""
        scale = np.outer(self.unit, self.unit)
        return np.asarray((self.vectors / self.values) @ self.vectors.T * scale)

    @property
    def open(self) -> Array:
        """The part (K, K) of the inverse along directions that flights leave to the prior."""
        vectors = self.vectors[:, self.rounded] * self.unit[:, None]
        return np.asarray((vectors / self.values[self.rounded]) @ vectors.T)

    def sandwiched(self, meat: Array, priors: Array) -> Array:
        """Return H⁻¹ (meat + priors) H⁻¹, the flights' meat without rounding errors."""
        scale = np.outer(self.unit, self.unit)
        from_flights = self.vectors.T @ (meat * scale) @ self.vectors
        from_flights[self.rounded] = 0.0
        from_flights[:, self.rounded] = 0.0
        inside = from_flights + self.vectors.T @ (priors * scale) @ self.vectors
        divided = inside / np.outer(self.values, self.values)
        return np.asarray(self.vectors @ divided @ self.vectors.T * scale)
