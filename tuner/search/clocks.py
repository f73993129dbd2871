"""Which clocks of the recordings differ: those that the flights would be met worse without.

A clock that is late looks like latency, and a tenth of a millisecond of freedom costs a percent of
inertia. Gusts move an estimated clock by milliseconds. So clocks are taken to agree unless that
makes the loss rise by more than two simulators of one vehicle differ.
"""

from __future__ import annotations

import jax
import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import scaled_inverse, scaled_solve
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal import Objective
from tuner.objective.segments import CLOCKS
from tuner.search.normal_equations import normal_equations
from tuner.search.optimiser import Free
from tuner.search.progress import point_of

MATERIAL = 0.01
"""Share of the loss by which it may rise, over all clocks that are set right."""
RIDGE = 1e-12
"""Added to a Hessian of unit diagonal."""


def clocks_that_differ(
    objective: Objective,
    points: Point,
    best: int,
    criterion: Criterion,
    free: Free,
    *,
    sums: SegmentSums,
) -> NDArray[np.bool_]:
    """Return (offsets, N) which offsets stay, of those that are free.

    From the loss's quadratic at the best of some points: setting the clocks Z right, everything
    else following, makes it rise by ``½ oᵀ(C_ZZ)⁻¹o``, o being what they are late by at the minimum
    and C the inverse Hessian. The one that matters least goes first.

    Parameters
    ----------
    objective, criterion
        The problem.
    points, best
        S points, and which of them.
    free
        What moves.
    sums
        The segments' at the points.
    """
    here: SegmentSums = jax.tree.map(lambda leaf: np.asarray(leaf)[best], sums)
    loss, gradient, hessian = (
        np.asarray(part)
        for part in normal_equations(
            objective.space,
            np.asarray(objective.segments.flight),
            point_of(points, best),
            criterion,
            here,
        )
    )
    moves = np.flatnonzero(np.concatenate([free.coefficients, free.offsets.ravel()]))
    inverse = scaled_inverse(hessian[np.ix_(moves, moves)], RIDGE)
    late = np.concatenate([np.zeros(len(objective.space)), np.ravel(points.offsets[best])])[moves]
    late = late - inverse @ gradient[moves]
    first, clocks = len(objective.space), len(CLOCKS) * objective.flights
    left: list[int] = np.flatnonzero((moves >= first) & (moves < first + clocks)).tolist()
    right: list[int] = []
    while left:
        rises = [_rise(inverse, late, [*right, clock]) for clock in left]
        least = int(np.argmin(rises))
        if rises[least] > MATERIAL * float(loss):
            break
        right.append(left.pop(least))
    stay = np.ones(free.offsets.size, bool)
    stay[moves[right] - first] = False
    return stay.reshape(free.offsets.shape)


def _rise(inverse: NDArray[np.float64], late: NDArray[np.float64], clocks: list[int]) -> float:
    square = inverse[np.ix_(clocks, clocks)]
    return float(0.5 * late[clocks] @ scaled_solve(square, late[clocks]))
