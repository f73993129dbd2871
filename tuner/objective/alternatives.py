"""The same problem simulated differently, and what its residuals then would be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
from jax import Array
from numpy.typing import NDArray

from sim_jax.inlet import ReferenceInlet
from tuner.objective.criterion import Criterion, Point, SegmentData
from tuner.objective.normal import Objective
from tuner.objective.simulator import Simulator
from tuner.objective.tunable import Tunable
from tuner.parallel import in_pieces, over_devices

STEP = "step"
"""Half the physics step, controllers and log at their own rates."""


def alternatives_of(objective: Objective) -> dict[str, Objective]:
    """Return what might be simulated differently -> the problem so simulated.

    Physics runs in the same steps where a recording is fed in step by step: it is laid out for
    those.
    """
    others = {}
    if isinstance(objective.segments.inlet, ReferenceInlet):
        schedule = objective.schedule
        finer = replace(schedule, physics_rate=2 * schedule.physics_rate)
        others[STEP] = replace(objective, schedule=finer)
    return others


def residuals_at(
    objective: Objective, point: Point, criterion: Criterion
) -> dict[str, NDArray[np.float64]]:
    """Return channel -> (n, k, F) residuals, without derivatives."""
    residuals: dict[str, NDArray[np.float64]] = _shared(objective.simulator)(
        objective.data(point.offsets, criterion),
        objective.tunable,
        np.asarray(point.coefficients),
        np.asarray(criterion.horizon),
    )
    return residuals


@lru_cache(maxsize=4)
def _shared(simulator: Simulator) -> Callable[..., dict[str, NDArray[np.float64]]]:
    def segmentwise(
        data: SegmentData, model: Tunable, coefficients: Array, horizon: Array
    ) -> dict[str, Array]:
        return simulator.compared(data, model, coefficients, horizon)[1]

    def pieces(data: SegmentData, *rest: Array) -> dict[str, Array]:
        residuals: dict[str, Array] = in_pieces(segmentwise, simulator.segments_at_once(data, 0))(
            data, *rest
        )
        return residuals

    return over_devices(pieces)
