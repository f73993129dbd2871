"""The covariance of a Kalman filter of one segment, row by row: what kernels compute in loops.

Propagated column by column, through the loop's own derivative: F P Fᵀ takes twice as many steps of
the linearised loop as the state has numbers, where products of matrices would take many times the
operations. The m samples of a tick, whose noise is independent, are taken one after the other
(Anderson and Moore, "Optimal filtering", 1979, 6.4), which is the Cholesky factorisation of their
covariance, row by row; what all of them tell is taken off the covariance as it is propagated.
It is made symmetric now and then: no sample corrects a difference between its halves, which an
unstable vehicle lets grow from rounding errors until variances are negative.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from lanes import dependent

MADE_SYMMETRIC = 16
"""Ticks after which the covariance is made symmetric again."""
BESIDE = 16
"""Numbers of a row that stay in registers while others are added to them."""


class Sparse(NamedTuple):
    """A sparse matrix.

    Attributes
    ----------
    rows
        Each row's columns that are not zero.
    groups
        Of each column: those of one group meet in no row.
    values
        (groups, rows) each row's number in the column of a group that it has.
    """

    rows: tuple[tuple[int, ...], ...]
    groups: tuple[int, ...]
    values: Array

    @staticmethod
    def of(push: Callable[[list[Array]], list[Array]], columns: int) -> Sparse:
        """Return the matrix of a linear map of so many numbers, given each by itself, to vectors.

        A group of columns is pushed at once: Curtis, Powell and Reid, "On the estimation of sparse
        Jacobian matrices", 1974.
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

        return Sparse(rows, tuple(groups), rows_of(pushed, len(taken)))


class Samples(NamedTuple):
    """The m samples of a tick.

    Attributes
    ----------
    error, variance
        (m,) their errors and the variances of their noise.
    seen
        (m, s) errors' derivatives by the first s numbers of the state.
    order, many
        Which there are in any lane, by a number below ``many``: others are skipped.
    """

    error: Array
    variance: Array
    seen: Sparse
    order: Callable[[Array], Array]
    many: Array


class Innovations(NamedTuple):
    """What the samples of a tick tell.

    Attributes
    ----------
    table
        (m, m + 2): the triangular root of their covariance, innovations that it whitens, and the
        variances of noise.
    gain
        (m, n) corrections for one standard deviation of each; of samples that were skipped those of
        a tick before.
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
        """Return the sum (n,) of the gains of what was sampled, each times its weight (m,)."""
        wide, size = self.gain.shape
        # in memory, where a loop reads them by number
        table = lax.dynamic_update_slice(self.table, weights[:, None], (0, wide + 1))

        def total(first: int, count: int) -> Array:
            def add(number: Array, so_far: Array) -> Array:
                i = samples.order(number)
                return so_far + _entry(table, i, wide + 1) * _part(self.gain, i, first, count)

            found: Array = lax.fori_loop(0, samples.many, add, jnp.zeros(count))
            return found

        return jnp.concatenate([total(*part) for part in _side_by_side(size)])


def innovations_of(covariance: Array, gain: Array, samples: Samples) -> Innovations:
    """Return what samples tell of a state (n,) of known covariance; ``gain`` is written over."""
    wide, size = gain.shape
    most = max(map(len, samples.seen.rows))
    # how many columns of each row are not zero, which, and of which group
    known = [
        [len(row), *row, *[0] * (most - len(row)), *(samples.seen.groups[k] for k in row)]
        for row in samples.seen.rows
    ]
    places = jnp.asarray(np.array([row + [0] * (2 * most + 1 - len(row)) for row in known]))

    def by_state(i: Array, of: Callable[[Array, Array], Array], start: Array) -> Array:
        """Add up what is made of each derivative of a sample and its place in the state."""

        def add(number: Array, total: Array) -> Array:
            place, group = _entry(places, i, number + 1), _entry(places, i, number + 1 + most)
            return total + of(_entry(samples.seen.values, group, i), place)

        total: Array = lax.fori_loop(0, _entry(places, i, 0), add, start)
        return total

    def take(number: Array, told: Innovations) -> Innovations:
        table, gain = told
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
    told: Innovations = lax.fori_loop(0, samples.many, take, Innovations(table, gain))
    return told


def propagated(
    matrices: tuple[Array, Array],
    told: Innovations,
    samples: Samples,
    follow: Callable[[Array], Array],
    unrest: Array,
    *,
    keeps: Array,
    tick: Array,
) -> tuple[Array, Array]:
    """Return F (P - W Wᵀ) Fᵀ + Q: a tick later, when samples have told what they do.

    Parameters
    ----------
    matrices
        P (n, n), and one of the same size which is written over, as P is; both are returned.
    told, samples
        Whose gains are W.
    follow, unrest
        F, as a function of a column, and the diagonal (n,) of Q.
    keeps
        (D,) the share that each of the last numbers keeps of itself, all that F does to them.
    tick
        Its number.
    """
    covariance, scratch = matrices
    size = len(covariance)

    def known_better(j: Array, first: int, count: int) -> Array:
        def less(number: Array, rest: Array) -> Array:
            i = samples.order(number)
            return rest - _entry(told.gain, i, j) * _part(told.gain, i, first, count)

        rest: Array = lax.fori_loop(0, samples.many, less, _part(covariance, j, first, count))
        return rest

    def first(j: Array, into: Array) -> Array:
        rest = [known_better(j, *part) for part in _side_by_side(size)]
        return _with_row(into, j, follow(jnp.concatenate(rest)))

    scratch = lax.fori_loop(0, size, first, scratch)

    def second(i: Array, into: Array) -> Array:
        return _with_row(into, i, follow(_column(scratch, i)))

    def kept(number: Array, into: Array) -> Array:
        i = number + size - len(keeps)
        return _with_row(into, i, at(keeps, number) * row(scratch, i, size))

    def added(i: Array, matrix: Array) -> Array:
        return _with_entry(matrix, i, i, _entry(matrix, i, i) + at(unrest, i))

    covariance = lax.fori_loop(0, size - len(keeps), second, covariance)
    covariance = lax.fori_loop(0, len(keeps), kept, covariance)
    covariance = lax.fori_loop(0, size, added, covariance)
    return _symmetric(covariance, jnp.where(tick % MADE_SYMMETRIC == 0, size, 0)), scratch


def _symmetric(matrix: Array, count: Array) -> Array:
    """Return a square matrix whose first rows and columns, so many, are the mean of both."""

    def mean(i: Array, matrix: Array) -> Array:
        both = 0.5 * (row(matrix, i, len(matrix)) + _column(matrix, i))
        return lax.dynamic_update_slice(_with_row(matrix, i, both), both[:, None], (0, i))

    found: Array = lax.fori_loop(0, count, mean, matrix)
    return found


def rows_of(function: Callable[[Array], Array], count: int) -> Array:
    """Return the rows that a function gives for each number, computed in a loop."""
    rows: Array = lax.scan(lambda _, i: (None, function(i)), None, jnp.arange(count))[1]
    return rows


def row(matrix: Array, number: Array, count: int) -> Array:
    """Return the first numbers of a row."""
    return _part(matrix, number, 0, count)


def at(vector: Array, number: Array) -> Array:
    """Return one number of a vector."""
    one: Array = lax.dynamic_index_in_dim(vector, number, 0, keepdims=False)
    return one


def _side_by_side(size: int) -> list[tuple[int, int]]:
    """Return where the parts of a row begin, and how long they are."""
    return [(first, min(BESIDE, size - first)) for first in range(0, size, BESIDE)]


def _part(matrix: Array, number: Array, first: int, count: int) -> Array:
    return lax.dynamic_slice(matrix, (number, first), (1, count))[0]


def _column(matrix: Array, number: Array) -> Array:
    return lax.dynamic_slice(matrix, (0, number), (len(matrix), 1))[:, 0]


def _entry(matrix: Array, i: Array, j: Array | int) -> Array:
    return lax.dynamic_slice(matrix, (i, j), (1, 1))[0, 0]


def _with_entry(matrix: Array, i: Array, j: Array | int, number: Array) -> Array:
    return lax.dynamic_update_slice(matrix, number[None, None], (i, j))


def _with_row(matrix: Array, number: Array, row: Array) -> Array:
    return lax.dynamic_update_slice(matrix, row[None], (number, 0))
