"""Verdicts on coefficients and their reasons, as codes and numbers.

`tuner.uncertainty.verdict_texts` makes sentences from them.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import Any, Literal

from tuner.core.files import Part
from tuner.core.numerics import Z95

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


class ReasonCode(StrEnum):
    """Main reason of a verdict."""

    INTERVAL = "interval"
    """The flights determine it, to ``half_width``."""
    NULL_DIRECTION = "null_direction"
    """It takes part in ``direction``, along which nothing that was recorded changes."""
    NO_INFORMATION = "no_information"
    """With the others free, the flights hold no information about it."""
    WIDE_INTERVAL = "wide_interval"
    """The flights alone determine it no better than ``half_width``."""
    REFUTED = "refuted"
    """The fitted vehicle flies otherwise than the recorded one: flights say nothing about it."""
    PRIOR_DOMINATES = "prior_dominates"
    """``prior_share`` of the information about it comes from its prior."""
    NOT_WITH_ALL_FREE = "not_with_all_free"
    """Not identifiable before others were held, although it would be now."""
    IMPOSSIBLE_INERTIA = "impossible_inertia"
    """``fitted_value`` and the other moments of inertia are those of no rigid body."""
    COMBINATION_MEASURED = "combination_measured"
    """Ground measurements determine it together with ``correlated_with`` only."""
    MEASURED_ROUGHLY = "measured_roughly"
    """Ground measurements determine it no better than ``half_width``."""
    REGRESSED = "regressed"
    """A regression of recorded accelerations determines it, to ``half_width``."""
    NOT_FITTED = "not_fitted"
    """It is fixed."""
    NOT_EXAMINED = "not_examined"
    """It was fitted, and how well it is known was not computed, or not yet."""


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
    known: Reason,
    directions: Sequence[Direction],
    *,
    relative_half_width: float,
    data_error: float,
    refuted: bool = False,
) -> tuple[Verdict, Reason]:
    """Return the verdict on a fitted coefficient, and its reason.

    Parameters
    ----------
    known
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
        return Reason(code=code, **{n: getattr(known, n) for n in (*kept, "bound")}, **more)

    if refuted:
        return Verdict.NOT_IDENTIFIABLE, reason(ReasonCode.REFUTED, "prior_given")
    prior_share = known.prior_share or 0.0
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
    well = relative_half_width < WELL_KNOWN and known.bound is None
    kept = ["half_width", "unit", "channel", "flight"]
    if not well and known.correlated_with and abs(known.correlation or 0.0) > HIGH_CORRELATION:
        kept += ["correlated_with", "correlation"]
    if (known.noise_inflation or 1.0) > HIGH_INFLATION:
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


def judge_impossible_inertia(fitted_value: float) -> tuple[Verdict, Reason]:
    """Return the judgement on a moment of inertia that was set back, kg m²."""
    code = ReasonCode.IMPOSSIBLE_INERTIA
    return Verdict.HELD, Reason(code=code, fitted_value=fitted_value)
