"""The objective of candidate flights: simulated and measured as the recorded ones were."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from sim_jax.crash import Limits
from sim_jax.inlet import ReferenceInlet
from sim_jax.rigid_body import Motion
from sim_jax.schedule import Schedule
from sim_jax.state import Start, hover
from sim_jax.trajectory import shapes
from sim_jax.vector import Vec3
from tuner.design.candidates import Candidate
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.objective.segments import Measured, Segments
from tuner.simulation.trajectory import published

Array = NDArray[np.float64]

LOG_RATE = 100
"""Lowest rate at which candidates are logged, Hz."""
SAMPLE_RATE = 100.0
"""Rate at which candidates are compared, Hz; their weights stand for the samples in between."""


def candidate_problem(
    objective: Objective,
    flights: Sequence[Candidate],
    *,
    seconds: float,
    spin_channels: Sequence[str],
) -> Objective:
    """Return the problem with candidates in the place of recordings, whose values are zero.

    Parameters
    ----------
    objective
        The problem of the recorded flights.
    flights
        The candidates.
    seconds
        How long each lasts.
    spin_channels
        Channels that a yaw spin is compared by.
    """
    schedule = _with_low_log_rate(objective.schedule)
    references = [
        published(
            flight.trajectory,
            duration=seconds,
            control_rate=schedule.position_control_rate,
        )
        for flight in flights
    ]
    inlet: ReferenceInlet = jax.tree.map(
        lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves], axis=-1),
        *(reference.inlet for reference in references),
    )
    starts = Vec3(
        *(
            jnp.stack([getattr(flown.start, axis) for flown in references])
            for axis in ("x", "y", "z")
        )
    )
    spins = np.array([shapes()[flight.trajectory.name].spins for flight in flights])
    segments = Segments(
        inlet=inlet,
        start=_hovering(objective, starts, len(flights)),
        measured={
            name: _sampled(
                measured,
                silent=spins & (name not in spin_channels),
                seconds=seconds,
                recorded=_seconds(objective),
            )
            for name, measured in objective.segments.measured.items()
        },
        flight=jnp.arange(len(flights)),
    )
    return Objective(
        model=objective.model,
        segments=segments,
        space=objective.space,
        schedule=schedule,
        samples=round(seconds * schedule.log_rate),
        limits=Limits(),
        memory=objective.memory,
        conditions=objective.conditions,
    )


def _with_low_log_rate(schedule: Schedule) -> Schedule:
    """Return the schedule with the lowest rate of logging that is not below `LOG_RATE`."""
    physics = schedule.physics_rate
    rates = [physics // divisor for divisor in range(1, physics + 1) if physics % divisor == 0]
    return replace(schedule, log_rate=min(rate for rate in rates if rate >= min(LOG_RATE, physics)))


def _hovering(objective: Objective, places: Vec3, count: int) -> Start:
    start = hover(objective.model.vehicle, places)
    wide: Start = jax.tree.map(
        lambda leaf: jnp.broadcast_to(jnp.asarray(leaf, float), (count,)), start
    )
    assert isinstance(wide.motion, Motion)
    return wide


def _seconds(objective: Objective) -> Array:
    """Return (F,) s that each segment was recorded for."""
    ends = [np.asarray(m.time).max(axis=0) for m in objective.segments.measured.values()]
    return np.asarray(np.maximum(np.max(ends, axis=0), 1e-9))


def _sampled(
    measured: Measured, *, silent: NDArray[np.bool_], seconds: float, recorded: Array
) -> Measured:
    """Return one channel of every candidate, as often and as precisely recorded as in the best.

    Parameters
    ----------
    measured
        The channel of the recorded segments.
    silent
        (C,) for which candidates it is not compared.
    seconds, recorded
        How long a candidate lasts, and (F,) how long each segment was recorded, in s.
    """
    weight = np.asarray(measured.weight)
    rate = (weight > 0).sum(axis=0) / recorded
    equivalent = np.where(
        weight.max(axis=0) > 0, weight.max(axis=0) * np.sqrt(rate / SAMPLE_RATE), 0.0
    )
    time = np.arange(1, int(seconds * SAMPLE_RATE)) / SAMPLE_RATE
    segments = len(silent)
    values = np.zeros((len(time), np.asarray(measured.values).shape[1], segments))
    if values.shape[1] > weight.shape[1]:
        values[:, 0] = 1.0  # an attitude
    constant = np.where(silent, 0.0, equivalent.max(axis=1)[:, None])
    return Measured(
        time=jnp.asarray(np.repeat(time[:, None], segments, axis=1)),
        values=jnp.asarray(values),
        weight=jnp.asarray(np.broadcast_to(constant, (len(time), *constant.shape))),
    )


def candidate_point(
    point: Point, criterion: Criterion, objective: Objective
) -> tuple[Point, Criterion]:
    """Return point and criterion of the candidates, weighed as the recorded flights mostly were."""
    count = objective.flights
    offsets = np.zeros((np.asarray(point.offsets).shape[0], count))
    reference_offset = np.zeros((np.asarray(criterion.reference_offset).shape[0], count))
    scale = {
        name: jnp.full(count, float(np.median(np.asarray(of_segment))))
        for name, of_segment in criterion.scale.items()
    }
    return Point(point.coefficients, jnp.asarray(offsets)), Criterion(
        horizon=jnp.asarray(objective.samples),
        scale=scale,
        reference_offset=jnp.asarray(reference_offset),
        huber=jnp.asarray(np.inf),
        prior=criterion.prior,
    )
