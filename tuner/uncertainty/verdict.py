"""Well known, weakly known or not identifiable, and why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from tuner.uncertainty.directions import Direction, percent

WELL_KNOWN = 0.05
"""Half the 95 % interval, relative to the coefficient's reference, below which it is well known."""
IDENTIFIABLE_ERROR = 0.25
"""Relative standard error from the flights alone above which they do not determine it."""
PRIOR_SHARE = 0.5
"""Share of what is known above which a coefficient's interval is its prior's work."""
CONFUSED = 0.9
"""Correlation above which two coefficients are called hard to tell apart."""
INFLATED = 2.0
"""Inflation of the standard error above which the reason mentions model error."""


class Verdict(Enum):
    """How well a coefficient is known."""

    WELL_KNOWN = "well known"
    WEAKLY_KNOWN = "weakly known"
    NOT_IDENTIFIABLE = "not identifiable"


@dataclass(frozen=True)
class Standing:
    """What a verdict rests on.

    Attributes
    ----------
    name
        The coefficient.
    interval
        Half the 95 % interval for people: a percentage or with its unit.
    half_width
        Half the 95 % interval over the reference.
    data_error
        Standard error from the flights alone over the reference.
    prior_share
        Share of the prior in what is known, 0 to 1.
    prior_given
        Whether the user gave the prior.
    inflation
        Of the standard error by residuals that are correlated in time.
    partner, correlation
        The coefficient it is confused with most.
    source
        Where most of what is known comes from, in words; empty if from nowhere.
    bound
        ``lower`` or ``upper`` if the fit ended there.
    """

    name: str
    interval: str
    half_width: float
    data_error: float
    prior_share: float
    prior_given: bool
    inflation: float
    partner: str | None
    correlation: float
    source: str
    bound: str | None


def judge(standing: Standing, directions: Sequence[Direction]) -> tuple[Verdict, str]:
    """Return the verdict and its reason, a phrase for people."""
    if standing.data_error > IDENTIFIABLE_ERROR or standing.prior_share > PRIOR_SHARE:
        return Verdict.NOT_IDENTIFIABLE, _why_not(standing, directions) + _at_bound(standing)
    well = standing.half_width < WELL_KNOWN and standing.bound is None
    reason = f"±{standing.interval} (95 %)"
    if standing.source:
        reason += f", mostly from {standing.source}"
    if not well and standing.partner and abs(standing.correlation) > CONFUSED:
        reason += (
            f"; hard to tell from {standing.partner} (correlation {standing.correlation:+.2f})"
        )
    if standing.inflation > INFLATED:
        reason += (
            f"; residuals are not white noise, which widens the interval {standing.inflation:.1f} "
            "times"
        )
    return Verdict.WELL_KNOWN if well else Verdict.WEAKLY_KNOWN, reason + _at_bound(standing)


def _why_not(standing: Standing, directions: Sequence[Direction]) -> str:
    prior = "the prior that was given" if standing.prior_given else "the default prior"
    for direction in directions:
        if direction.null and standing.name in direction.moves:
            others = len(direction.moves) > 1
            reason = f"the flights cannot tell it: {direction.text}" if others else ""
            if reason:
                return f"{reason} The interval is {prior}'s."
    if standing.data_error > IDENTIFIABLE_ERROR:
        said = (
            f"the flights alone leave it open to ±{percent(1.96 * standing.data_error)}"
            if standing.data_error < 10
            else "it leaves no trace in the flights"
        )
        return f"{said}; the interval is {prior}'s"
    return f"{standing.prior_share:.0%} of what is known comes from {prior}"


def _at_bound(standing: Standing) -> str:
    return f"; the fit ended at its {standing.bound} bound" if standing.bound else ""
