"""How far a fit would move with terms that are not in it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from tuner.selection.linear import Array, Columns, Linear


def in_doubt(linear: Linear, model: Columns, groups: Iterable[Columns]) -> Array:
    """Return how far each parameter (P,) would move with what the model lacks.

    Each group is added by itself, in one linear step; the moves count together as the root of the
    sum of their squares.

    Parameters
    ----------
    linear
        The loss about the fit.
    model
        Columns of what is in the model.
    groups
        Columns of each group that is not.
    """
    everything = np.ones(len(linear.flight), bool)
    alone = linear.step(model, inside=everything)
    squares = np.zeros_like(alone)
    for group in groups:
        wider = np.concatenate([model, group])
        squares += (linear.step(wider, inside=everything) - alone) ** 2
    return np.asarray(np.sqrt(squares))
