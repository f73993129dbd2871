"""The flights in stretches of time, each with what it says: the units that errors scatter by."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Inverse
from tuner.objective.information import BLOCK, FisherInformation

Array = NDArray[np.float64]

STRETCH = 8.0
"""s beyond which what disturbs a flight is forgotten: gusts last a second, and the closed loop
makes a slow wandering of them. Of lengths from 2 to 18 s the one whose intervals held the truth as
often as they should, and were narrow: linear refits to simulated flights in gusts."""
FEWEST_STRETCHES = 16
"""Of short recordings, stretches are shorter, so that there are as many."""
FEWEST_PARTS = 4
"""Where there are fewer flights to leave out in turn, each is cut into parts, none of them shorter
than a stretch: those would show what stretches show."""


@dataclass(frozen=True)
class Stretches:
    """Information (N, K, K) and score (N, K) of N stretches, all channels together.

    The scores are those at the minimum of the loss, which a search ends near: what one strong
    flight says, it says of the last thousandth of a step too, and so loudly that without it the
    others would seem to be pulled away.
    """

    information: Array
    score: Array

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.score)

    def projected(self, axes: Array) -> Stretches:
        """Return what they say along other axes, the columns of a matrix (K, L)."""
        return Stretches(axes.T @ self.information @ axes, self.score @ axes)


def stretches_of(information: FisherInformation) -> Stretches:
    """Return all flights in stretches of `STRETCH`, shorter ones where that makes too few."""
    total = float(np.sum(_ends(information)))
    return _cut(information, float(np.clip(total / FEWEST_STRETCHES, BLOCK, STRETCH)))


def parts_of(information: FisherInformation) -> Stretches:
    """Return the flights as they can be left out in turn: whole, or a few parts of each."""
    ends = _ends(information)
    longest = float(ends.max())
    each = min(-(-FEWEST_PARTS // len(ends)), int(longest / STRETCH))
    return _cut(information, longest / each if each > 1 else np.inf)


def _ends(information: FisherInformation) -> Array:
    """Return the s (N,) at which the flights' last segments end."""
    blocks = information.blocks.shape[2]
    ends = information.begins + blocks * BLOCK
    return np.array(
        [ends[information.flight == flight].max() for flight in np.unique(information.flight)]
    )


def _cut(information: FisherInformation, seconds: float) -> Stretches:
    blocks = information.blocks.shape[2]
    times = information.begins[:, None] + (np.arange(blocks) + 0.5) * BLOCK
    numbers = np.floor(times / seconds).astype(int)
    flights = np.broadcast_to(information.flight[:, None], numbers.shape)
    keys = np.stack([flights.ravel(), numbers.ravel()], axis=-1)
    found, member = np.unique(keys, axis=0, return_inverse=True)
    count = information.score.shape[-1]
    sums = Stretches(np.zeros((len(found), count, count)), np.zeros((len(found), count)))
    np.add.at(sums.information, member, information.blocks.sum(axis=0).reshape(-1, count, count))
    np.add.at(sums.score, member, information.score.sum(axis=0).reshape(-1, count))
    to_minimum = -Inverse.of(information.total, information.given).matrix @ information.slope
    sums = replace(sums, score=sums.score + sums.information @ to_minimum)
    flown = np.any(sums.information != 0.0, axis=(1, 2))
    return Stretches(sums.information[flown], sums.score[flown])
