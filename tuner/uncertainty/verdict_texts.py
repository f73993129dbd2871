"""Verdicts, their reasons and badly determined directions as sentences."""

from __future__ import annotations

import math

from tuner.core.numerics import Z95
from tuner.core.phrases import listed, percent, quantity
from tuner.uncertainty.records import ErrorParts
from tuner.uncertainty.verdict import Direction, Reason, ReasonCode, Verdict
from tuner.vehicle import scale_group

MAX_LOG_HALF_WIDTH = 100.0
"""Largest half-width of a logarithm's interval: more than any prior leaves."""
MAX_LOG_QUOTED = math.log(10.0)
"""Largest half-width of a logarithm's interval that is given as a percentage."""
MIN_REPORTED_SHARE = 0.01
"""Least part of an error that is reported, as a share of the largest."""


def verdict_in_words(verdict: Verdict) -> str:
    """Return a verdict as it stands in a table."""
    return "held at its initial value" if verdict is Verdict.HELD else verdict.replace("_", " ")


def judgement_in_words(verdict: Verdict, reason: Reason) -> str:
    """Return a verdict and its reason, as a phrase."""
    because = reason_in_words(reason)
    if verdict is Verdict.TIED and because:  # which names the other coefficient
        return because
    return f"{verdict_in_words(verdict)}: {because}" if because else verdict_in_words(verdict)


def reason_in_words(reason: Reason) -> str:
    """Return why a verdict was given; empty if there is nothing to say."""
    phrase = _main_clause(reason)
    if reason.tied_to is not None:
        phrase = f"tied to {reason.tied_to}: {phrase}"
    if reason.correlated_with is not None and reason.correlation is not None:
        phrase += (
            f"; hard to distinguish from {reason.correlated_with} "
            f"(correlation {reason.correlation:+.2f})"
        )
    if reason.noise_inflation is not None:
        phrase += (
            "; residuals are not white noise, which widens the interval "
            f"{reason.noise_inflation:.1f} times"
        )
    if reason.bound is not None:
        phrase += f"; it lies at its {reason.bound} bound"
    if reason.given_held is not None:
        phrase += f"; fitted with {reason.given_held} held at its initial value"
    return phrase


def half_width_in_words(
    interval: tuple[float | None, float | None] | None, value: float, unit: str
) -> str:
    """Return the longer side of a 95 % interval, as it stands beside a column of units.

    Half of one that a bound cuts off would leave out values that it holds. A time is in ms; else
    it is a share of its value, or a plain number where that is smaller.
    """
    if interval is None or None in interval:
        return ""
    low, high = interval
    half = max((high or 0.0) - value, value - (low or 0.0))
    if unit == "s" or abs(value) < half:
        return f"±{quantity(half, unit if unit == 's' else '')}"
    return f"±{percent(half / abs(value))}"


def parts_in_words(parts: ErrorParts, unit: str | None, value: float) -> str:
    """Return half of a 95 % interval from each cause alone.

    In ``unit``; in shares of ``value`` where that is None.
    """
    named = {
        "noise alone": parts.noise,
        "residuals": parts.residuals,
        "left-out flights": parts.left_out,
        "left-out terms": parts.terms,
        "step": parts.step,
        "voltmeter": parts.readings,
        "what the model lacks": parts.lack,
        "rest of the search": parts.search,
        "the rotors' limit": parts.limit,
        "a vehicle that flies otherwise": parts.astray,
    }
    least = MIN_REPORTED_SHARE * max(error or 0.0 for error in named.values())
    size = 1.0 if unit is not None else max(abs(value), 1e-300)
    return ", ".join(
        f"{cause} ±{quantity(Z95 * error / size, unit)}"
        for cause, error in named.items()
        if error and (cause == "noise alone" or error >= least)
    )


def _main_clause(reason: Reason) -> str:
    prior = f"the {'given' if reason.prior_given else 'default'} prior"
    source = "" if reason.channel is None else f", mostly from {_source(reason)}"
    direction = reason.direction
    return {
        ReasonCode.INTERVAL: f"±{_half_width(reason)} (95 %){source}",
        ReasonCode.REGRESSED: f"±{_half_width(reason)} (95 %), by regression of accelerations",
        ReasonCode.NULL_DIRECTION: "the flights do not identify it: "
        f"{'' if direction is None else direction_in_words(direction)} "
        f"The interval is that of {prior}",
        ReasonCode.NO_INFORMATION: "the flights hold no information about it; "
        f"the interval is that of {prior}",
        ReasonCode.WIDE_INTERVAL: f"the flights alone {_closeness(reason)}; the interval leans "
        f"on {prior}",
        ReasonCode.REFUTED: "the fitted vehicle does not fly what was recorded, so that its "
        f"flights say nothing about it; the interval is no narrower than that of {prior}",
        ReasonCode.PRIOR_DOMINATES: f"{reason.prior_share or 0.0:.0%} of the information about it "
        f"is that of {prior}",
        ReasonCode.NOT_WITH_ALL_FREE: "the flights do not identify it while all others are free",
        ReasonCode.IMPOSSIBLE_INERTIA: f"fitted to {reason.fitted_value or 0.0:.4g}, which no "
        "rigid body has together with the other moments of inertia",
        ReasonCode.COMBINATION_MEASURED: "measured only in combination with "
        f"{reason.correlated_with}, whose value alone was not measured",
        ReasonCode.MEASURED_ROUGHLY: f"measured only to ±{_half_width(reason)} (95 %)",
        ReasonCode.NOT_FITTED: "",
        ReasonCode.NOT_EXAMINED: "its interval was not computed",
    }[reason.code]


def _half_width(reason: Reason) -> str:
    """Return the longer side of an interval; of a logarithm, in shares of the value."""
    half, unit = reason.half_width, reason.unit
    if half is None:
        return ""
    return quantity(half if unit is not None else math.expm1(min(half, MAX_LOG_HALF_WIDTH)), unit)


def _closeness(reason: Reason) -> str:
    """Return how closely flights alone determine a coefficient."""
    if reason.unit is None and (reason.half_width or 0.0) > MAX_LOG_QUOTED:
        return "hardly tell it from ten times as much"
    return f"determine it only to ±{_half_width(reason)}"


def _source(reason: Reason) -> str:
    channel = str(reason.channel).replace("_", " ")
    return channel if reason.flight is None else f"{channel}, {reason.flight} above all"


def direction_in_words(direction: Direction) -> str:
    """Return one sentence on a combination of coefficients and how well it is determined."""
    moves = direction.moves
    known = (
        "is not identifiable"
        if direction.null
        else f"is known to ±{percent(Z95 * direction.error)}"
    )
    if direction.common_scale:
        group = listed([name for name in moves if name in scale_group()])
        return (
            f"{group} scale together: multiplied by one factor, every motion stays the same; "
            f"that factor {known}. Weigh the mass and fix it."
        )
    if len(moves) == 1:
        return f"{next(iter(moves))} alone: it {known}."
    rising = [name for name, move in moves.items() if move > 0]
    falling = [name for name, move in moves.items() if move < 0]
    proportion = ", ".join(f"{name} {move:+.0%}" for name, move in moves.items())
    if falling:
        verb = f"trade{'s' if len(rising) == 1 else ''} off against {listed(falling)}"
    else:
        verb = "rise and fall together"
    return f"{listed(rising)} {verb} (in the proportion {proportion}): their combination {known}."
