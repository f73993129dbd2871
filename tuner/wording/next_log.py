"""What to log next time, as sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tuner.design.log_proposal import LogProposal
from tuner.wording.phrases import listed
from tuner.wording.proposals import WORTH_FLYING, effect

UNITS: Mapping[str, str] = {"rotor_speed": " rad/s", "body_rate": " rad/s", "command": ""}
MOST = 4
"""Coefficients that a sentence names, those that gain most."""


def next_log_in_words(proposals: Sequence[LogProposal]) -> list[str]:
    """Return a sentence on each signal, the most helpful first."""
    return [_sentence(proposal) for proposal in proposals]


def _sentence(proposal: LogProposal) -> str:
    signal, rate = proposal.signal.replace("_", " "), f"{proposal.rate:.0f} Hz"
    if proposal.change == "faster":
        share = min(proposal.shrinks.values())
        return (
            f"Log the {signal} at {rate}: as far as the simulation misses what lies between its "
            f"samples, that would {effect(share, '')}."
        )
    fed = proposal.change == "fed"
    gains = sorted(
        (share, f"{name} (not fitted so far)" if fed else name)
        for name, share in proposal.shrinks.items()
        if share < WORTH_FLYING
    )
    effects = listed([effect(share, label) for share, label in gains[:MOST]])
    if fed:
        return (
            f"Log the {signal} at {rate}, so that it can be fed in and the attitude need not be: "
            f"it would {effects}."
        )
    assert proposal.noise is not None
    noise = f"{proposal.noise:.2g}{UNITS.get(proposal.signal, '')}"
    return f"Log the {signal}, at {rate} and good to {noise}: it would {effects}."
