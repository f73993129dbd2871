"""Whatever a fit's flights tell of, and however little: every error is a number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from tuner.core.numerics import scaled_solve
from tuner.objective.information import FisherInformation, ResidualChange
from tuner.uncertainty.covariance import covariance_of
from tuner.uncertainty.estimates import _shares, left_out, parts_of, total_error


@dataclass(frozen=True)
class Fit:
    """What is drawn of a fit: who tells of what, and how loudly.

    Attributes
    ----------
    tells
        (F, K) whether a flight tells of a coefficient.
    decades
        (K,) logarithm of how well one sample determines it.
    tied
        Whether the last two coefficients trade off exactly.
    lost
        Share of the information that what is learnt beside takes from it.
    """

    seed: int
    tells: tuple[tuple[bool, ...], ...]
    decades: tuple[float, ...]
    tied: bool = False
    lost: float = 0.0


@st.composite
def fits(draw: st.DrawFn) -> Fit:
    flights, size = draw(st.integers(1, 6)), draw(st.integers(1, 6))
    return Fit(
        draw(st.integers(0, 2**32 - 1)),
        tuple(tuple(draw(st.booleans()) for _ in range(size)) for _ in range(flights)),
        tuple(draw(st.floats(-6.0, 10.0)) for _ in range(size)),
        draw(st.booleans()),
        draw(st.sampled_from([0.0, 0.0, 0.5, 1.0])),
    )


def information_of(fit: Fit) -> FisherInformation:
    """Return the information at the minimum of a linear fit with white noise."""
    generator, tells = np.random.default_rng(fit.seed), np.array(fit.tells)
    flights, size = tells.shape
    design = generator.normal(size=(flights, 40, size)) * 10.0 ** np.array(fit.decades)
    design *= tells[:, None]
    if fit.tied and size > 1:
        design[..., -1] = 3.0 * design[..., -2]
    measured = generator.normal(size=(flights, 40))
    blocks, prior = np.einsum("fnp,fnq->fpq", design, design), 4.0 * np.eye(size)
    towards = np.einsum("fnp,fn->p", design, measured)
    minimum = scaled_solve(blocks.sum(axis=0) + prior, towards)
    score = np.einsum("fnp,fn->fp", design, design @ minimum - measured)
    shrink = fit.lost * blocks.sum(axis=0)
    return FisherInformation(
        channels=("only",),
        flight=np.arange(flights),
        blocks=blocks[None, :, None],
        score=score[None, :, None],
        spread=np.ones((1, flights)),
        nuisance_prior=np.zeros((size, size)),
        prior=prior,
        crashed=np.zeros(flights, bool),
        begins=np.zeros(flights),
        scale=np.ones((1, flights)),
        lost=shrink if fit.lost else None,
        changes={
            "physics step": ResidualChange(
                1e-3 * score[None, :, None], np.zeros((1, flights, 1)), np.zeros((1, flights, 1))
            )
        },
        pull=prior @ minimum,
        nuisance_pull=np.zeros(size),
    )


ALONE = Fit(0, ((True, True), (True, False), (True, False)), (1.0, 9.0))
"""The first flight alone tells of the second coefficient, louder than its prior can be heard."""


@given(fits())
@example(ALONE)
@example(Fit(1, ((True, True), (True, False), (True, False)), (1.0, 9.0), lost=1.0))
def test_every_error_is_a_number(fit: Fit) -> None:
    information = information_of(fit)
    covariance = covariance_of(information)
    size = len(fit.decades)
    parts = parts_of(information, covariance.error, np.zeros(size))
    for errors in (covariance.error, covariance.data_error, total_error(parts)):
        assert np.isfinite(errors).all()
        assert (errors > 0.0).all()
    shares, of_priors = _shares(information, len(fit.tells))
    assert np.isfinite(shares).all()
    assert np.isfinite(of_priors).all()


def test_a_flight_that_alone_determines_a_coefficient_is_no_contradiction() -> None:
    found = left_out(information_of(ALONE))
    assert found is not None
    noise = covariance_of(information_of(ALONE)).error
    assert (found < 5.0 * noise).all()
