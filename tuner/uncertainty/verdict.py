"""Verdicts on coefficients and their reasons, as codes and numbers, and as sentences."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Literal

from tuner.core.files import FiniteOrNone, Part
from tuner.core.numerics import Z95
from tuner.core.phrases import CodeWithText, listed, percent, quantity
from tuner.vehicle import scale_group

WELL_KNOWN = 0.05
"""Half the 95 % interval, relative to the coefficient's reference, below which it is well known."""
MAX_IDENTIFIABLE_ERROR = 0.25
"""Relative standard error from the flights alone above which they do not determine it."""
NO_INFORMATION_ERROR = 10.0
"""Relative standard error from the flights alone above which they have no information."""
MAX_PRIOR_SHARE = 0.5
"""Share of the prior in the information above which it dominates."""
HIGH_CORRELATION = 0.9
"""Correlation above which two coefficients are called hard to distinguish."""
HIGH_INFLATION = 2.0
"""Inflation of the standard error above which the reason mentions model error."""


class Direction(Part):
    """A combination of coefficients.

    Attributes
    ----------
    moves
        Name -> relative change (logarithmic coefficients) or change in units of the coefficient's
        reference; the largest is ±1. Only coefficients that move by more than
        `tuner.uncertainty.estimates.MIN_MOVE_NAMED`.
    error
        Standard error along the direction from the flights alone: 0.1 means that all moves times
        ten percent are one standard error away.
    null
        Whether the flights do not determine it at all.
    common_scale
        Whether it multiplies masses and forces by one factor, which changes no motion.
    """

    moves: dict[str, float]
    error: float
    null: bool
    common_scale: bool


class ErrorParts(Part):
    """Standard errors of one coefficient, in its unit; the quoted one holds all of them.

    Each is that of a normal distribution with the 95 % interval that is meant, which is wider where
    few stretches of time or few flights speak.

    Attributes
    ----------
    noise
        Were measurement noise alone in the residuals.
    residuals
        With all that is in them: disturbances and what the model lacks.
    left_out
        As the estimate moves when flights are left out in turn (parts of them where they are few);
        None where there are no three.
    terms
        As it would move with terms that were tried and not kept, and where errors of measured
        rotor speeds pass for inertia; for a gain of the rate controller how far off recorded
        commands put it. None where none was tried.
    step
        Its move when the physics step is halved, and for a rotor's lag that it may be off by half
        of the finest step in which simulators take it; None where that was not asked.
    readings
        How it scatters when the battery's voltmeter is read again, with errors like those that it
        made; with commands fed in, how far it would move with recorded rotor speeds instead. None
        where there is neither, or disturbances are estimated.
    lack
        How far it would move with the laws that recorded accelerations follow beside the model's;
        None where none was found.
    search
        How far one more linear step would move it: a search ends where its steps gain nothing.
    limit
        How far it would move were the rotors' limit, ``max_rotor_velocity``, a quarter off; None
        where rotor speeds were recorded.
    astray
        The standard deviation of its prior, where the fitted vehicle crashes on a fitted flight,
        or flies most of them otherwise than they were recorded; None where it does not.
    """

    noise: FiniteOrNone
    residuals: FiniteOrNone
    left_out: FiniteOrNone = None
    terms: FiniteOrNone = None
    step: FiniteOrNone = None
    readings: FiniteOrNone = None
    lack: FiniteOrNone = None
    search: FiniteOrNone = None
    limit: FiniteOrNone = None
    astray: FiniteOrNone = None


class Verdict(StrEnum):
    """How well a coefficient is known, or why it was not asked."""

    WELL_KNOWN = "well_known"
    WEAKLY_KNOWN = "weakly_known"
    NOT_IDENTIFIABLE = "not_identifiable"
    FIXED = "fixed"
    """Not fitted, as the settings say."""
    HELD = "held"
    """Kept at its initial value because the flights do not identify it."""
    NOT_EXAMINED = "not_examined"
    """Fitted, and its interval was not computed, or not yet."""
    TIED = "tied"
    """A constant multiple of another coefficient, as the job file says."""


class ReasonCode(CodeWithText):
    """Main reason of a verdict; ``{prior}`` and so on in its text are those of `_main_clause`."""

    INTERVAL = "interval", "±{half_width} (95 %){source}"
    REGRESSED = "regressed", "±{half_width} (95 %), by regression of accelerations"
    NULL_DIRECTION = (
        "null_direction",
        "the flights do not identify it: {direction} The interval is that of {prior}",
    )
    NO_INFORMATION = (
        "no_information",
        "the flights hold no information about it; the interval is that of {prior}",
    )
    WIDE_INTERVAL = (
        "wide_interval",
        "the flights alone {closeness}; the interval leans on {prior}",
    )
    REFUTED = (
        "refuted",
        (
            "the fitted vehicle does not fly what was recorded, so that its flights say nothing "
            "about it; the interval is no narrower than that of {prior}"
        ),
    )
    PRIOR_DOMINATES = (
        "prior_dominates",
        "{prior_share} of the information about it is that of {prior}",
    )
    NOT_WITH_ALL_FREE = (
        "not_with_all_free",  # although it would be now, with others held
        "the flights do not identify it while all others are free",
    )
    IMPOSSIBLE_INERTIA = (
        "impossible_inertia",
        (
            "fitted to {fitted_value:.4g}, which no rigid body has together with the other moments "
            "of inertia"
        ),
    )
    COMBINATION_MEASURED = (
        "combination_measured",
        ("measured only in combination with {correlated_with}, whose value alone was not measured"),
    )
    MEASURED_ROUGHLY = "measured_roughly", "measured only to ±{half_width} (95 %)"
    NOT_FITTED = "not_fitted", ""
    NOT_EXAMINED = "not_examined", "its interval was not computed"


class Reason(Part):
    """Why a verdict was given; what does not bear on it is None.

    Attributes
    ----------
    code
        The main reason, which says which numbers are given.
    half_width, unit
        Half the 95 % interval in ``unit``; as a share of the value where ``unit`` is None.
    channel, flight
        Where most of the information comes from; ``flight`` only where one contributes more than
        the others.
    correlated_with, correlation
        The coefficient that it is hard to distinguish from.
    noise_inflation
        Factor by which residuals that are no white noise widen the interval.
    bound
        At which bound the fit ended.
    prior_share, prior_given
        Share of the prior in the information, and whether the user gave the prior.
    direction
        The combination of coefficients that the flights do not determine.
    tied_to
        The coefficient that it is a constant multiple of; all else refers to that coefficient.
    given_held
        The coefficient held at its initial value, given which alone this one was fitted.
    fitted_value
        Where the fit ended, for one that was set back from there.
    """

    code: ReasonCode
    half_width: float | None = None
    unit: str | None = None
    channel: str | None = None
    flight: str | None = None
    correlated_with: str | None = None
    correlation: float | None = None
    noise_inflation: float | None = None
    bound: Literal["lower", "upper"] | None = None
    prior_share: float | None = None
    prior_given: bool | None = None
    direction: Direction | None = None
    tied_to: str | None = None
    given_held: str | None = None
    fitted_value: float | None = None

    @property
    def identifiable(self) -> bool:
        """Whether the flights determine the coefficient."""
        determined = (ReasonCode.INTERVAL, ReasonCode.REGRESSED)
        return self.code in determined and self.given_held is None


NOT_FITTED = Reason(code=ReasonCode.NOT_FITTED)
"""Why a coefficient is `Verdict.FIXED`."""
NOT_EXAMINED = Reason(code=ReasonCode.NOT_EXAMINED)
"""Why a coefficient is `Verdict.NOT_EXAMINED`."""


def judge(
    name: str,
    numbers: Reason,
    directions: Sequence[Direction],
    *,
    relative_half_width: float,
    data_error: float,
    refuted: bool = False,
) -> tuple[Verdict, Reason]:
    """Return the verdict on a fitted coefficient, and its reason.

    Parameters
    ----------
    numbers
        All fields of a reason; the returned one keeps those relevant to the verdict.
    directions
        Worst-determined combinations.
    relative_half_width, data_error
        Half the 95 % interval, and the standard error from the flights alone, over the
        coefficient's reference.
    refuted
        Whether the flights contradict all that they say.
    """

    def reason(code: ReasonCode, *kept: str, **more: Any) -> Reason:
        return Reason(code=code, **{n: getattr(numbers, n) for n in (*kept, "bound")}, **more)

    if refuted:
        return Verdict.NOT_IDENTIFIABLE, reason(ReasonCode.REFUTED, "prior_given")
    prior_share = numbers.prior_share or 0.0
    if data_error > MAX_IDENTIFIABLE_ERROR or prior_share > MAX_PRIOR_SHARE:
        for direction in directions:
            if direction.null and name in direction.moves and len(direction.moves) > 1:
                why = reason(ReasonCode.NULL_DIRECTION, "prior_given", direction=direction)
                break
        else:
            if data_error >= NO_INFORMATION_ERROR:
                why = reason(ReasonCode.NO_INFORMATION, "prior_given")
            elif data_error > MAX_IDENTIFIABLE_ERROR:
                half_width = Z95 * data_error
                why = reason(ReasonCode.WIDE_INTERVAL, "prior_given", half_width=half_width)
            else:
                why = reason(ReasonCode.PRIOR_DOMINATES, "prior_share", "prior_given")
        return Verdict.NOT_IDENTIFIABLE, why
    well = relative_half_width < WELL_KNOWN and numbers.bound is None
    kept = ["half_width", "unit", "channel", "flight"]
    if not well and numbers.correlated_with and abs(numbers.correlation or 0.0) > HIGH_CORRELATION:
        kept += ["correlated_with", "correlation"]
    if (numbers.noise_inflation or 1.0) > HIGH_INFLATION:
        kept.append("noise_inflation")
    verdict = Verdict.WELL_KNOWN if well else Verdict.WEAKLY_KNOWN
    return verdict, reason(ReasonCode.INTERVAL, *kept)


def judge_after_holding(
    name: str, verdict: Verdict, reason: Reason, stand_in: str
) -> tuple[Verdict, Reason]:
    """Return the judgement on a coefficient that the flights did not identify with all free.

    Parameters
    ----------
    verdict, reason
        Of the examination after the fit with the stand-ins held.
    stand_in
        The coefficient held at its initial value: itself, or one that it trades off against.
    """
    if reason.identifiable:
        reason = Reason(code=ReasonCode.NOT_WITH_ALL_FREE, tied_to=reason.tied_to)
    if stand_in not in {name, reason.tied_to}:
        reason = reason.model_copy(update={"given_held": stand_in})
    if verdict is Verdict.TIED:
        return verdict, reason
    return Verdict.HELD if stand_in == name else Verdict.NOT_IDENTIFIABLE, reason


def judge_by_error(
    error: float,
    relative: float,
    unit: str | None,
    *,
    known: ReasonCode,
    roughly: ReasonCode,
    channel: str | None = None,
) -> tuple[Verdict, Reason]:
    """Return the judgement on a coefficient of which a standard error is all that is known.

    Parameters
    ----------
    error, unit
        In ``unit``; a share of the value where that is None.
    relative
        The error as a share of the value.
    known, roughly
        Reasons for a coefficient that is determined, and for one that is not.
    channel
        Where most of the information comes from.
    """
    half_width = Z95 * error
    if relative > MAX_IDENTIFIABLE_ERROR:
        return Verdict.NOT_IDENTIFIABLE, Reason(code=roughly, half_width=half_width, unit=unit)
    well = Z95 * relative < WELL_KNOWN
    verdict = Verdict.WELL_KNOWN if well else Verdict.WEAKLY_KNOWN
    return verdict, Reason(code=known, half_width=half_width, unit=unit, channel=channel)


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
        "recorded inputs": parts.readings,
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
    text: str = reason.code.text
    return text.format(
        prior=f"the {'given' if reason.prior_given else 'default'} prior",
        source="" if reason.channel is None else f", mostly from {_source(reason)}",
        direction="" if reason.direction is None else direction_in_words(reason.direction),
        half_width=_half_width(reason),
        closeness=_closeness(reason),
        prior_share=percent(reason.prior_share or 0.0),
        fitted_value=reason.fitted_value or 0.0,
        correlated_with=reason.correlated_with,
    )


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
    precision = (
        "is not identifiable"
        if direction.null
        else f"is known to ±{percent(Z95 * direction.error)}"
    )
    if direction.common_scale:
        group = listed([name for name in moves if name in scale_group()])
        return (
            f"{group} scale together: multiplied by one factor, every motion stays the same; "
            f"that factor {precision}. Weigh the mass and fix it."
        )
    if len(moves) == 1:
        return f"{next(iter(moves))} alone: it {precision}."
    rising = [name for name, move in moves.items() if move > 0]
    falling = [name for name, move in moves.items() if move < 0]
    proportion = ", ".join(f"{name} {100 * move:+.0f} %" for name, move in moves.items())
    if falling:
        verb = f"trade{'s' if len(rising) == 1 else ''} off against {listed(falling)}"
    else:
        verb = "rise and fall together"
    return (
        f"{listed(rising)} {verb} (in the proportion {proportion}): their combination {precision}."
    )
