"""Verdicts, reasons and directions as sentences."""

from __future__ import annotations

import pytest

from tuner.uncertainty.verdict import (
    NOT_FITTED,
    Direction,
    ErrorParts,
    Reason,
    ReasonCode,
    Verdict,
    direction_in_words,
    half_width_in_words,
    judgement_in_words,
    parts_in_words,
    reason_in_words,
)

COMMON_SCALE = Direction(
    moves={"mass": 1.0, "inertia_xx": 1.0, "motor_constant": 1.0},
    error=30.0,
    null=True,
    common_scale=True,
)


def test_an_interval_with_everything_that_bears_on_it() -> None:
    reason = Reason(
        code=ReasonCode.INTERVAL,
        half_width=0.012,
        channel="body_rate",
        flight="circle",
        correlated_with="estimate_latency",
        correlation=0.95,
        noise_inflation=5.0,
        bound="lower",
    )
    assert judgement_in_words(Verdict.WEAKLY_KNOWN, reason) == (
        "weakly known: ±1.2 % (95 %), mostly from body rate, circle above all; hard to distinguish "
        "from estimate_latency (correlation +0.95); residuals are not white noise, which widens "
        "the interval 5.0 times; it lies at its lower bound"
    )


def test_the_parts_of_an_interval() -> None:
    parts = ErrorParts(noise=4e-6, residuals=3e-5, left_out=1.5e-5, terms=2e-5, step=None)
    assert parts_in_words(parts, None, 0.02) == (
        "noise alone ±0.039 %, residuals ±0.29 %, left-out flights ±0.15 %, left-out terms ±0.2 %"
    )
    assert parts_in_words(parts, "s", 0.02).startswith("noise alone ±0.0078 ms")
    tiny = parts.model_copy(update={"search": 1e-7})
    assert parts_in_words(tiny, None, 0.02) == parts_in_words(parts, None, 0.02)
    stopped_short = parts.model_copy(update={"search": 1e-5})
    assert parts_in_words(stopped_short, None, 0.02).endswith("rest of the search ±0.098 %")


def test_an_interval_in_its_unit() -> None:
    reason = Reason(code=ReasonCode.INTERVAL, half_width=3.1e-5, unit="s", channel="command")
    assert reason_in_words(reason) == "±0.031 ms (95 %), mostly from command"


def test_a_coefficient_that_the_prior_determines() -> None:
    reason = Reason(code=ReasonCode.WIDE_INTERVAL, half_width=1.57, prior_given=False)
    assert reason_in_words(reason) == (
        "the flights alone determine it only to ±381 %; the interval leans on the default prior"
    )
    reason = Reason(code=ReasonCode.WIDE_INTERVAL, half_width=15.0, prior_given=False)
    assert reason_in_words(reason).startswith("the flights alone hardly tell it from ten times as")
    reason = Reason(code=ReasonCode.PRIOR_DOMINATES, prior_share=0.7, prior_given=True)
    assert reason_in_words(reason) == "70 % of the information about it is that of the given prior"
    reason = Reason(code=ReasonCode.NO_INFORMATION, prior_given=False)
    assert reason_in_words(reason).startswith("the flights hold no information about it")


def test_a_null_direction_is_spelled_out() -> None:
    code = ReasonCode.NULL_DIRECTION
    reason = Reason(code=code, direction=COMMON_SCALE, prior_given=False)
    assert reason_in_words(reason).endswith(
        "that factor is not identifiable. Weigh the mass and fix it. "
        "The interval is that of the default prior"
    )


def test_held_tied_and_fixed_coefficients() -> None:
    reason = Reason(code=ReasonCode.NOT_WITH_ALL_FREE)
    assert judgement_in_words(Verdict.HELD, reason) == (
        "held at its initial value: the flights do not identify it while all others are free"
    )
    dependent = reason.model_copy(update={"given_held": "input_scaling"})
    assert judgement_in_words(Verdict.NOT_IDENTIFIABLE, dependent).endswith(
        "; fitted with input_scaling held at its initial value"
    )
    tied = Reason(code=ReasonCode.INTERVAL, half_width=0.01, tied_to="inertia_xx")
    assert judgement_in_words(Verdict.TIED, tied) == "tied to inertia_xx: ±1 % (95 %)"
    assert judgement_in_words(Verdict.FIXED, NOT_FITTED) == "fixed"


def test_a_common_scale_is_named_as_such() -> None:
    assert direction_in_words(COMMON_SCALE) == (
        "mass, inertia_xx and motor_constant scale together: multiplied by one factor, every "
        "motion stays the same; that factor is not identifiable. Weigh the mass and fix it."
    )


@pytest.mark.parametrize(
    ("moves", "sentence"),
    [
        ({"inertia_xx": 1.0}, "inertia_xx alone: it is known to ±20 %."),
        (
            {"motor_constant": 1.0, "input_scaling": -0.5},
            (
                "motor_constant trades off against input_scaling (in the proportion "
                "motor_constant +100 %, input_scaling -50 %): their combination is known to ±20 %."
            ),
        ),
        (
            {"motor_constant": 1.0, "input_scaling": 0.5},
            (
                "motor_constant and input_scaling rise and fall together (in the proportion "
                "motor_constant +100 %, input_scaling +50 %): their combination is known to ±20 %."
            ),
        ),
    ],
)
def test_a_direction_is_named_with_its_proportion_and_size(
    moves: dict[str, float], sentence: str
) -> None:
    direction = Direction(moves=moves, error=0.1, null=False, common_scale=False)
    assert direction_in_words(direction) == sentence


def test_half_an_interval_is_a_share_a_time_or_a_plain_number_beside_its_unit() -> None:
    assert half_width_in_words((1.98, 2.02), 2.0, "kg m²") == "±1 %"
    assert half_width_in_words((0.011, 0.013), 0.012, "s") == "±1 ms"
    assert half_width_in_words((-0.13, 0.53), 0.2, "s") == "±0.33 s"
    assert half_width_in_words((-1.0, 2.0), 0.5, "N s²/(rad m)") == "±1.5"
    assert half_width_in_words((None, 2.0), 0.5, "m") == ""


def test_an_interval_that_a_bound_cuts_off_is_shown_by_its_longer_side() -> None:
    assert half_width_in_words((0.0, 0.0022), 0.0007, "s") == "±1.5 ms"
