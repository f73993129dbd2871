"""The covariance of a Kalman filter of one segment, row by row: what kernels compute in loops.

Propagated column by column, through the loop's own derivative: F P Fᵀ takes twice as many steps of
the linearised loop as the state has numbers, where products of matrices would take many times the
operations. The m samples of a tick, whose noise is independent, are taken one after the other
(Anderson and Moore, "Optimal filtering", 1979, 6.4), which is the Cholesky factorisation of their
covariance, row by row.
"""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array, lax

Matrices = tuple[Array, Array]
_Carried = tuple[Array, Array, Array]


def updated(
    matrices: Matrices, samples: tuple[Array, Array, Array], sampled: Array
) -> tuple[Matrices, tuple[Array, Array]]:
    """Return covariance and gains after the samples of a tick, and their innovations.

    Parameters
    ----------
    matrices
        The covariance (n, n) before them, and the gains (m, n), which are written over.
    samples
        Errors (m,), their derivatives (s, m) by the first s numbers of the state, and the variances
        (m,) of the samples' noise.
    sampled
        (m,) of which there are samples in any lane; the others are skipped.

    Returns
    -------
    tuple
        Covariance and gains for one standard deviation of each whitened innovation; the whitened
        innovations (m,) and the factor L (m, m) of their covariance.
    """
    error, seen, variance = samples
    (size, _), (shown, wide) = matrices[0].shape, seen.shape

    def taken(carried: _Carried, i: Array) -> tuple[_Carried, Matrices]:
        covariance, gain, moved = carried
        along = lax.dynamic_slice(seen, (0, i), (shown, 1))[:, 0]
        spread = rows_of(lambda r: row(covariance, r, shown) @ along, size)
        root = jnp.sqrt(spread[:shown] @ along + at(variance, i))
        white = (at(error, i) + along @ moved[:shown]) / root
        own = spread / root

        def of_others(j: Array) -> Array:
            return jnp.where(j < i, row(gain, j, shown) @ along, jnp.where(j == i, root, 0.0))

        def less(r: Array, matrix: Array) -> Array:
            return _with_row(matrix, r, row(matrix, r, size) - at(own, r) * own)

        factor = rows_of(of_others, wide)
        covariance = lax.fori_loop(0, size, less, covariance)
        return (covariance, _with_row(gain, i, own), moved - own * white), (white, factor)

    def missing(carried: _Carried, i: Array) -> tuple[_Carried, Matrices]:
        covariance, gain, moved = carried
        unit = jnp.where(jnp.arange(wide) == i, 1.0, 0.0)
        return (covariance, _with_row(gain, i, jnp.zeros(size)), moved), (jnp.zeros(()), unit)

    def either(carried: _Carried, i: Array) -> tuple[_Carried, Matrices]:
        found: tuple[_Carried, Matrices] = lax.cond(at(sampled, i), taken, missing, carried, i)
        return found

    (covariance, gain, _), innovations = lax.scan(
        either, (*matrices, jnp.zeros(size)), jnp.arange(wide)
    )
    return (covariance, gain), innovations


def propagated(
    covariance: Array, scratch: Array, follow: Callable[[Array], Array], unrest: Array
) -> Matrices:
    """Return F P Fᵀ + Q, of a linear map F that is given as a function of a column.

    ``unrest`` (n,) is the diagonal of Q; ``scratch`` (n, n) is written over, and returned.
    """
    size = len(unrest)

    def turned(matrix: Array, into: Array) -> Array:
        """Return (F matrix)ᵀ, written over another matrix."""

        def one(i: Array, into: Array) -> Array:
            column = follow(lax.dynamic_slice(matrix, (0, i), (size, 1))[:, 0])
            return _with_row(into, i, column)

        written: Array = lax.fori_loop(0, size, one, into)
        return written

    def added(i: Array, matrix: Array) -> Array:
        number: Array = lax.dynamic_slice(matrix, (i, i), (1, 1)) + at(unrest, i)
        return lax.dynamic_update_slice(matrix, number, (i, i))

    scratch = turned(covariance, scratch)
    covariance = turned(scratch, covariance)
    return lax.fori_loop(0, size, added, covariance), scratch


def weighted(matrix: Array, weights: Array) -> Array:
    """Return the sum of a matrix's rows, each times its weight."""
    rows, columns = matrix.shape

    def add(i: Array, total: Array) -> Array:
        return total + at(weights, i) * row(matrix, i, columns)

    total: Array = lax.fori_loop(0, rows, add, jnp.zeros(columns))
    return total


def rows_of(function: Callable[[Array], Array], count: int) -> Array:
    """Return the rows that a function gives for each number, computed in a loop."""
    rows: Array = lax.scan(lambda _, i: (None, function(i)), None, jnp.arange(count))[1]
    return rows


def row(matrix: Array, number: Array, count: int) -> Array:
    """Return the first numbers of a row."""
    return lax.dynamic_slice(matrix, (number, 0), (1, count))[0]


def at(vector: Array, number: Array) -> Array:
    """Return one number of a vector."""
    one: Array = lax.dynamic_index_in_dim(vector, number, 0, keepdims=False)
    return one


def _with_row(matrix: Array, number: Array, row: Array) -> Array:
    return lax.dynamic_update_slice(matrix, row[None], (number, 0))
