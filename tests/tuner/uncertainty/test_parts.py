"""What a standard error is made of, from regressions whose answers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tuner.uncertainty.information import FisherInformation
from tuner.uncertainty.parts import left_out, noise_alone, spread_of

COUNT, FLIGHTS, LENGTH = 3, 4, 80


def regression(
    generator: np.random.Generator, *, apart: float, one_tells: bool = False
) -> tuple[FisherInformation, np.ndarray]:
    """Return the information of a fit to flights whose own truths lie apart, and the fit.

    The truth is zero. Where ``one_tells``, the first flight alone tells of the first coefficient.
    """
    design = generator.normal(size=(FLIGHTS, LENGTH, COUNT))
    if one_tells:
        design[1:, :, 0] = 0.0
    own = apart * generator.normal(size=(FLIGHTS, COUNT))
    measured = np.einsum("fnp,fp->fn", design, own) + generator.normal(size=(FLIGHTS, LENGTH))
    fit, *_ = np.linalg.lstsq(design.reshape(-1, COUNT), measured.ravel())
    left = design @ fit - measured
    information = FisherInformation(
        channels=("only",),
        flight=np.arange(FLIGHTS),
        blocks=np.einsum("fnp,fnq->fpq", design, design)[None, :, None],
        score=np.einsum("fnp,fn->fp", design, left)[None, :, None],
        spread=np.ones((1, FLIGHTS)),
        nuisance_prior=np.zeros((COUNT, COUNT)),
        prior=1e-9 * np.eye(COUNT),
        crashed=np.zeros(FLIGHTS, bool),
        begins=np.zeros(FLIGHTS),
        scale=np.ones((1, FLIGHTS)),
    )
    return information, fit


def errors(information: FisherInformation) -> tuple[np.ndarray, np.ndarray]:
    inverse = np.linalg.inv(information.total)
    found = left_out(information)
    assert found is not None
    return np.sqrt(np.diag(inverse)), found


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_the_error_of_left_out_flights_covers_however_far_they_lie_apart(apart):
    generator = np.random.default_rng(0)
    covered, widths = [], []
    for _ in range(150):
        information, fit = regression(generator, apart=apart)
        _, found = errors(information)
        covered.append(np.abs(fit) < 1.96 * found)
        widths.append(found)
    assert 0.91 < np.mean(covered) <= 0.99
    # no wider than four flights leave open: Student's t with three degrees of freedom
    spread = np.hypot(apart, 1.0 / np.sqrt(LENGTH)) / np.sqrt(FLIGHTS)
    assert np.median(widths) == pytest.approx(spread * 3.18 / 1.96, rel=0.25)


def test_what_one_flight_alone_tells_it_is_not_asked_to_contradict():
    noise, found = errors(regression(np.random.default_rng(1), apart=0.5, one_tells=True)[0])
    assert found[0] < noise[0]


def test_one_flight_is_left_out_in_stretches():
    many, _ = regression(np.random.default_rng(2), apart=0.0)
    one = replace(
        many,
        flight=np.zeros(1, int),
        begins=np.zeros(1),
        blocks=np.moveaxis(many.blocks, 1, 2),
        score=np.moveaxis(many.score, 1, 2),
        scale=np.ones((1, 1)),
    )
    assert errors(one)[1] == pytest.approx(errors(many)[1])
    single = replace(one, blocks=one.blocks.sum(axis=2, keepdims=True))
    single = replace(single, score=one.score.sum(axis=2, keepdims=True))
    assert left_out(single) is None


def test_noise_alone_is_what_it_would_be_without_the_scales_of_the_residuals():
    information, _ = regression(np.random.default_rng(3), apart=0.0)
    scaled = replace(information, blocks=information.blocks / 9.0, scale=3.0 * information.scale)
    assert noise_alone(scaled) == pytest.approx(noise_alone(information), rel=1e-6)


def test_the_quoted_error_holds_every_part():
    information, _ = regression(np.random.default_rng(4), apart=0.5)
    total = information.total
    step = np.array([0.3, -0.2, 0.0])
    spread = spread_of(
        replace(information, changes={"step": (total @ step)[None]}),
        np.full(COUNT, 0.01),
        np.zeros(COUNT),
    )
    assert spread.step == pytest.approx(np.abs(step), abs=1e-9)
    assert spread.left_out is not None
    assert spread.quoted == pytest.approx(np.hypot(spread.left_out, np.abs(step)), rel=1e-6)
    parts = spread.of(0, -2.0)
    assert parts.step == pytest.approx(0.6)
    assert parts.noise == pytest.approx(2.0 * spread.noise[0])


def test_a_lag_is_known_no_better_than_half_a_simulators_step():
    """Stepped by Euler's rule, a lag acts as if it were shorter by that much."""
    information, _ = regression(np.random.default_rng(5), apart=0.0)
    spread = spread_of(
        replace(information, changes={"step": np.zeros((1, COUNT))}),
        np.full(COUNT, 1e-6),
        np.array([1.0, 0.0, 0.0]),
    )
    steps, time_constant = 4000.0, 0.02
    as_if = -1.0 / steps / np.log(1.0 - 1.0 / steps / time_constant)
    assert spread.step is not None
    assert spread.step[0] == pytest.approx(time_constant - as_if, rel=0.01)
    assert spread.step[1:] == pytest.approx(0.0)
