"""How well each coefficient is known, and why: codes and numbers, no prose.

Sentences are made from them in `tuner.uncertainty.verdict_texts`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from tuner.core.files import Part
from tuner.core.numerics import Z95
from tuner.uncertainty.directions import Direction

WELL_KNOWN = 0.05
"""Half the 95 % interval, relative to the coefficient's reference, below which it is well known."""
IDENTIFIABLE_ERROR = 0.25
"""Relative standard error from the flights alone above which they do not determine it."""
NO_INFORMATION_ERROR = 10.0
"""Relative standard error from the flights alone above which they hold no information about it."""
PRIOR_SHARE = 0.5
"""Share of the information above which a coefficient's interval is its prior's work."""
CONFUSED = 0.9
"""Correlation above which two coefficients are called hard to distinguish."""
INFLATED = 2.0
"""Inflation of the standard error above which the reason mentions model error."""


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
    """What a verdict rests on."""

    INTERVAL = "interval"
    """The flights determine it, to ``half_width``."""
    NULL_DIRECTION = "null_direction"
    """It takes part in ``direction``, along which nothing that was recorded changes."""
    NO_INFORMATION = "no_information"
    """With the others free, the flights hold no information about it."""
    WIDE_INTERVAL = "wide_interval"
    """The flights alone determine it no better than ``half_width``."""
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


@dataclass(frozen=True)
class Precision:
    """What is known about one coefficient, and from where.

    Attributes
    ----------
    name
        The coefficient.
    half_width, unit
        Half the 95 % interval, as in `Reason`.
    relative_half_width
        The same over the coefficient's reference.
    data_error
        Standard error from the flights alone over the reference.
    prior_share, prior_given
        As in `Reason`.
    inflation
        Factor on the standard error for residuals that are correlated in time.
    partner, correlation
        The coefficient that it is correlated with most.
    channel, flight
        As in `Reason`.
    bound
        At which bound the fit ended.
    """

    name: str
    half_width: float
    unit: str | None
    relative_half_width: float
    data_error: float
    prior_share: float
    prior_given: bool
    inflation: float
    partner: str | None
    correlation: float
    channel: str | None
    flight: str | None
    bound: Literal["lower", "upper"] | None


def judge(precision: Precision, directions: Sequence[Direction]) -> tuple[Verdict, Reason]:
    """Return the verdict on a fitted coefficient, and its reason."""
    if precision.data_error > IDENTIFIABLE_ERROR or precision.prior_share > PRIOR_SHARE:
        return Verdict.NOT_IDENTIFIABLE, _not_identifiable(precision, directions)
    well = precision.relative_half_width < WELL_KNOWN and precision.bound is None
    confused = not well and precision.partner and abs(precision.correlation) > CONFUSED
    return Verdict.WELL_KNOWN if well else Verdict.WEAKLY_KNOWN, Reason(
        code=ReasonCode.INTERVAL,
        half_width=precision.half_width,
        unit=precision.unit,
        channel=precision.channel,
        flight=precision.flight,
        correlated_with=precision.partner if confused else None,
        correlation=precision.correlation if confused else None,
        noise_inflation=precision.inflation if precision.inflation > INFLATED else None,
        bound=precision.bound,
    )


def _not_identifiable(precision: Precision, directions: Sequence[Direction]) -> Reason:
    given, bound = precision.prior_given, precision.bound
    for direction in directions:
        if direction.null and precision.name in direction.moves and len(direction.moves) > 1:
            code = ReasonCode.NULL_DIRECTION
            return Reason(code=code, direction=direction, prior_given=given, bound=bound)
    if precision.data_error >= NO_INFORMATION_ERROR:
        return Reason(code=ReasonCode.NO_INFORMATION, prior_given=given, bound=bound)
    if precision.data_error > IDENTIFIABLE_ERROR:
        half_width = Z95 * precision.data_error
        code = ReasonCode.WIDE_INTERVAL
        return Reason(code=code, half_width=half_width, prior_given=given, bound=bound)
    return Reason(
        code=ReasonCode.PRIOR_DOMINATES,
        prior_share=precision.prior_share,
        prior_given=given,
        bound=bound,
    )


def judge_after_holding(
    name: str, verdict: Verdict, reason: Reason, stand_in: str
) -> tuple[Verdict, Reason]:
    """Return the judgement on a coefficient that the flights did not identify with all free.

    Parameters
    ----------
    name
        The coefficient.
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


def judge_regressed(
    std_error: float, value: float, unit: str, *, relative: bool
) -> tuple[Verdict, Reason]:
    """Return the judgement on a coefficient by regression of accelerations.

    ``relative``: whether its half-width is given as a share of its value.
    """
    size = max(abs(value), 1e-300)
    half_width = Z95 * std_error / (size if relative else 1.0)
    shown = None if relative else unit
    if std_error / size > IDENTIFIABLE_ERROR:
        return Verdict.NOT_IDENTIFIABLE, _told(ReasonCode.WIDE_INTERVAL, half_width, shown)
    well = Z95 * std_error / size < WELL_KNOWN
    verdict = Verdict.WELL_KNOWN if well else Verdict.WEAKLY_KNOWN
    return verdict, _told(ReasonCode.REGRESSED, half_width, shown)


def _told(code: ReasonCode, half_width: float, unit: str | None) -> Reason:
    return Reason(code=code, half_width=half_width, unit=unit)


def judge_impossible_inertia(fitted_value: float) -> tuple[Verdict, Reason]:
    """Return the judgement on a moment of inertia that was set back, kg m²."""
    code = ReasonCode.IMPOSSIBLE_INERTIA
    return Verdict.HELD, Reason(code=code, fitted_value=fitted_value)
