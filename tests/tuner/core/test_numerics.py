"""Solves that always have an answer, and robust statistics."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri

from tuner.core.numerics import (
    Z95,
    Inverse,
    finite_rows,
    huber_weights,
    log_determinant,
    robust_sd,
    scaled_inverse,
    scaled_solve,
    std_errors_of,
    symmetric_eigen,
    unit_diagonal,
)

SIZES = st.integers(1, 8)
SEEDS = st.integers(0, 2**32 - 1)


def test_a_row_is_finite_where_all_of_it_is() -> None:
    rows = np.array([[1.0, 2.0], [np.nan, 2.0], [1.0, np.inf], [-np.inf, np.inf], [1e308, 1e308]])
    assert finite_rows(rows).tolist() == [True, False, False, False, True]
    assert finite_rows(rows[:, :0]).tolist() == [True] * 5
    assert finite_rows(rows[:0]).tolist() == []


def test_an_interval_holds_95_percent() -> None:
    assert float(ndtri(0.975)) == Z95


def information(
    seed: int, size: int, *, rank: int | None = None, decades: float = 8.0
) -> np.ndarray:
    """Return information of coefficients whose units lie many powers of ten apart."""
    generator = np.random.default_rng(seed)
    rows = generator.normal(size=(40, rank or size)) @ generator.normal(size=(rank or size, size))
    units = 10.0 ** generator.uniform(-decades, decades, size)
    return np.asarray((rows * units).T @ (rows * units))


@given(SEEDS, SIZES)
def test_the_inverse_does_not_depend_on_units(seed: int, size: int) -> None:
    matrix = information(seed, size, decades=1.0)
    units = 10.0 ** np.random.default_rng(seed).uniform(-9.0, 9.0, size)
    scaled = scaled_inverse(matrix * np.outer(units, units)) * np.outer(units, units)
    own = np.sqrt(np.diag(scaled))
    if np.linalg.cond(matrix) < 1e6:
        assert scaled == pytest.approx(np.linalg.inv(matrix), rel=1e-6, abs=1e-9 * own.max() ** 2)


@given(SEEDS, st.integers(2, 8), st.data())
def test_what_nothing_is_known_of_has_a_large_error_and_the_rest_its_own(
    seed: int, size: int, data: st.DataObject
) -> None:
    matrix = information(seed, size)
    lost = data.draw(st.lists(st.integers(0, size - 1), max_size=size - 1, unique=True))
    noise = data.draw(st.sampled_from([0.0, -1e-9, 1e-9]))
    for index in lost:  # what is left of a difference of two large numbers
        matrix[index] = matrix[:, index] = 0.0
        matrix[index, index] = noise
    known = np.setdiff1d(np.arange(size), lost)
    alone = std_errors_of(matrix[np.ix_(known, known)])
    assert np.all(np.isfinite(std_errors_of(matrix)))
    assert std_errors_of(matrix)[known] == pytest.approx(alone, rel=1e-3)
    inverse = Inverse.of(matrix, np.zeros_like(matrix))
    assert np.isfinite(inverse.matrix).all()
    assert np.isfinite(log_determinant(matrix))
    assert inverse.known[known].all()
    if noise <= 0.0:
        assert not inverse.known[lost].any()


@given(SEEDS, st.integers(2, 8), st.integers(1, 7))
def test_a_singular_system_has_a_solution(seed: int, size: int, rank: int) -> None:
    matrix = information(seed, size, rank=min(rank, size - 1), decades=3.0)
    truth = np.random.default_rng(seed + 1).normal(size=size) * unit_diagonal(matrix)
    right = matrix @ truth
    solution = scaled_solve(matrix, right, 1e-12)
    unit = unit_diagonal(matrix)
    assert np.isfinite(solution).all()
    assert unit * (matrix @ solution) == pytest.approx(unit * right, abs=1e-3)


def test_several_right_hand_sides_are_solved_at_once_and_none_of_nothing() -> None:
    matrix = information(3, 4, decades=1.0)
    right = np.random.default_rng(0).normal(size=(4, 3))
    assert scaled_solve(matrix, right) == pytest.approx(np.linalg.solve(matrix, right), rel=1e-6)
    assert scaled_solve(np.zeros((0, 0)), np.zeros(0)).shape == (0,)


def test_numbers_that_are_not_finite_are_named() -> None:
    with pytest.raises(np.linalg.LinAlgError, match="not finite"):
        symmetric_eigen(np.full((2, 2), np.nan))


def test_eigenvalues_have_a_second_method(monkeypatch: pytest.MonkeyPatch) -> None:
    stacked = np.stack([information(seed, 3, decades=1.0) for seed in (1, 2)])
    expected = np.linalg.eigh(stacked)[0]

    def fails(_: np.ndarray) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    monkeypatch.setattr(np.linalg, "eigh", fails)
    values, vectors = symmetric_eigen(stacked)
    assert values == pytest.approx(expected)
    assert (vectors * values[:, None]) @ np.swapaxes(vectors, 1, 2) == pytest.approx(stacked)


def test_a_robust_standard_deviation_is_deaf_to_outliers() -> None:
    values = np.random.default_rng(0).normal(scale=3.0, size=20_000)
    values[:200] = 1e6
    assert robust_sd(values) == pytest.approx(3.0, rel=0.05)


def test_hubers_weights_bound_the_pull_of_an_outlier() -> None:
    error = np.array([0.0, -2.0, 3.0, 300.0])
    assert np.abs(huber_weights(error, 3.0) * error) == pytest.approx([0.0, 2.0, 3.0, 3.0])
    assert huber_weights(error, np.inf) == pytest.approx(1.0)
