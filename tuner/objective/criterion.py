"""Arguments and results of an objective: points, criteria, sums and derivatives."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, TypeVar

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Shaped

from tuner.core.numerics import Array
from tuner.objective.segments import OFFSETS
from tuner.vehicle import REGISTRY, recording_offsets

T = TypeVar("T")
AnyArray: TypeAlias = Any
"""An array of NumPy, or of jax."""

OFFSET_UNIT = 0.01
"""s of a clock's offset, or rad/s of a gyro's, per unit of the search's coordinate."""
(OFFSET_SD,) = {row.prior_sd / OFFSET_UNIT for row in recording_offsets().values()}
"""Prior standard deviation of per-flight parameters, in the search's coordinates."""


def picked(tree: T, place: Any) -> T:
    """Return a part of every array of a tree: that of a start, or segments by ``(..., which)``."""
    part: T = jax.tree.map(lambda leaf: np.asarray(leaf)[place], tree)
    return part


def units_of(names: Sequence[str]) -> Array:
    """Return the size of one unit of the search's coordinate for each per-flight parameter."""
    return np.array(
        [OFFSET_UNIT if name in OFFSETS else REGISTRY[name].prior_sd / OFFSET_SD for name in names]
    )


class Point(eqx.Module):
    """A point of the search: coefficients that all flights share, and the offsets of each flight.

    Also a mark for each of these parameters: whether a search may move it.

    Attributes
    ----------
    coefficients
        (K,) search vector of the `Space`.
    offsets
        (offsets, N) of `OFFSETS`, then of the objective's conditions, a column for each flight, in
        the units of `units_of`.
    """

    coefficients: Shaped[AnyArray, " K"]
    offsets: Shaped[AnyArray, "offsets N"]

    @property
    def packed(self) -> Array:
        """All parameters as one vector, offsets one kind after the other."""
        return np.concatenate([self.coefficients, np.ravel(self.offsets)])

    def after(self, change: Array) -> Point:
        """Return the point after a change of the parameters, packed."""
        count = len(self.coefficients)
        return Point(
            self.coefficients + change[:count],
            self.offsets + change[count:].reshape(self.offsets.shape),
        )


@dataclass(frozen=True)
class Criterion:
    """The part of the loss that differs between stages of the search.

    Attributes
    ----------
    horizon
        Samples of the simulation that are compared.
    scale
        Channel -> (N,) factor on the standard deviations: inflated at first, more for a flight that
        the model cannot match.
    reference_offset
        (clocks, N) s of clock offset at which signals that jump between samples are read exactly.
    huber
        Residuals beyond so many (scaled) standard deviations count linearly; infinite for plain
        squares.
    prior
        Factor on the prior's residuals.
    states
        (L, F) initial states of the linearisation, in the segments' standard deviations; None where
        they are not free.
    """

    horizon: int
    scale: dict[str, Float[AnyArray, " N"]]
    reference_offset: Float[AnyArray, "clocks N"]
    huber: float = np.inf
    prior: float = 1.0
    states: Float[AnyArray, "L F"] | None = None


class SegmentSums(eqx.Module):
    """The contribution of each segment, at its best initial state if free; P = K + offsets.

    Attributes
    ----------
    loss
        (F,) half the robust sum of squares.
    gradient, hessian
        (P, F) and (P, P, F); zero where derivatives were not asked for.
    squares
        Channel -> (F,) plain sum of squares in unscaled standard deviations.
    counts
        Channel -> (F,) how many values were compared.
    crash_time
        (F,) s.
    states
        (L, F) best initial state, in the segments' standard deviations; None where not free.
    """

    loss: Float[AnyArray, " F"]
    gradient: Float[AnyArray, "P F"]
    hessian: Float[AnyArray, "P P F"]
    squares: dict[str, Float[AnyArray, " F"]]
    counts: dict[str, Float[AnyArray, " F"]]
    crash_time: Float[AnyArray, " F"]
    states: Float[AnyArray, "L F"] | None

    @property
    def compared(self) -> Any:
        """How many values were compared, in all segments together."""
        return sum(np.sum(np.asarray(count), axis=-1) for count in self.counts.values())


class Jacobian(eqx.Module):
    """Every residual and its derivatives at a point; Q = K + offsets + L.

    It holds P numbers for every recorded one: some 10 MB for a flight of 40 s.

    Attributes
    ----------
    residuals
        Channel -> (n, k, F), in unscaled standard deviations.
    columns
        Channel -> (Q, n, k, F): derivatives by the search vector, then by each offset and condition
        in the units of `units_of`, then by the start in the segments' standard deviations.
    crash_time
        (F,) s.
    """

    residuals: dict[str, Float[AnyArray, "n k F"]]
    columns: dict[str, Float[AnyArray, "Q n k F"]]
    crash_time: Float[AnyArray, " F"]

    def of(self, channels: Iterable[str]) -> Jacobian:
        """Return the part of some channels."""
        names = tuple(channels)
        return replace(
            self,
            residuals={name: self.residuals[name] for name in names},
            columns={name: self.columns[name] for name in names},
        )
