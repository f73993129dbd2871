"""The covariance of a Kalman filter of one segment, row by row, for loops of compiled kernels.

It is propagated column by column through the loop's own derivative: F P Fᵀ takes twice as many
steps of the linearised loop as the state has numbers, many times fewer operations than matrix
products. The m samples of a tick, whose noise is independent, are processed one after the other
(Anderson and Moore, "Optimal filtering", 1979, 6.4), which is the Cholesky factorisation of their
covariance, row by row; their information is subtracted as the covariance is propagated. It is made
symmetric now and then: with an unstable vehicle rounding errors between its halves, which no sample
corrects, would grow until variances are negative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lanes import dependent

SYMMETRISED_EVERY = 16
"""Ticks after which the covariance is made symmetric again."""
ROW_BLOCK = 16
"""Numbers of a row that are summed in registers at a time."""


class SparseMatrix(NamedTuple):
    """A sparse matrix.

    Attributes
    ----------
    rows
        Each row's columns that are not zero.
    groups
        Group of each column: no two of a group have a common row.
    values
        (groups, rows) each row's value in its column of a group.
    """

    rows: tuple[tuple[int, ...], ...]
    groups: tuple[int, ...]
    values: Array

    @staticmethod
    def of(push: Callable[[list[Array]], list[Array]], columns: int) -> SparseMatrix:
        """Return the matrix of a linear map of ``columns`` numbers, given one by one, to vectors.

        A group of columns is evaluated at once: Curtis, Powell and Reid, "On the estimation of
        sparse Jacobian matrices", 1974.
        """
        closed = jax.make_jaxpr(push)([jnp.zeros(())] * columns)
        found = dependent(closed.jaxpr, [1 << number for number in range(columns)])
        lengths = [var.aval.shape[0] for var in closed.jaxpr.outvars]
        masks = np.repeat(found, lengths).tolist()
        rows = tuple(tuple(k for k in range(columns) if mask >> k & 1) for mask in masks)
        groups, taken = [], list[int]()
        for column in range(columns):
            met = sum(1 << i for i, row in enumerate(rows) if column in row)
            group = next((g for g, others in enumerate(taken) if not others & met), len(taken))
            taken[group : group + 1] = [met | (taken[group] if group < len(taken) else 0)]
            groups.append(group)

        def pushed(group: Array) -> Array:
            unit = jnp.where(np.array(groups) == group, 1.0, 0.0)
            return jnp.concatenate(push([unit[number] for number in range(columns)]))

        values = lax.scan(lambda _, group: (None, pushed(group)), None, jnp.arange(len(taken)))[1]
        return SparseMatrix(rows, tuple(groups), values)


class Samples(NamedTuple):
    """The m samples of a tick.

    Attributes
    ----------
    error, variance
        (m,) their errors and the variances of their noise.
    derivatives
        (m, s) errors' derivatives by the first s numbers of the state.
    order, used
        Function from a number below ``used`` to the row of a sample that some lane has.
    """

    error: Array
    variance: Array
    derivatives: SparseMatrix
    order: Callable[[Array], Array]
    used: Array


class Innovations(NamedTuple):
    """The innovations of a tick's samples.

    Attributes
    ----------
    table
        (m, m + 2): the triangular root of their covariance, the whitened innovations, and the
        variances of noise.
    gain
        (m, n) corrections for one standard deviation of each; those of skipped samples are of an
        earlier tick.
    """

    table: Array
    gain: Array

    @property
    def factors(self) -> Array:
        """The triangular root (m, m)."""
        return self.table[:, :-2]

    @property
    def white(self) -> Array:
        """The whitened innovations (m,)."""
        return self.table[:, -2]

    def corrections(self, samples: Samples, weights: Array) -> Array:
        """Return the sum (n,) of the samples' gains, each times its weight (m,)."""
        wide, size = self.gain.shape
        # in memory, where a loop reads them by number
        table = lax.dynamic_update_slice(self.table, weights[:, None], (0, wide + 1))

        def total(first: int, count: int) -> Array:
            def add(number: Array, so_far: Array) -> Array:
                i = samples.order(number)
                return so_far + _entry(table, i, wide + 1) * _part(self.gain, i, first, count)

            found: Array = lax.fori_loop(0, samples.used, add, jnp.zeros(count))
            return found

        return jnp.concatenate([total(*part) for part in _side_by_side(size)])


def innovations_of(covariance: Array, gain: Array, samples: Samples) -> Innovations:
    """Return the innovations of samples for a state's covariance; ``gain`` is overwritten."""
    wide, size = gain.shape
    most = max(map(len, samples.derivatives.rows))
    # count of each row's nonzero columns, the columns, and their groups
    known = [
        [len(row), *row, *[0] * (most - len(row)), *(samples.derivatives.groups[k] for k in row)]
        for row in samples.derivatives.rows
    ]
    places = jnp.asarray(np.array([row + [0] * (2 * most + 1 - len(row)) for row in known]))

    def by_state(i: Array, of: Callable[[Array, Array], Array], start: Array) -> Array:
        """Sum a function of each derivative of a sample and its place in the state."""

        def add(number: Array, total: Array) -> Array:
            place, group = _entry(places, i, number + 1), _entry(places, i, number + 1 + most)
            return total + of(_entry(samples.derivatives.values, group, i), place)

        total: Array = lax.fori_loop(0, _entry(places, i, 0), add, start)
        return total

    def take(number: Array, update: Innovations) -> Innovations:
        table, gain = update
        i = samples.order(number)

        def factor(earlier: Array, table: Array) -> Array:
            j = samples.order(earlier)
            own = by_state(i, lambda along, place: along * _entry(gain, j, place), jnp.zeros(()))
            table = _with_entry(table, i, j, own)
            return _with_entry(
                table, i, wide, _entry(table, i, wide) - own * _entry(table, j, wide)
            )

        table = lax.fori_loop(0, number, factor, table)

        def unexplained(first: int, count: int) -> Array:
            def covary(along: Array, place: Array) -> Array:
                return along * _part(covariance, place, first, count)

            def less(earlier: Array, rest: Array) -> Array:
                j = samples.order(earlier)
                return rest - _entry(table, i, j) * _part(gain, j, first, count)

            rest: Array = lax.fori_loop(0, number, less, by_state(i, covary, jnp.zeros(count)))
            return rest

        own = jnp.concatenate([unexplained(*part) for part in _side_by_side(size)])
        noise = _entry(table, i, wide + 1)
        root = jnp.sqrt(by_state(i, lambda along, place: along * at(own, place), noise))
        table = _with_entry(table, i, i, root)
        table = _with_entry(table, i, wide, _entry(table, i, wide) / root)
        return Innovations(table, _with_row(gain, i, own / root))

    unit = jnp.where(jnp.arange(wide)[:, None] == jnp.arange(wide), 1.0, 0.0)
    table = jnp.concatenate([unit, samples.error[:, None], samples.variance[:, None]], axis=1)
    update: Innovations = lax.fori_loop(0, samples.used, take, Innovations(table, gain))
    return update


def propagated(
    covariance: Array,
    update: Innovations,
    samples: Samples,
    transition: Callable[[Array], Array],
    process_noise: Array,
    *,
    retention: Array,
    tick: Array,
) -> Array:
    """Return the covariance a tick later, F (P - W Wᵀ) Fᵀ + Q.

    Parameters
    ----------
    covariance
        P (n, n), overwritten.
    update, samples
        Their gains are W.
    transition, process_noise
        The first rows of F, as a function of a column, and the diagonal (n,) of Q.
    retention
        (D,) factors of F on the last numbers of the state, the disturbances.
    tick
        Its number.
    """
    size, disturbances = len(covariance), len(retention)
    others = size - disturbances

    def corrected(j: Array, into: Array) -> Array:
        def known_better(first: int, count: int) -> Array:
            def less(number: Array, rest: Array) -> Array:
                i = samples.order(number)
                return rest - _entry(update.gain, i, j) * _part(update.gain, i, first, count)

            rest: Array = lax.fori_loop(0, samples.used, less, _part(into, j, first, count))
            return rest

        rest = [known_better(*part) for part in _side_by_side(size)]
        return _with_row(into, j, jnp.concatenate(rest))

    covariance = lax.fori_loop(0, size, corrected, covariance)

    def pushed(_: None, row: Array) -> tuple[None, Array]:
        return None, transition(row)

    half = lax.scan(pushed, None, covariance)[1]
    whole = lax.scan(pushed, None, half.T)[1]

    def of_disturbance(number: Array, into: Array) -> Array:
        i = number + others
        among = retention * _part(into, i, others, disturbances)
        row = jnp.concatenate([_part(half, i, 0, others), among])
        return _with_row(into, i, at(retention, number) * row)

    def of_state(i: Array, into: Array) -> Array:
        across = lax.dynamic_slice(into, (others, i), (disturbances, 1))[:, 0]
        return _with_row(into, i, jnp.concatenate([_part(whole, i, 0, others), across]))

    def added(i: Array, matrix: Array) -> Array:
        return _with_entry(matrix, i, i, _entry(matrix, i, i) + at(process_noise, i))

    covariance = lax.fori_loop(0, disturbances, of_disturbance, covariance)
    covariance = lax.fori_loop(0, others, of_state, covariance)
    covariance = lax.fori_loop(0, size, added, covariance)
    return _symmetric(covariance, jnp.where(tick % SYMMETRISED_EVERY == 0, size, 0))


def _symmetric(matrix: Array, count: Array) -> Array:
    """Return a square matrix with its first ``count`` rows and columns made symmetric."""

    def mean(i: Array, matrix: Array) -> Array:
        both = 0.5 * (_part(matrix, i, 0, len(matrix)) + _column(matrix, i))
        return lax.dynamic_update_slice(_with_row(matrix, i, both), both[:, None], (0, i))

    found: Array = lax.fori_loop(0, count, mean, matrix)
    return found


def at(vector: Array, number: Array) -> Array:
    """Return one number of a vector."""
    one: Array = lax.dynamic_index_in_dim(vector, number, 0, keepdims=False)
    return one


def _side_by_side(size: int) -> list[tuple[int, int]]:
    """Return begin and length of each part of a row."""
    return [(first, min(ROW_BLOCK, size - first)) for first in range(0, size, ROW_BLOCK)]


def _part(matrix: Array, number: Array, first: int, count: int) -> Array:
    """Return so many numbers of a row from the first on."""
    return lax.dynamic_slice(matrix, (number, first), (1, count))[0]


def _column(matrix: Array, number: Array) -> Array:
    return lax.dynamic_slice(matrix, (0, number), (len(matrix), 1))[:, 0]


def _entry(matrix: Array, i: Array, j: Array | int) -> Array:
    return lax.dynamic_slice(matrix, (i, j), (1, 1))[0, 0]


def _with_entry(matrix: Array, i: Array, j: Array | int, number: Array) -> Array:
    return lax.dynamic_update_slice(matrix, number[None, None], (i, j))


def _with_row(matrix: Array, number: Array, row: Array) -> Array:
    return lax.dynamic_update_slice(matrix, row[None], (number, 0))
