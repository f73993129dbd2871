"""The covariance that kernels propagate, against products of matrices."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from scipy.linalg import solve_discrete_are

from tuner.disturbances.covariance import (
    Samples,
    SparseMatrix,
    innovations_of,
    propagated,
)

SIZE, SHOWN, WIDE = 23, 9, 6


def spread(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.standard_normal((size, size))
    return root @ root.T / size


def test_samples_tell_and_time_spreads_what_products_of_matrices_say() -> None:
    rng = np.random.default_rng(0)
    covariance, transition = spread(rng, SIZE), rng.standard_normal((SIZE, SIZE))
    retention = rng.random(3)
    transition[-3:] = np.diag(np.append(np.zeros(SIZE - 3), retention))[-3:]
    derivatives = rng.standard_normal((WIDE, SHOWN)) * (rng.random((WIDE, SHOWN)) < 0.4)
    derivatives[:, 0] = 1.0
    columns = [jnp.asarray(row[np.flatnonzero(row)], float) for row in derivatives]

    def push(change: list) -> list:
        """Return each row's sum of the numbers that it depends on."""
        return [
            sum(c * change[k] for c, k in zip(some, np.flatnonzero(row), strict=True))[None]
            for some, row in zip(columns, derivatives, strict=True)
        ]

    sparse = SparseMatrix.of(push, SHOWN)
    assert [list(row) for row in sparse.rows] == [np.flatnonzero(r).tolist() for r in derivatives]
    error, variance = rng.standard_normal(WIDE), rng.random(WIDE) + 0.1
    weights, process_noise = rng.standard_normal(WIDE), rng.random(SIZE)

    @jax.jit
    def found(order: Array, used: Array) -> tuple[Array, ...]:
        """Return factors, gain, whitened innovations, corrections and the covariance after."""
        samples = Samples(
            jnp.asarray(error), jnp.asarray(variance), sparse, lambda number: order[number], used
        )
        update = innovations_of(jnp.asarray(covariance), jnp.ones((WIDE, SIZE)), samples)
        after = propagated(
            jnp.asarray(covariance),
            update,
            samples,
            lambda column: jnp.asarray(transition[:-3]) @ column,
            jnp.asarray(process_noise),
            retention=jnp.asarray(retention),
            tick=jnp.asarray(1),
        )
        corrects = update.corrections(samples, jnp.asarray(weights))
        return update.factors, update.gain, update.white, corrects, after

    for sampled in ([], [4], [0, 2, 3], list(range(WIDE))):
        order = jnp.asarray([*sampled, *[0] * (WIDE - len(sampled))])
        factors, gains, whites, corrects, after = map(np.asarray, found(order, len(sampled)))
        along = np.zeros((len(sampled), SIZE))
        along[:, :SHOWN] = derivatives[sampled]
        total = along @ covariance @ along.T + np.diag(variance[sampled])
        root = np.linalg.cholesky(total) if sampled else np.zeros((0, 0))
        gain = np.linalg.solve(root, along @ covariance)
        np.testing.assert_allclose(factors[np.ix_(sampled, sampled)], root, atol=1e-9)
        np.testing.assert_allclose(gains[sampled], gain, atol=1e-9)
        white = np.linalg.solve(root, error[sampled])
        np.testing.assert_allclose(whites[sampled], white, atol=1e-9)
        np.testing.assert_allclose(corrects, weights[sampled] @ gain, atol=1e-9)
        kept = transition @ (covariance - gain.T @ gain) @ transition.T
        np.testing.assert_allclose(after, kept + np.diag(process_noise), atol=1e-8)


def test_the_covariance_of_an_unstable_vehicle_settles_as_riccatis_equation_says() -> None:
    """Halves that rounding errors let differ grow with it, until a variance is negative."""
    rng, size, ticks, kept = np.random.default_rng(0), 7, 4000, 0.8
    shapes = rng.standard_normal((size, size))
    shapes[-1] = np.append(np.zeros(size - 1), 1.0)
    transition = shapes @ np.diag([1.02, 1.01, 1.0, 0.99, 0.9, 0.5, kept]) @ np.linalg.inv(shapes)
    derivatives = rng.standard_normal((2, size))
    samples = Samples(
        jnp.zeros(2),
        jnp.ones(2),
        SparseMatrix.of(
            lambda c: [sum(map(jnp.multiply, row, c))[None] for row in derivatives], size
        ),
        lambda number: number,
        jnp.asarray(2),
    )
    process_noise = np.full(size, 0.01)

    def tick(matrices: tuple[Array, ...], number: Array) -> tuple[tuple[Array, ...], None]:
        covariance, gain = matrices
        update = innovations_of(covariance, gain, samples)
        covariance = propagated(
            covariance,
            update,
            samples,
            lambda c: transition[:-1] @ c,
            jnp.asarray(process_noise),
            retention=jnp.asarray([kept]),
            tick=number,
        )
        return (covariance, update.gain), None

    begin = jnp.eye(size), jnp.zeros((2, size))
    (covariance, _), _ = lax.scan(tick, begin, jnp.arange(ticks))
    settled = solve_discrete_are(transition.T, derivatives.T, np.diag(process_noise), np.eye(2))
    np.testing.assert_allclose(covariance, settled, rtol=1e-9)
