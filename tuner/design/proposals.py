"""Proposals of flights and signals: ``next_flight.json``, and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from annotated_types import Interval, Len
from pydantic import JsonValue, model_validator

from tuner.core.disk import write_text
from tuner.core.files import Part, ResultFile, csv_text
from tuner.core.phrases import listed, percent
from tuner.core.yaml_section import refuse

NEXT_FLIGHT_TABLE = "next_flight.csv"
MAX_WORTHWHILE_SHARE = 0.9
"""A flight or signal that leaves a larger share of an interval does not narrow it."""
HALVED_RANGE = (0.45, 0.55)
"""Shares of an interval that are called a half."""
MAX_EFFECTS = 4
"""A sentence names so many coefficients, those that gain most."""


class LogProposal(Part):
    """A signal to log, and its effect on the intervals.

    Attributes
    ----------
    signal
        Its name.
    change
        Whether it would be ``added``, logged ``faster``, or so fast that it can be ``fed`` into the
        simulation in place of the attitude.
    rate
        Hz at which it would be logged.
    noise
        Its assumed standard deviation in its unit; None if it is logged already.
    shrinks
        Coefficient -> width of its interval with the signal over that without, which is the
        prior's if the coefficient is not fitted.
    """

    signal: str
    change: Literal["added", "faster", "fed"]
    rate: float
    noise: float | None = None
    shrinks: dict[str, float]


Share = Annotated[float, Interval(ge=0, le=1e6)]


class Proposal(Part):
    """A flight to fly, and its effect on the intervals.

    Attributes
    ----------
    name
        Shape, size and speed in words.
    trajectory
        The options of ``tune simulate`` for it.
    shrinks
        Coefficient -> width of its interval after the flight over that before.
    volume
        Factor on the geometric mean of the half axes of the fitted coefficients' confidence
        ellipsoid.
    """

    name: Annotated[str, Len(1)]
    trajectory: dict[str, JsonValue]
    shrinks: dict[str, Share]
    volume: Share

    @property
    def mean(self) -> float:
        """Root mean square of the factors, which an A-optimal flight minimises."""
        return float(np.sqrt(np.mean(np.square(list(self.shrinks.values())))))


class Proposals(ResultFile):
    """The content of ``next_flight.json``.

    Attributes
    ----------
    arena
        m along x, y and up.
    seconds
        Duration of each flight.
    targets
        The fitted coefficients that are not well known yet. If ``all_known``, the fixed ones that
        would not be well known if fitted, or else all fitted ones.
    fixed_targets
        Those of the targets that were not fitted.
    flights
        Best first.
    """

    FILE = "next_flight.json"

    schema_version: int = 2
    arena: tuple[float, float, float]
    seconds: float
    targets: list[str]
    fixed_targets: list[str]
    all_known: bool
    flights: list[Proposal]

    @model_validator(mode="after")
    def _tell_all_of_each_flight(self) -> Self:
        for flight in self.flights:
            if not set(self.targets) <= set(flight.shrinks):
                raise refuse(f"lacks what {flight.name} would narrow", "was it edited?")
        return self

    def write(self, folder: Path) -> None:
        """Write ``next_flight.json`` and, for other programs, ``next_flight.csv``."""
        super().write(folder)
        header = ("flight", "mean_shrink", "volume_shrink", *self.targets)
        rows = [
            [flight.name, flight.mean, flight.volume, *map(flight.shrinks.get, self.targets)]
            for flight in self.flights
        ]
        write_text(folder / NEXT_FLIGHT_TABLE, csv_text(header, rows))


UNITS: Mapping[str, str] = {"rotor_speed": " rad/s", "body_rate": " rad/s", "command": ""}


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
        if share > MAX_WORTHWHILE_SHARE:
            not_narrowed.append(label)
        else:
            gains.setdefault(best.name, []).append((share, label))
    sentences = []
    for flight, shares in sorted(gains.items(), key=lambda item: min(item[1])):
        effects = effects_in_words(sorted(shares))
        sentences.append(f"{flight[0].upper()}{flight[1:]} would {effects}.")
    if not_narrowed:
        sentences.append(
            f"No single flight in this arena would narrow the interval of {listed(not_narrowed)} "
            f"by more than {percent(1 - MAX_WORTHWHILE_SHARE)}."
        )
    return sentences


def effects_in_words(shares: Sequence[tuple[float, str]]) -> str:
    """Return the effects on intervals that keep a share of their width, least shares first."""
    narrowed = [f"{of} to {percent(share)}" for share, of in shares if share < HALVED_RANGE[0]]
    effects = [f"narrow the interval of {listed(narrowed)} of what it is"] if narrowed else []
    for share, of in shares[len(narrowed) :]:
        interval = f"the interval of {of}"
        halved = share <= HALVED_RANGE[1]
        effects.append(
            f"halve {interval}" if halved else f"narrow {interval} by {percent(1 - share)}"
        )
    return listed(effects)


def log_in_words(proposal: LogProposal) -> str:
    """Return a sentence on a signal to log, and its effects."""
    signal, rate = proposal.signal.replace("_", " "), f"{proposal.rate:.0f} Hz"
    if proposal.change == "faster":
        share = min(proposal.shrinks.values())
        return (
            f"Log the {signal} at {rate}: as far as the simulation misses what lies between its "
            f"samples, that would {effects_in_words([(share, 'every coefficient')])}."
        )
    fed = proposal.change == "fed"
    gains = sorted(
        (share, f"{name} (not fitted so far)" if fed else name)
        for name, share in proposal.shrinks.items()
        if share < MAX_WORTHWHILE_SHARE
    )
    effects = effects_in_words(gains[:MAX_EFFECTS])
    if fed:
        return (
            f"Log the {signal} at {rate}, so that it can be fed in and the attitude need not be: "
            f"it would {effects}."
        )
    assert proposal.noise is not None
    noise = f"{proposal.noise:.2g}{UNITS.get(proposal.signal, '')}"
    return f"Log the {signal}, at {rate} and good to {noise}: it would {effects}."
