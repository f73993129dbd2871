"""How strong disturbances are and how long they last: what makes the recordings likeliest.

The likelihood is that of the innovations (Schweppe 1965). Strengths trade off: gusts and turbulence
explain the same innovations, and where each moves as if it were alone they all become too large,
which biases the coefficients. A quasi-Newton search (Nocedal and Wright, "Numerical optimization",
2006, ch. 6) learns how they go together from the slopes that it meets.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tuner.filter_error.disturbances import USUAL, within

Array = NDArray[np.float64]

STEP = float(np.log(1.6))
"""Of a logarithm, over which slopes are taken."""
FURTHEST = float(np.log(4.0))
"""That a strength moves at a time: beyond, the parabola is no picture of the likelihood."""
SETTLED = 0.15
"""Largest change of a logarithm in a round after which all stay."""
ROUNDS = 5
"""At most: a likelihood costs seconds, and a round eight of them."""


def likeliest(loss: Callable[[Array], float]) -> Array:
    """Return the strengths (6,), logarithms, of least negative log-likelihood."""
    here, begin = loss(USUAL), USUAL
    above, below = (_beside(loss, begin, side) for side in (STEP, -STEP))
    slope, curved = (above - below) / (2.0 * STEP), (above + below - 2.0 * here) / STEP**2
    bend = np.diag(np.maximum(curved, np.abs(slope) / FURTHEST))
    for _ in range(ROUNDS):
        change = np.clip(-np.linalg.solve(bend, slope), -FURTHEST, FURTHEST)
        tried = [within(begin + share * change) for share in (1.0, 0.5)]
        there, reached = min(((loss(each), each) for each in tried), key=lambda pair: pair[0])
        if there >= here:
            break
        moved, here, begin = reached - begin, there, reached
        if np.abs(moved).max() < SETTLED:
            break
        ahead = (_beside(loss, begin, STEP) - here) / STEP - np.diag(bend) * STEP / 2.0
        bend, slope = _updated(bend, moved, ahead - slope), ahead
    return begin


def _beside(loss: Callable[[Array], float], begin: Array, step: float) -> Array:
    """Return the losses (6,) where each strength alone is a step away."""
    return np.array([loss(within(begin + step * axis)) for axis in np.eye(len(begin))])


def _updated(bend: Array, moved: Array, change: Array) -> Array:
    """Return the second derivatives as a change of the slopes along a move says (BFGS, damped)."""
    along = bend @ moved
    expected, found = moved @ along, moved @ change
    if found < 0.2 * expected:  # Powell's damping: they stay positive definite
        share = 0.8 * expected / (expected - found)
        change = share * change + (1.0 - share) * along
        found = moved @ change
    return np.asarray(bend - np.outer(along, along) / expected + np.outer(change, change) / found)
