"""A wind of each flight is told from gusts, which have a mean over a flight as well."""

from dataclasses import replace

import numpy as np
import pytest

from tests.tuner.terms.test_score import FLIGHTS, MODEL, STRETCHES, by_flight, linear_fit
from tuner.terms.score import chance_of_gusts, score

WINDS, STILL = 3 + np.arange(FLIGHTS), np.zeros(3 + FLIGHTS)


def chances(*effects, **noise):
    return np.array(
        [
            chance_of_gusts(
                by_flight(linear_fit(*effects, seed=seed, **noise), 1), MODEL, WINDS, STILL
            )
            for seed in range(100)
        ]
    )


@pytest.mark.parametrize("noise", [{}, {"correlated": True}, {"gusts": True}])
def test_gusts_are_taken_for_steady_as_seldom_as_the_level_of_significance(noise):
    found = chances(0.0, **noise)
    assert np.mean(found < 0.01) <= 0.03
    assert 0.02 <= np.mean(found < 0.1) <= 0.2
    assert 0.35 <= np.mean(found < 0.5) <= 0.65


def test_a_steady_wind_exceeds_gusts():
    assert np.median(chances(2.0, -1.2, 0.0, 0.8, gusts=True)) < 1e-4
    assert np.max(chances(0.5, -0.3, 0.0, 0.2)) < 1e-6


def at_minimum(linear):
    """Return the same loss about its minimum with a wind of each flight."""
    change = linear.step(np.append(MODEL, WINDS), inside=np.ones(len(linear.flight), bool))
    return replace(
        linear,
        scaled=change,
        score=linear.score + np.einsum("spq,sq->sp", linear.hessian, change[linear.columns_seen]),
        pull=linear.pull + linear.prior @ change,
        loss=linear.loss + linear.change_of_loss(change).sum(),
    )


def test_it_makes_no_difference_from_where_columns_are_led_to_nothing():
    own = by_flight(linear_fit(0.5, -0.3, 0.0, 0.2, gusts=True), 1)
    moved = at_minimum(own)
    to_neutral = np.where(np.isin(np.arange(len(STILL)), WINDS), -moved.scaled, 0.0)
    wanted = chance_of_gusts(own, MODEL, WINDS, STILL)
    assert chance_of_gusts(moved, MODEL, WINDS, to_neutral) == pytest.approx(wanted, rel=1e-6)


def test_a_flight_of_one_stretch_has_no_information_on_steady_wind():
    own = by_flight(linear_fit(2.0), 1)
    first = np.arange(len(own.flight)) % STRETCHES == 0
    short = replace(
        own,
        hessian=own.hessian[first],
        score=own.score[first],
        flight=own.flight[first],
        section=own.section[first],
        columns_seen=own.columns_seen[first],
    )
    assert chance_of_gusts(short, MODEL, WINDS, STILL) == 1.0


def test_the_mean_of_gusts_is_no_wind():
    """By residuals about the winds of flights alone, a wind would stay in a third of the fits."""
    stays = [
        score(at_minimum(own), MODEL, WINDS, candidates=1, inside=True).is_accepted
        for seed in range(100)
        for own in [by_flight(linear_fit(0.0, seed=seed, gusts=True, alike=True), 1)]
    ]
    assert np.mean(stays) <= 0.08
