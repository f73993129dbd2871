"""How a search ended, as a sentence."""

from __future__ import annotations

from tuner.result import Ending


def ending_sentence(ending: Ending) -> str:
    """Return why a search stopped."""
    if ending is Ending.NO_FURTHER_GAIN:
        return "The search converged: its last steps gained nothing."
    return "The search stopped at its limit of iterations, before it converged."
