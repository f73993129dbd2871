"""The covariance that kernels propagate, against products of matrices."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from tuner.disturbances.covariance import Samples, Sparse, innovations_of, propagated

SIZE, SHOWN, WIDE = 23, 9, 6


def spread(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.standard_normal((size, size))
    return root @ root.T / size


@pytest.mark.parametrize("sampled", [[], [4], [0, 2, 3], list(range(WIDE))])
def test_samples_tell_and_time_spreads_what_products_of_matrices_say(sampled: list[int]) -> None:
    rng = np.random.default_rng(len(sampled))
    covariance, follow = spread(rng, SIZE), rng.standard_normal((SIZE, SIZE))
    derivatives = rng.standard_normal((WIDE, SHOWN)) * (rng.random((WIDE, SHOWN)) < 0.4)
    derivatives[:, 0] = 1.0
    columns = [jnp.asarray(row)[jnp.flatnonzero(row)] for row in derivatives]

    def push(change: list) -> list:
        """Return each row's sum of the numbers that it depends on."""
        return [
            sum(c * change[k] for c, k in zip(some, np.flatnonzero(row), strict=True))[None]
            for some, row in zip(columns, derivatives, strict=True)
        ]

    seen = Sparse.of(push, SHOWN)
    assert [list(row) for row in seen.rows] == [np.flatnonzero(r).tolist() for r in derivatives]
    error, variance = rng.standard_normal(WIDE), rng.random(WIDE) + 0.1
    order = jnp.asarray([*sampled, *[0] * (WIDE - len(sampled))])
    samples = Samples(
        jnp.asarray(error),
        jnp.asarray(variance),
        seen,
        lambda number: order[number],
        jnp.asarray(len(sampled)),
    )
    told = innovations_of(jnp.asarray(covariance), jnp.ones((WIDE, SIZE)), samples)
    along = np.zeros((len(sampled), SIZE))
    along[:, :SHOWN] = derivatives[sampled]
    total = along @ covariance @ along.T + np.diag(variance[sampled])
    root = np.linalg.cholesky(total) if sampled else np.zeros((0, 0))
    gain = np.linalg.solve(root, along @ covariance)
    np.testing.assert_allclose(np.asarray(told.factors)[np.ix_(sampled, sampled)], root, atol=1e-9)
    np.testing.assert_allclose(np.asarray(told.gain)[sampled], gain, atol=1e-9)
    white = np.linalg.solve(root, error[sampled])
    np.testing.assert_allclose(np.asarray(told.white)[sampled], white, atol=1e-9)
    weights = rng.standard_normal(WIDE)
    corrects = told.corrections(samples, jnp.asarray(weights))
    np.testing.assert_allclose(corrects, weights[sampled] @ gain, atol=1e-9)
    unrest = rng.random(SIZE)
    after, _ = propagated(
        (jnp.asarray(covariance), jnp.zeros((SIZE, SIZE))),
        told,
        samples,
        lambda column: jnp.asarray(follow) @ column,
        jnp.asarray(unrest),
    )
    expected = follow @ (covariance - gain.T @ gain) @ follow.T + np.diag(unrest)
    np.testing.assert_allclose(after, expected, atol=1e-8)
