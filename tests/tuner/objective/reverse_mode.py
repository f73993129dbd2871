"""The gradient of the loss for a population of coefficient vectors, by reverse mode.

No search uses it: by a dozen coefficients forward mode is cheaper. It shows that the simulation can
be differentiated backwards, at five or six simulations however many coefficients there are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float
from numpy.typing import NDArray

from tuner.objective.criterion import Criterion, Point, SegmentData
from tuner.objective.loss import robust_loss
from tuner.objective.normal import Objective
from tuner.objective.simulator import Simulator
from tuner.objective.tunable import Tunable
from tuner.parallel import in_pieces, over_devices, piece_that_fits

_REMEMBERED = 50
"""Numbers that reverse mode keeps for every tick of a vehicle: its state, and what it logged."""


class Gradients(eqx.Module):
    """What S vectors give.

    Attributes
    ----------
    loss
        (S,) half the robust sum of squares of all segments, priors not included.
    gradient
        (K, S) by the search vector.
    """

    loss: Float[Array, " S"]
    gradient: Float[Array, "K S"]


def gradients(
    objective: Objective, vectors: NDArray[np.float64], point: Point, criterion: Criterion
) -> Gradients:
    """Return loss and gradient for every vector, computed on all devices.

    Whole flights are flown; the criterion's horizon says how much of them counts.

    Parameters
    ----------
    objective, criterion
        The problem.
    vectors
        (S, K) search vectors.
    point
        Its clock offsets hold for all.
    """
    result: Gradients = _shared(objective.simulator)(
        np.asarray(vectors).T,
        objective.data(point.offsets, criterion),
        objective.tunable,
        np.asarray(criterion.horizon),
        np.asarray(criterion.huber),
    )
    return result


@lru_cache(maxsize=16)
def _shared(simulator: Simulator) -> Callable[..., Gradients]:
    def some(
        vectors: Array, data: SegmentData, model: Tunable, horizon: Array, huber: Array
    ) -> Gradients:
        def loss(vector: Array) -> Array:
            trace = simulator.fly(model, data.segments, vector, None, states=data.states)
            errors = simulator.residuals(data, horizon, trace, data.offsets)
            scaled = {name: error / data.scale[name] for name, error in errors.items()}
            return jnp.sum(robust_loss(scaled, huber))

        values, slopes = jax.vmap(jax.value_and_grad(loss), in_axes=-1, out_axes=-1)(vectors)
        return Gradients(values, slopes)

    def share(vectors: Array, data: SegmentData, *rest: Any) -> Gradients:
        result: Gradients = in_pieces(some, _vectors_at_once(simulator, data))(vectors, data, *rest)
        return result

    return over_devices(share)


def _vectors_at_once(simulator: Simulator, data: SegmentData) -> int:
    segments = data.segments.count
    bytes_of_vector = (
        8 * _REMEMBERED * simulator.capacity * simulator.schedule.blocks_per_sample * segments
    )
    memory = simulator.memory // len(jax.devices())
    return max(1, min(piece_that_fits(8) // segments, memory // bytes_of_vector))
