"""Which combinations of coefficients the flights determine worst, in numbers and words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

NAMED = 0.3
"""A coefficient takes part in a direction if it moves at least this much of the largest."""
SCALE_GROUP = (
    "mass",
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "motor_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
)
"""Multiply all of these by one factor and every motion stays the same."""
ALIKE = 0.1
"""How closely the moves of a direction must agree with a common factor to be called one."""
FREE_FOR_ALL = 1.0
"""Standard error along a direction above which the flights do not determine it at all."""


@dataclass(frozen=True)
class Direction:
    """A combination of coefficients.

    Attributes
    ----------
    moves
        Name -> relative change (logarithmic coefficients) or change in units of the coefficient's
        reference; the largest is ±1.
    error
        Standard error along the direction from the flights alone: 0.1 means that all moves times
        ten percent are one standard error away.
    null
        Whether the flights do not determine it at all.
    text
        One sentence.
    """

    moves: Mapping[str, float]
    error: float
    null: bool
    text: str


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
    values, vectors = np.linalg.eigh(covariance / np.outer(reference, reference))
    found = []
    for value, vector in list(zip(values, vectors.T, strict=True))[::-1][:count]:
        largest = vector[np.argmax(np.abs(vector))]
        moves = dict(zip(names, (vector / largest).tolist(), strict=True))
        found.append(_direction(moves, float(abs(largest) * np.sqrt(max(value, 0.0)))))
    return tuple(found)


def _direction(moves: Mapping[str, float], error: float) -> Direction:
    taking_part = {name: move for name, move in moves.items() if abs(move) >= NAMED}
    null = error > FREE_FOR_ALL
    return Direction(taking_part, error, null, _words(moves, taking_part, error))


def is_common_scale(moves: Mapping[str, float]) -> bool:
    """Tell whether a direction multiplies masses and forces by one factor."""
    group = [name for name in SCALE_GROUP if name in moves]
    others = [abs(move) for name, move in moves.items() if name not in group]
    alike = [abs(moves[name] - 1.0) < ALIKE for name in group]
    return "mass" in group and all(alike) and max(others, default=0.0) < ALIKE


def _words(moves: Mapping[str, float], taking_part: Mapping[str, float], error: float) -> str:
    size = (
        "cannot be told at all" if error > FREE_FOR_ALL else f"is known to ±{percent(1.96 * error)}"
    )
    if is_common_scale(moves):
        group = _listed([name for name in moves if name in SCALE_GROUP])
        return (
            f"{group} scale together: multiplied by one factor, every motion stays the same; "
            f"that factor {size}. Weigh the mass and fix it."
        )
    if len(taking_part) == 1:
        (name,) = taking_part
        return f"{name} alone: it {size}."
    up = [name for name, move in taking_part.items() if move > 0]
    down = [name for name, move in taking_part.items() if move < 0]
    change = ", ".join(f"{name} {move:+.0%}" for name, move in taking_part.items())
    if not down:
        verb = f"{_listed(up)} rise and fall together"
    else:
        verb = f"{_listed(up)} trade{'s' if len(up) == 1 else ''} off against {_listed(down)}"
    return f"{verb} (in the proportion {change}): their combination {size}."


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def percent(share: float) -> str:
    """Return a share as a percentage of two digits."""
    return f"{100 * share:.2g} %" if share < 1 else f"{100 * share:.0f} %"
