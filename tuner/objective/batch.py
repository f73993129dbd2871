"""Many coefficient vectors at once: how closely each meets the recordings, axis by axis."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import NDArray

from tuner.engine import Report, current
from tuner.objective.criterion import Criterion, Point, SegmentData
from tuner.objective.loss import robust_loss
from tuner.objective.normal import Objective
from tuner.objective.simulator import Simulator
from tuner.objective.tunable import Tunable
from tuner.parallel import in_pieces, over_devices, piece_that_fits

CHUNK = 16
"""Vectors simulated side by side: enough to fill the processor, few enough for its memory."""


class Batch(eqx.Module):
    """What S vectors give.

    Attributes
    ----------
    loss
        (S, F) half the robust sum of squares.
    squares
        Channel -> (S, k, F) plain sum of squares in unscaled standard deviations.
    crash_time
        (S, F) s, infinite for a segment that flew.
    """

    loss: Float[Array, "S F"]
    squares: dict[str, Float[Array, "S k F"]]
    crash_time: Float[Array, "S F"]


def evaluate(
    objective: Objective, vectors: NDArray[np.float64], point: Point, criterion: Criterion
) -> Batch:
    """Fly all segments with every vector, in chunks of one compiled shape.

    The engine in force computes them.

    Parameters
    ----------
    objective, criterion
        The problem.
    vectors
        (S, K) search vectors.
    point
        Its clock offsets hold for all.
    """
    engine = current()
    problem = engine.share((objective, point, criterion))
    chunks = [vectors[first : first + CHUNK] for first in range(0, len(vectors), CHUNK)]
    parts = engine.map(_evaluated, [(problem, chunk) for chunk in chunks])
    joined: Batch = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return joined


def _evaluated(
    task: tuple[Callable[[], tuple[Objective, Point, Criterion]], NDArray[np.float64]],
    _report: Report,
) -> Batch:
    """Return what some vectors give, filled up to a whole chunk on the way."""
    (objective, point, criterion), chunk = task[0](), task[1]
    padded = np.concatenate([chunk, np.repeat(chunk[-1:], CHUNK - len(chunk), axis=0)])
    batch = _shared(objective.simulator)(
        objective.data(point.offsets, criterion),
        objective.tunable,
        padded,
        np.asarray(criterion.horizon),
        np.asarray(criterion.huber),
    )
    return _first(batch, len(chunk))


def _first(batch: Batch, count: int) -> Batch:
    kept: Batch = jax.tree.map(lambda leaf: np.asarray(leaf)[:count], batch)
    return kept


@lru_cache(maxsize=16)
def _shared(simulator: Simulator) -> Callable[..., Batch]:
    def segmentwise(
        data: SegmentData, model: Tunable, vectors: Array, horizon: Array, huber: Array
    ) -> Batch:
        def at(vector: Array) -> Batch:
            trace, errors = simulator.compared(data, model, vector, horizon)
            scaled = {name: error / data.scale[name] for name, error in errors.items()}
            squares = {name: jnp.sum(e * e, axis=0) for name, e in errors.items()}
            return Batch(robust_loss(scaled, huber), squares, trace.crash_time)

        batch: Batch = jax.vmap(at)(vectors)
        return batch

    pieces = in_pieces(segmentwise, max(1, piece_that_fits(8) // CHUNK))
    return over_devices(pieces, name=("many points", simulator))
