"""Refits to other flights: what counts how often, and the errors that follow."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.report.result_texts import refits_in_words
from tuner.report.sections.coefficients import refits
from tuner.uncertainty.records import Refit
from tuner.uncertainty.refits import _counted, jackknife_errors

FREE = ("inertia_xx", "motor_constant", "estimate_latency")


def test_the_jackknife_of_a_mean_is_its_standard_error():
    drawn = np.random.default_rng(1).normal(size=7)
    left_out = [np.delete(drawn, i).mean() for i in range(7)]
    folds = [Refit(coefficients={"mass": mean}) for mean in left_out]
    assert jackknife_errors(folds) == {"mass": pytest.approx(np.std(drawn, ddof=1) / np.sqrt(7))}


def test_a_flight_counts_as_often_as_it_was_drawn():
    objective = making.problem(FREE)
    fitted = making.fitted_of(objective, making.truth(objective))
    point, criterion = fitted.point, fitted.criterion
    once = objective.sums(point, criterion)
    counts = np.zeros(objective.flights)
    counts[0] = 3.0
    often = _counted(objective, counts).sums(point, criterion)
    of_first = np.asarray(objective.segments.flight) == 0
    for name in ("loss", "gradient", "hessian"):
        np.testing.assert_allclose(
            getattr(often, name), 3.0 * np.asarray(getattr(once, name)) * of_first, rtol=1e-12
        )
    # how well a flight is met, from which its weights follow, is no matter of how often it counts
    jax.tree.map(
        lambda a, b: np.testing.assert_array_equal(a, b * of_first), often.squares, once.squares
    )


def result_with(**errors):
    found = [
        SimpleNamespace(std_error=1.0, jackknife_error=error, bootstrap_error=None, best=2.0)
        for error in errors.values()
    ]
    flights = [SimpleNamespace(split=split) for split in ("fit", "fit", "fit", "holdout")]
    return SimpleNamespace(coefficients=dict(zip(errors, found, strict=True)), flights=flights)


def test_a_flight_that_is_left_out_takes_each_channel_s_own_weights_along():
    objective = making.problem(FREE)
    measured = objective.segments.measured
    backwards = {name: measured[name] for name in sorted(measured, reverse=True)}
    other = replace(objective, segments=replace(objective.segments, measured=backwards))
    counts = np.ones(objective.flights)
    counts[0] = 0.0
    for name, channel in _counted(other, counts).segments.measured.items():
        own = np.array(measured[name].weight)
        own[..., objective.flight == 0] = 0.0
        np.testing.assert_array_equal(channel.weight, own)


def test_a_coefficient_that_flights_disagree_about_is_named():
    precision, disagree = refits_in_words(result_with(inertia_xx=1.2, moment_constant=2.5))
    assert precision.endswith("known to about ±50 %.")
    assert disagree.startswith("The flights disagree about moment_constant by more than twice")
    assert "disagree about no coefficient" in refits_in_words(result_with(inertia_xx=1.2))[1]


def test_a_fit_without_refits_says_nothing_of_them():
    assert refits_in_words(result_with(inertia_xx=None)) == ()
    assert refits(result_with(inertia_xx=None)) is None
