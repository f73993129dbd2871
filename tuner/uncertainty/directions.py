"""Which combinations of coefficients the flights determine worst."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from tuner.core.files import Part
from tuner.core.numerics import symmetric_eigen
from tuner.vehicle import scale_group

Array = NDArray[np.float64]

NAMED = 0.3
"""Move of a coefficient, relative to the largest, from which it takes part in a direction."""
ALIKE = 0.1
"""Deviation of a direction's moves from those of a common factor below which it is one."""
UNDETERMINED = 1.0
"""Standard error along a direction above which the flights do not determine it at all."""


class Direction(Part):
    """A combination of coefficients.

    Attributes
    ----------
    moves
        Name -> relative change (logarithmic coefficients) or change in units of the coefficient's
        reference; the largest is ±1. Only coefficients that move by more than `NAMED`.
    error
        Standard error along the direction from the flights alone: 0.1 means that all moves times
        ten percent are one standard error away.
    null
        Whether the flights do not determine it at all.
    common_scale
        Whether it multiplies masses and forces by one factor, which changes no motion.
    """

    moves: dict[str, float]
    error: float
    null: bool
    common_scale: bool


def weakest(
    covariance: Array, reference: Array, names: Sequence[str], *, count: int = 3
) -> tuple[Direction, ...]:
    """Return the worst-determined combinations, worst first.

    Parameters
    ----------
    covariance
        (K, K) of the scaled coordinates, from the flights alone.
    reference
        (K,) scaled coordinates' change that counts as one hundred percent.
    names
        K coefficients.
    count
        How many at most.
    """
    values, vectors = symmetric_eigen(covariance / np.outer(reference, reference))
    directions = []
    for value, vector in list(zip(values, vectors.T, strict=True))[::-1][:count]:
        largest = vector[np.argmax(np.abs(vector))]
        moves = dict(zip(names, (vector / largest).tolist(), strict=True))
        error = float(abs(largest) * np.sqrt(max(value, 0.0)))
        directions.append(
            Direction(
                moves={name: move for name, move in moves.items() if abs(move) >= NAMED},
                error=error,
                null=error > UNDETERMINED,
                common_scale=is_common_scale(moves),
            )
        )
    return tuple(directions)


def is_common_scale(moves: Mapping[str, float]) -> bool:
    """Return whether a direction multiplies masses and forces by one factor."""
    group = [name for name in scale_group() if name in moves]
    others = [abs(move) for name, move in moves.items() if name not in group]
    alike = [abs(moves[name] - 1.0) < ALIKE for name in group]
    return "mass" in group and all(alike) and max(others, default=0.0) < ALIKE
