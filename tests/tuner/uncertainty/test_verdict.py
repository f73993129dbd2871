"""Verdicts and their reasons."""

from __future__ import annotations

import math
from typing import Any

from tuner.uncertainty.verdict import (
    Direction,
    Reason,
    ReasonCode,
    Verdict,
    half_width_in_words,
    judge,
    judge_after_holding,
    reason_in_words,
)

KNOWN = Reason(
    code=ReasonCode.INTERVAL,
    half_width=0.012,
    prior_share=0.001,
    prior_given=False,
    noise_inflation=1.1,
    correlated_with="estimate_latency",
    correlation=0.95,
    channel="attitude",
    flight="circle",
)
INTERVAL = Reason(code=ReasonCode.INTERVAL, half_width=0.012, channel="attitude", flight="circle")


def judged(
    *directions: Direction, half: float = 0.012, error: float = 0.006, **known: Any
) -> tuple[Verdict, Reason]:
    return judge(
        "inertia_xx",
        KNOWN.model_copy(update=known),
        directions,
        relative_half_width=half,
        data_error=error,
    )


def test_well_known() -> None:
    assert judged() == (Verdict.WELL_KNOWN, INTERVAL)


def test_weakly_known_names_the_correlated_coefficient() -> None:
    verdict, reason = judged(half=0.2, error=0.1)
    assert verdict is Verdict.WEAKLY_KNOWN
    assert (reason.correlated_with, reason.correlation) == ("estimate_latency", 0.95)


def test_an_interval_by_the_prior_is_not_identifiable() -> None:
    verdict, reason = judged(half=0.03, error=0.8)
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert reason.code is ReasonCode.WIDE_INTERVAL
    assert f"{reason.half_width:.2f}" == "1.57"
    verdict, reason = judged(prior_share=0.7, prior_given=True)
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert reason == Reason(code=ReasonCode.PRIOR_DOMINATES, prior_share=0.7, prior_given=True)


def test_a_coefficient_without_information() -> None:
    _, reason = judged(error=50.0)
    assert reason.code is ReasonCode.NO_INFORMATION


def test_a_null_direction_is_the_reason() -> None:
    moves = {"mass": 1.0, "inertia_xx": 1.0}
    null = Direction(moves=moves, error=30.0, null=True, common_scale=True)
    verdict, reason = judged(null, error=30.0)
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert reason == Reason(code=ReasonCode.NULL_DIRECTION, direction=null, prior_given=False)


def test_a_bound_and_model_error_are_reported() -> None:
    verdict, reason = judged(bound="lower", noise_inflation=5.0)
    assert verdict is Verdict.WEAKLY_KNOWN
    assert (reason.bound, reason.noise_inflation) == ("lower", 5.0)


def test_a_held_coefficient_is_distinguished_from_one_that_is_fitted_beside_it() -> None:
    verdict, reason = judge_after_holding("mass", Verdict.WELL_KNOWN, INTERVAL, "mass")
    assert verdict is Verdict.HELD
    assert reason == Reason(code=ReasonCode.NOT_WITH_ALL_FREE)
    verdict, reason = judge_after_holding("inertia_xx", Verdict.WELL_KNOWN, INTERVAL, "mass")
    assert verdict is Verdict.NOT_IDENTIFIABLE
    assert reason == Reason(code=ReasonCode.NOT_WITH_ALL_FREE, given_held="mass")
    assert not reason.identifiable


def test_a_tied_coefficient_stays_tied_when_its_group_is_held() -> None:
    tied = INTERVAL.model_copy(update={"tied_to": "inertia_xx"})
    verdict, reason = judge_after_holding("inertia_yy", Verdict.TIED, tied, "inertia_xx")
    assert verdict is Verdict.TIED
    assert reason == Reason(code=ReasonCode.NOT_WITH_ALL_FREE, tied_to="inertia_xx")


def test_a_reason_survives_json() -> None:
    _, reason = judged(bound="upper", noise_inflation=3.0)
    assert Reason.model_validate_json(reason.model_dump_json()) == reason


def test_a_reason_has_the_longer_side_of_the_interval_as_tables_do():
    """Of 0.022, ±0.19 in its logarithm."""
    reason = Reason(code=ReasonCode.MEASURED_ROUGHLY, half_width=0.19)
    low, high = 0.022 * math.exp(-0.19), 0.022 * math.exp(0.19)
    assert half_width_in_words((low, high), 0.022, "kg m²") in reason_in_words(reason)
    in_unit = Reason(code=ReasonCode.MEASURED_ROUGHLY, half_width=0.19, unit="N m")
    assert "±0.19 N m" in reason_in_words(in_unit)
