"""How strong disturbances are and how long they last: what makes the recordings likeliest.

The likelihood is that of the innovations (Schweppe 1965). Every strength moves to where a parabola
through three likelihoods has its top, all of them at once.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tuner.filter_error.disturbances import USUAL, within

Array = NDArray[np.float64]

STEP = float(np.log(1.6))
"""Of a logarithm, to either side."""
FURTHEST = float(np.log(4.0))
"""That a strength moves at a time: beyond, the parabola is no picture of the likelihood."""
SETTLED = 0.25
"""Largest change of a logarithm in a round after which all stay."""
ROUNDS = 2
"""A likelihood costs seconds, and strengths that are half as large again cost little sharpness."""


def likeliest(loss: Callable[[Array], float]) -> Array:
    """Return the strengths (6,), logarithms, of least negative log-likelihood."""
    best = loss(USUAL), USUAL
    for _ in range(ROUNDS):
        here, begin = best
        change, sides = np.zeros(len(begin)), []
        for index in range(len(begin)):
            below, above = (_stepped(begin, index, side) for side in (-STEP, STEP))
            sides += [(loss(below), below), (loss(above), above)]
            change[index] = _top(sides[-2][0], here, sides[-1][0])
        together = within(begin + change)
        best = min([best, *sides, (loss(together), together)], key=lambda tried: tried[0])
        if np.abs(best[1] - begin).max() < SETTLED:
            break
    return best[1]


def _stepped(strengths: Array, index: int, step: float) -> Array:
    stepped = strengths.copy()
    stepped[index] += step
    return within(stepped)


def _top(below: float, here: float, above: float) -> float:
    """Return how far from the middle the parabola through three losses is lowest."""
    slope, bend = (above - below) / 2.0, above + below - 2.0 * here
    if bend <= 0.0:
        return float(-np.sign(slope) * FURTHEST)
    return float(np.clip(-slope / bend * STEP, -FURTHEST, FURTHEST))
