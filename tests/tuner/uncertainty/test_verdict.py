"""Verdicts and their reasons."""

from __future__ import annotations

from dataclasses import replace

from tuner.uncertainty.directions import Direction
from tuner.uncertainty.verdict import Standing, Verdict, judge

GOOD = Standing(
    name="inertia_xx",
    interval="1.2 %",
    half_width=0.012,
    data_error=0.006,
    prior_share=0.001,
    prior_given=False,
    inflation=1.1,
    partner="estimate_latency",
    correlation=0.95,
    source="attitude, circle above all",
    bound=None,
)


def test_well_known() -> None:
    assert judge(GOOD, ()) == (
        Verdict.WELL_KNOWN,
        "±1.2 % (95 %), mostly from attitude, circle above all",
    )


def test_weakly_known_names_what_it_is_confused_with() -> None:
    verdict, reason = judge(replace(GOOD, half_width=0.2, interval="20 %", data_error=0.1), ())
    assert verdict is Verdict.WEAKLY_KNOWN
    assert "hard to tell from estimate_latency (correlation +0.95)" in reason


def test_an_interval_that_the_prior_made_is_not_identifiable() -> None:
    verdict, reason = judge(replace(GOOD, data_error=0.8, half_width=0.03), ())
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert (
        reason == "the flights alone leave it open to ±157 %; the interval is the default prior's"
    )
    verdict, reason = judge(replace(GOOD, prior_share=0.7, prior_given=True), ())
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert reason == "70% of what is known comes from the prior that was given"


def test_a_coefficient_without_effect() -> None:
    _, reason = judge(replace(GOOD, data_error=50.0), ())
    assert "no trace in the flights" in reason


def test_a_null_direction_is_the_reason() -> None:
    null = Direction({"mass": 1.0, "inertia_xx": 1.0}, 30.0, True, "They scale together.")
    verdict, reason = judge(replace(GOOD, data_error=30.0), (null,))
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert "They scale together." in reason


def test_a_bound_and_model_error_are_said() -> None:
    verdict, reason = judge(replace(GOOD, bound="lower", inflation=5.0), ())
    assert verdict is Verdict.WEAKLY_KNOWN
    assert "the fit ended at its lower bound" in reason
    assert "widens the interval 5.0 times" in reason
