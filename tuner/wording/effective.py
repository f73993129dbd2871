"""A run's second answer in words: what Gazebo lacks, and what that costs."""

from __future__ import annotations

from collections.abc import Callable

from tuner.coefficients import REGISTRY, Coefficient, NotCarried, Written
from tuner.result import EffectiveResult, LostTerm, PoseRmse
from tuner.wording.phrases import listed


def effective_in_words(effective: EffectiveResult) -> str:
    """Return what the second answer is and how it flies, in sentences."""
    lost = listed([term.group for term in effective.lost])
    text = (
        f"Gazebo cannot fly {lost}. With its effective coefficients it misses the flights by "
        f"{rmse_in_words(effective.rmse_effective)}, the physical model by "
        f"{rmse_in_words(effective.rmse_physical)}; with the physical coefficients and without "
        f"these terms it would be {rmse_in_words(effective.rmse_unfitted)}."
    )
    if effective.carried:
        text += f" Gazebo has a place for {listed(effective.carried)}."
    return text


def rmse_in_words(rmse: PoseRmse) -> str:
    """Return an RMSE with units of a readable size."""
    if rmse.position is None or rmse.attitude is None:
        return "a crash"
    return f"{metres(rmse.position)} and {rmse.attitude:.2g}°"


def metres(value: float) -> str:
    """Return a length in m, cm or mm."""
    if value >= 1.0:
        return f"{value:.3g} m"
    return f"{100 * value:.2g} cm" if value >= 0.01 else f"{1000 * value:.2g} mm"


def what_is_exported(effective: EffectiveResult) -> str:
    """Return, as a clause, what the numbers of an export are."""
    lost = listed([term.group for term in effective.lost])
    return (
        f"effective coefficients, not physical ones: Gazebo lacks {lost}, and misses the flights "
        f"by {rmse_in_words(effective.rmse_effective)} where all terms miss them by "
        f"{rmse_in_words(effective.rmse_physical)}"
    )


def what_is_lost(
    effective: EffectiveResult, entry: Callable[[Coefficient], Written | NotCarried | None]
) -> tuple[str, ...]:
    """Return a clause on each group that is lost: why a target lacks it, and what it is worth."""
    return tuple(
        f"{term.group} is not exported: {reason}; without it alone the flights are missed by "
        f"{rmse_in_words(term.rmse_without)}"
        for term in effective.lost
        if (reason := _reason(term, entry))
    )


def _reason(term: LostTerm, entry: Callable[[Coefficient], Written | NotCarried | None]) -> str:
    held = entry(REGISTRY[term.names[0]])
    return held.reason if isinstance(held, NotCarried) else ""
