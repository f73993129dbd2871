"""Standard errors against repeated experiments on linear problems."""

from __future__ import annotations

import numpy as np
import pytest

from tuner.objective.information import FisherInformation
from tuner.uncertainty.covariance import covariance_of

COUNT, BLOCKS, LENGTH = 3, 40, 25


def regression(noise: np.ndarray, design: np.ndarray) -> tuple[FisherInformation, np.ndarray]:
    """Return the information of a least-squares fit, and the fit; truth is zero, σ is 1."""
    fit, *_ = np.linalg.lstsq(design, noise, rcond=None)
    rows = design.reshape(BLOCKS, LENGTH, COUNT)
    residual = (design @ fit - noise).reshape(BLOCKS, LENGTH)
    information = FisherInformation(
        channels=("only",),
        flight=np.zeros(1, int),
        blocks=np.einsum("bnp,bnq->bpq", rows, rows)[None, None],
        score=np.einsum("bnp,bn->bp", rows, residual)[None, None],
        spread=np.full((1, 1), np.mean(residual**2)),
        nuisance_prior=np.zeros((COUNT, COUNT)),
        prior=1e-9 * np.eye(COUNT),
        crashed=np.zeros(1, bool),
        begins=np.zeros(1),
        scale=np.ones((1, 1)),
    )
    return information, fit


def smooth_design(seed: int) -> np.ndarray:
    """Return slowly varying columns, as sensitivities are."""
    time = np.arange(BLOCKS * LENGTH) / LENGTH
    phase = np.random.default_rng(seed).uniform(0, 6, COUNT)
    waves = [np.sin(0.7 * (k + 1) * time + phase[k]) for k in range(COUNT)]
    return np.stack(waves, axis=-1) + 0.3


def autoregressive(generator: np.random.Generator, memory: float) -> np.ndarray:
    steps = generator.normal(size=BLOCKS * LENGTH) * np.sqrt(1 - memory**2)
    series = np.empty_like(steps)
    last = generator.normal()
    for index, step in enumerate(steps):
        last = memory * last + step
        series[index] = last
    return series


@pytest.mark.parametrize("memory", [0.0, 0.7])
def test_the_standard_error_is_the_spread_of_repeated_fits(memory: float) -> None:
    generator = np.random.default_rng(3)
    design = smooth_design(1)
    fits, errors = [], []
    for _ in range(300):
        information, fit = regression(autoregressive(generator, memory), design)
        fits.append(fit)
        errors.append(covariance_of(information).error)
    spread = np.std(fits, axis=0)
    assert np.median(errors, axis=0) == pytest.approx(spread, rel=0.2)


def test_white_noise_widens_by_the_few_degrees_of_freedom_of_stretches() -> None:
    generator = np.random.default_rng(5)
    design = smooth_design(2)
    covariances = [
        covariance_of(regression(generator.normal(size=BLOCKS * LENGTH), design)[0])
        for _ in range(50)
    ]
    assert np.median([covariance.inflation for covariance in covariances]) < 1.2
    assert min(covariance.inflation.min() for covariance in covariances) >= 1.0


def test_a_coefficient_that_one_stretch_determines_is_not_widened_for_it() -> None:
    """The jackknife, which leaves it out, would have noise alone three times as wide and more."""
    generator = np.random.default_rng(6)
    design = smooth_design(2)
    design[4 * LENGTH :, 0] *= 0.1
    widened = [
        covariance_of(regression(generator.normal(size=BLOCKS * LENGTH), design)[0]).inflation
        for _ in range(50)
    ]
    assert np.median(widened, axis=0)[0] < 1.5
    assert np.median(widened, axis=0)[1:].max() < 1.2


def test_residuals_larger_than_assumed_widen_the_interval() -> None:
    generator = np.random.default_rng(7)
    design = smooth_design(3)
    noise = generator.normal(size=BLOCKS * LENGTH)
    small, _ = regression(noise, design)
    large, _ = regression(4.0 * noise, design)
    assert covariance_of(large).error == pytest.approx(4.0 * covariance_of(small).error, rel=1e-6)


def test_a_direction_without_data_is_known_from_the_prior_alone() -> None:
    generator = np.random.default_rng(9)
    design = smooth_design(4)
    design[:, 2] = design[:, 0]
    information, _ = regression(generator.normal(size=BLOCKS * LENGTH), design)
    information = FisherInformation(**{**vars(information), "prior": np.eye(COUNT) / 0.5**2})
    covariance = covariance_of(information)
    # the sum of the two is known, their difference has the prior's 0.5·√2, half of it each
    assert covariance.error[0] == pytest.approx(0.5 / np.sqrt(2), rel=0.02)
    assert covariance.data_error[0] > 10.0
    assert covariance.data_error[1] == pytest.approx(covariance.error[1], rel=0.1)
    assert covariance.correlation[0, 2] < -0.9


@pytest.mark.parametrize("size", [1e5, 1e8])
def test_rounding_errors_of_large_information_are_no_information(size: float) -> None:
    generator = np.random.default_rng(11)
    design = size * smooth_design(5)
    design[:, 2] = design[:, 0] * (1.0 + 1e-13 * generator.normal(size=len(design)))
    information, _ = regression(generator.normal(size=BLOCKS * LENGTH), design)
    information = FisherInformation(**{**vars(information), "prior": np.eye(COUNT) / 0.5**2})
    covariance = covariance_of(information)
    assert covariance.error[0] == pytest.approx(0.5 / np.sqrt(2), rel=0.02)
    assert covariance.data_error[0] > 10.0
    assert covariance.error[1] < 1.0 / size
