"""What a standard error is made of, from regressions whose answers are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from tuner.objective.information import FisherInformation, ResidualChange
from tuner.uncertainty.covariance import overdispersion_factors
from tuner.uncertainty.estimates import (
    INPUT,
    READINGS,
    VOLTMETER_DRAWS,
    left_out,
    noise_alone,
    parts_of,
    total_error,
)

COUNT, FLIGHTS, LENGTH = 3, 4, 80
ONE, ALIKE = np.ones((1, 1)), np.ones(1)


def regression(
    generator: np.random.Generator,
    *,
    apart: float,
    one_tells: bool = False,
    short_of: float = 0.0,
) -> tuple[FisherInformation, np.ndarray]:
    """Return the information of a fit to flights whose own truths lie apart, and the fit.

    The truth is zero. Where ``one_tells``, the first flight alone tells of the first coefficient,
    and a hundred times more loudly than any. The search stopped ``short_of`` the minimum.
    """
    design = generator.normal(size=(FLIGHTS, LENGTH, COUNT))
    if one_tells:
        design[1:, :, 0] = 0.0
        design[0, :, 0] *= 100.0
    own = apart * generator.normal(size=(FLIGHTS, COUNT))
    measured = np.einsum("fnp,fp->fn", design, own) + generator.normal(size=(FLIGHTS, LENGTH))
    fit, *_ = np.linalg.lstsq(design.reshape(-1, COUNT), measured.ravel())
    fit = fit + short_of
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
        pull=1e-9 * fit,
        nuisance_pull=np.zeros(COUNT),
    )
    return information, fit


def change(across: np.ndarray) -> ResidualChange:
    """Return a change of the residuals that changes the slope of the loss so."""
    return ResidualChange(across[None, None, None], np.zeros((1, 1, 1)), np.zeros((1, 1, 1)))


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
    assert np.mean(covered) > 0.91
    # narrower than Student's t with three degrees of freedom: there may well be nothing but noise
    spread = np.hypot(apart, 1.0 / np.sqrt(LENGTH)) / np.sqrt(FLIGHTS)
    assert 1.0 < np.median(widths) / spread < 0.85 * 3.18 / 1.96


@pytest.mark.parametrize("apart", [0.0, 0.5])
def test_the_error_by_one_flight_alone_is_as_large_as_by_all(apart):
    """It cannot contradict itself; how flights disagree elsewhere is all that is known of it."""
    noise, found = errors(regression(np.random.default_rng(1), apart=apart, one_tells=True)[0])
    wider = found / noise
    assert wider[0] < wider[1:].max()
    assert bool(wider[0] < 1.5) is (apart == 0.0)
    assert bool(wider[1] > 3.0) is (apart > 0.0)


@pytest.mark.parametrize("one_tells", [False, True])
def test_flights_do_not_disagree_because_the_search_stopped_short(one_tells):
    """The last of a step is seen by the flight that tells most, and by it alone."""
    made = [
        regression(np.random.default_rng(8), apart=0.0, one_tells=one_tells, short_of=short)[0]
        for short in (0.0, 0.02)
    ]
    (_, exact), (_, short) = (errors(information) for information in made)
    assert short == pytest.approx(exact, rel=1e-6)
    lags = np.zeros(COUNT)
    at_minimum, off = (parts_of(each, exact, lags) for each in made)
    assert at_minimum["search"] == pytest.approx(0.0, abs=1e-9)
    assert off["search"] == pytest.approx(0.02)
    assert total_error(off) == pytest.approx(np.hypot(total_error(at_minimum), 0.02))
    where = np.array([True, False, False])
    assert made[1].with_resting(where).slope[0] == pytest.approx(0.0, abs=1e-9)
    assert made[1].with_resting(where).slope[1:] == pytest.approx(made[1].slope[1:])


def test_a_move_with_another_input_is_a_part_of_the_error():
    information, _ = regression(np.random.default_rng(4), apart=0.0)
    other = replace(information, changes={INPUT: change(np.array([30.0, 0.0, -10.0]))})
    parts = parts_of(other, np.zeros(COUNT), np.zeros(COUNT))
    moved = np.abs(information.inverse.matrix @ np.array([30.0, 0.0, -10.0]))
    assert parts["readings"] == pytest.approx(moved)
    assert np.all(total_error(parts) >= moved)


def test_one_flight_is_left_out_in_parts_if_it_is_long():
    many, _ = regression(np.random.default_rng(2), apart=0.0)
    one = replace(many, flight=np.zeros(FLIGHTS, int), begins=10.0 * np.arange(FLIGHTS))
    assert errors(one)[1] == pytest.approx(errors(many)[1])
    assert left_out(replace(one, begins=2.0 * np.arange(FLIGHTS))) is None


def test_the_error_by_noise_alone_ignores_the_scales_of_residuals():
    information, _ = regression(np.random.default_rng(3), apart=0.0)
    scaled = replace(information, blocks=information.blocks / 9.0, scale=3.0 * information.scale)
    assert noise_alone(scaled) == pytest.approx(noise_alone(information), rel=1e-6)


def test_the_quoted_error_holds_every_part():
    information, _ = regression(np.random.default_rng(4), apart=0.5)
    total = information.total
    step = np.array([0.3, -0.2, 0.0])
    spread = parts_of(
        replace(information, changes={"step": change(total @ step)}),
        np.full(COUNT, 0.01),
        np.zeros(COUNT),
    )
    assert spread["step"] == pytest.approx(np.abs(step), abs=1e-9)
    assert total_error(spread) == pytest.approx(
        np.hypot(spread["left_out"], np.abs(step)), rel=1e-6
    )
    doubt = 10.0 * spread["left_out"]
    doubted = parts_of(
        replace(information, selection_shifts=doubt), np.full(COUNT, 0.01), np.zeros(COUNT)
    )
    assert total_error(doubted) == pytest.approx(np.hypot(spread["left_out"], doubt))


def test_a_lag_is_known_no_better_than_half_a_simulators_step():
    """Stepped by Euler's rule, a lag acts as if it were shorter by that much, and never by more."""
    information, _ = regression(np.random.default_rng(5), apart=0.0)
    spread = parts_of(
        replace(information, changes={"step": change(np.zeros(COUNT))}),
        np.full(COUNT, 1e-6),
        np.array([1.0, 0.0, 0.0]),
    )
    steps, time_constant = 4000.0, 0.02
    as_if = -1.0 / steps / np.log(1.0 - 1.0 / steps / time_constant)
    assert spread["step"][0] == pytest.approx((time_constant - as_if) / np.sqrt(3.0), rel=0.01)
    assert spread["step"][1:] == pytest.approx(0.0)


def test_readings_drawn_again_count_as_far_as_they_scatter_the_estimates():
    """Each draw moves them by a normal error: 95 % of the truth's lie within what is quoted."""
    information, _ = regression(np.random.default_rng(6), apart=0.0)
    total, random, held = information.total, np.random.default_rng(7), []
    for _ in range(400):
        moves = random.normal(size=(VOLTMETER_DRAWS + 1, COUNT))
        changes = {f"{READINGS} {i}": change(total @ moves[i]) for i in range(VOLTMETER_DRAWS)}
        spread = parts_of(
            replace(information, changes=changes), np.full(COUNT, 1e-9), np.zeros(COUNT)
        )
        assert "step" not in spread
        held.append(np.abs(moves[-1]) < 1.96 * spread["readings"])
    assert np.mean(held) == pytest.approx(0.95, abs=0.015)
    without = parts_of(replace(information, changes={}), np.full(COUNT, 1e-9), np.zeros(COUNT))
    assert "readings" not in without
    assert total_error(spread) == pytest.approx(np.hypot(total_error(without), spread["readings"]))


@pytest.mark.parametrize("excess", [0.0, 1.0, 5.0, 1e4])
@pytest.mark.parametrize("freedom", [2, 3, 10])
def test_overdispersion_factors_cover_any_excess_over_noise(freedom, excess):
    generator = np.random.default_rng(6)
    variance = 1.0 + excess**2
    ratio = variance * generator.chisquare(freedom, 2000) / freedom
    factor = np.concatenate(
        [
            overdispersion_factors(one[None], np.array([float(freedom)]), ONE, ALIKE)
            for one in ratio[:300]
        ]
    )
    covered = np.abs(np.sqrt(variance) * generator.normal(size=len(factor))) < 1.96 * factor
    assert covered.mean() > 0.88
    students = stats.t.ppf(0.975, freedom) / 1.96
    assert np.median(factor) / np.sqrt(variance) < 0.9 * students + 0.1
    assert factor.min() >= 1.0


@pytest.mark.parametrize(("excess", "width"), [(0.0, 1.1), (1.0, 1.15), (30.0, 1.45)])
def test_coefficients_share_the_estimate_of_the_disturbance(excess, width):
    """Three degrees of freedom each, twelve coefficients: narrower than alone, and they cover."""
    generator, own = np.random.default_rng(7), np.eye(12)
    covered, shared, alone = [], [], []
    for _ in range(100):
        sd = np.sqrt(1.0 + (excess * np.exp(0.5 * generator.normal(size=12))) ** 2)
        ratio, freedom = sd**2 * generator.chisquare(3, 12) / 3.0, np.full(12, 3.0)
        factor = overdispersion_factors(ratio, freedom, own, np.ones(12))
        covered.append(np.abs(sd * generator.normal(size=12)) < 1.96 * factor)
        shared.append(factor / sd)
        alone.append(overdispersion_factors(ratio[:1], freedom[:1], ONE, ALIKE) / sd[:1])
    assert 0.91 < np.mean(covered) < 0.99
    assert np.median(shared) < width
    assert np.median(shared) < np.median(alone) + 0.1


def test_one_coefficient_that_scatters_keeps_its_wide_interval_among_others():
    ratio = np.append(np.ones(11), 400.0)
    factor = overdispersion_factors(ratio, np.full(12, 3.0), np.eye(12), np.ones(12))
    assert factor[-1] > 15.0
    assert factor[:-1].max() < 1.4


def test_coefficients_that_go_together_are_one_observation():
    ratio, freedom = np.full(6, 0.5), np.full(6, 3.0)
    as_one, apart = (
        overdispersion_factors(ratio, freedom, correlation, np.ones(6))[0]
        for correlation in (np.ones((6, 6)), np.eye(6))
    )
    assert as_one == pytest.approx(overdispersion_factors(ratio[:1], freedom[:1], ONE, ALIKE)[0])
    assert apart < as_one


def test_how_disturbed_the_channels_are_says_how_the_coefficients_differ():
    """Every other one is disturbed ten times less: of few degrees of freedom, that is news."""
    generator, own = np.random.default_rng(8), np.eye(12)
    sd = np.where(np.arange(12) % 2, 3.0, 30.0)
    covered, widths = [], {"alike": [], "apart": []}
    for _ in range(100):
        ratio, freedom = sd**2 * generator.chisquare(1.5, 12) / 1.5, np.full(12, 1.5)
        alike = overdispersion_factors(ratio, freedom, own, np.ones(12)) / sd
        apart = overdispersion_factors(ratio, freedom, own, 0.1 * sd**2) / sd
        assert apart == pytest.approx(overdispersion_factors(ratio, freedom, own, sd**2) / sd)
        widths["alike"].append(alike)
        widths["apart"].append(apart)
        covered.append(np.abs(generator.normal(size=12)) < 1.96 * apart)
    assert np.mean(covered) > 0.93
    assert np.median(widths["apart"]) < 0.85 * np.median(widths["alike"])
