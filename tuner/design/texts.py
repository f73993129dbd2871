"""What to fly and what to log next, and for which coefficient, as sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tuner.core.phrases import listed
from tuner.design.log_proposal import LogProposal
from tuner.design.next_flight_json import Proposals

WORTH_FLYING = 0.9
"""An interval that a flight leaves wider than this share of what it was is not narrowed."""
HALVED = (0.45, 0.55)
"""Shares of an interval that are called half of it."""
UNITS: Mapping[str, str] = {"rotor_speed": " rad/s", "body_rate": " rad/s", "command": ""}
MOST = 4
"""Coefficients that a sentence names, those that gain most."""


def proposals_in_words(proposals: Proposals) -> list[str]:
    """Return a sentence on each flight worth flying, the greatest gain first, and on the rest.

    The last sentence names the coefficients whose intervals no single flight would narrow.
    """
    if not proposals.flights:
        return ["No candidate flight stays in the air inside this arena."]
    gains: dict[str, list[tuple[float, str]]] = {}
    not_narrowed = []
    for target in proposals.targets:
        label = f"{target} (fixed so far)" if target in proposals.fixed_targets else target
        best = min(proposals.flights, key=lambda flight: flight.shrinks[target])
        share = best.shrinks[target]
        if share > WORTH_FLYING:
            not_narrowed.append(label)
        else:
            gains.setdefault(best.name, []).append((share, label))
    sentences = []
    for flight, shares in sorted(gains.items(), key=lambda item: min(item[1])):
        effects = listed([effect(share, label) for share, label in sorted(shares)])
        sentences.append(f"{flight[0].upper()}{flight[1:]} would {effects}.")
    if not_narrowed:
        sentences.append(
            f"No single flight in this arena would narrow the interval of {listed(not_narrowed)} "
            f"by more than {1 - WORTH_FLYING:.0%}."
        )
    return sentences


def effect(share: float, label: str) -> str:
    """Return what would become of an interval that keeps a share of its width; of all by default.

    ``label`` names the coefficient.
    """
    of = f"the interval of {label}" if label else "every interval"
    if HALVED[0] <= share <= HALVED[1]:
        return f"halve {of}"
    if share < HALVED[0]:
        return f"narrow {of} to {share:.0%} of what it is"
    return f"narrow {of} by {1 - share:.0%}"


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
