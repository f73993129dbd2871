"""A golden file's columns as batched pytrees, and how far two of them lie apart."""

from __future__ import annotations

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
import pandas as pd
from jax import Array

from sim_jax.geometry import Quaternion, Vec3


@dataclass(frozen=True)
class Deviation:
    """How far one quantity of a golden file is from what sim_jax gives."""

    quantity: str
    rows: int
    worst: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Not-a-number never passes."""
        return self.worst <= self.tolerance


@dataclass(frozen=True)
class Table:
    """Rows of a golden file: every row is one member of a batch."""

    frame: pd.DataFrame

    def __len__(self) -> int:
        return len(self.frame)

    def column(self, name: str) -> Array:
        return jnp.asarray(self.frame[name].to_numpy(), float)

    def flag(self, name: str) -> Array:
        return jnp.asarray(self.frame[name].to_numpy() > 0, bool)

    def vector(self, prefix: str) -> Vec3:
        return Vec3(*(self.column(prefix + axis) for axis in "xyz"))

    def quaternion(self, prefix: str) -> Quaternion:
        return Quaternion(*(self.column(prefix + axis) for axis in "wxyz"))

    def four(self, prefix: str) -> tuple[Array, Array, Array, Array]:
        a, b, c, d = (self.column(f"{prefix}{rotor}") for rotor in range(4))
        return a, b, c, d

    def where(self, rows: pd.Series) -> Table:
        return Table(self.frame[rows].reset_index(drop=True))

    def split(self, *names: str) -> list[Table]:
        """Return the table in parts that have the same value in each of the columns."""
        groups = self.frame.groupby(list(names), sort=False, dropna=False)
        return [Table(group.reset_index(drop=True)) for _, group in groups]

    def only(self, name: str) -> float:
        """Return the one value of a column that has but one."""
        (value,) = self.frame[name].unique()
        return float(value)


def deviation(
    quantity: str,
    got: object,
    wanted: object,
    tolerance: float,
    *,
    absolute: bool = False,
    of_largest: bool = False,
) -> Deviation:
    """Compare component by component; beyond 1 the deviation is relative unless it is absolute.

    ``of_largest`` takes it relative to the largest wanted value, for quantities whose rounding
    error does not shrink with them.

    Where the original gave not-a-number, a finite number is asked for, whatever it is.
    """
    worst, rows = 0.0, 0
    for ours, theirs in zip(_leaves(got), _leaves(wanted), strict=True):
        got_leaf, wanted_leaf = np.broadcast_arrays(
            np.asarray(ours, float), np.asarray(theirs, float)
        )
        apart = np.abs(got_leaf - wanted_leaf)
        if of_largest:
            apart = apart / np.nanmax(np.abs(wanted_leaf))
        elif not absolute:
            apart = apart / np.maximum(np.abs(wanted_leaf), 1.0)
        apart = np.where(np.isnan(wanted_leaf), np.where(np.isfinite(got_leaf), 0.0, np.inf), apart)
        apart = np.where(np.isnan(apart), np.inf, apart)
        worst, rows = max(worst, float(apart.max(initial=0.0))), max(rows, got_leaf.shape[0])
    return Deviation(quantity, rows, worst, tolerance)


def merged(parts: list[list[Deviation]]) -> list[Deviation]:
    """Put the deviations of several parts of one file together, quantity by quantity."""
    together: dict[str, Deviation] = {}
    for row in (row for part in parts for row in part):
        old = together.get(row.quantity)
        together[row.quantity] = (
            row
            if old is None
            else Deviation(
                row.quantity,
                old.rows + row.rows,
                max(old.worst, row.worst),
                row.tolerance,
            )
        )
    return list(together.values())


def _leaves(tree: object) -> list[np.ndarray]:
    if isinstance(tree, Vec3):
        return [tree.x, tree.y, tree.z]
    if isinstance(tree, Quaternion):
        return [tree.w, tree.x, tree.y, tree.z]
    if isinstance(tree, tuple | list):
        return [leaf for branch in tree for leaf in _leaves(branch)]
    return [np.asarray(tree)]
