"""Which further flight would narrow the intervals of what is not known well yet the most.

Every candidate is simulated with the fitted coefficients, differentiated by all of them, and
weighed with the noise that the recorded flights had in each channel; its information is added to
theirs.
The measures are those of experiment design: the D-optimal flight shrinks the volume of the
confidence ellipsoid the most, the A-optimal one the sum of squared relative errors (Goodwin and
Payne, "Dynamic System Identification: Experiment Design and Data Analysis", 1977).
"""

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
from sim_jax.vector import Vec3
from tuner.coefficients import COEFFICIENTS
from tuner.design.candidates import Arena, Candidate, candidates
from tuner.design.next_flight_json import Proposal, Proposals
from tuner.examination.examination import Examination
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal import Objective
from tuner.objective.segments import Measured, Segments
from tuner.simulation.trajectory import published
from tuner.uncertainty.covariance import WIDE
from tuner.uncertainty.information import information_from_jacobian
from tuner.uncertainty.verdict import Verdict

Array = NDArray[np.float64]

LOG_RATE = 100
"""Hz, at least, at which candidates are logged."""
SAMPLE_RATE = 100.0
"""Hz at which they are compared; their weight stands for the samples in between."""


def rank_next_flights(
    examination: Examination,
    criterion: Criterion,
    *,
    arena: Arena,
    seconds: float,
    spin_channels: Sequence[str],
) -> Proposals:
    """Rank the flights that could be flown next.

    Parameters
    ----------
    examination
        Of the recorded flights.
    criterion
        Whose weights the recorded residuals have.
    arena
        Where the next flight must fit.
    seconds
        How long it would last.
    spin_channels
        Channels that a yaw spin is compared by.
    """
    full_problem = examination.full_problem
    flights = candidates(arena)
    objective = _candidate_problem(
        full_problem.objective, flights, seconds=seconds, spin_channels=spin_channels
    )
    point, weights = _candidate_point(full_problem.point, criterion, objective)
    jacobian = objective.jacobian(point, weights)
    kinds = (np.asarray(full_problem.point.offsets) != 0.0).any(axis=1)
    fitted_offsets = np.repeat(kinds[:, None], len(flights), axis=1)
    information = information_from_jacobian(
        objective, point, weights, jacobian, offsets_fitted=fitted_offsets
    )
    flown = ~information.crashed & _inside(objective, jacobian.residuals, arena)
    gain = information.blocks.sum(axis=(0, 2))
    now = examination.information.data + examination.information.prior / WIDE**2
    return _ranked(
        examination,
        [pair for pair, flies in zip(zip(flights, gain, strict=True), flown, strict=True) if flies],
        now,
        arena=arena,
        seconds=seconds,
    )


def _ranked(
    examination: Examination,
    flights: Sequence[tuple[Candidate, Array]],
    now: Array,
    *,
    arena: Arena,
    seconds: float,
) -> Proposals:
    names = examination.sensitivity.names
    fitted = examination.uncertainty
    count = len(fitted.names)
    verdicts = {name: fitted.estimates[name].verdict for name in fitted.names}
    verdicts |= {name: freed.estimates[name].verdict for name, freed in examination.freed.items()}
    weak = [name for name in names if verdicts[name] is not Verdict.WELL_KNOWN]
    free = [name for name in weak if name in fitted.names]
    fixed = [
        name
        for name in weak
        if name in examination.freed and COEFFICIENTS[name].informed_by != "weighing"
    ]
    targets = free or fixed or list(fitted.names)
    rows = [
        Proposal(
            name=flight.name,
            trajectory=flight.trajectory.model_dump(mode="json"),
            shrinks={name: _ratio(now, gain, names.index(name), count) for name in targets},
            volume=_volume(now, gain, count),
        )
        for flight, gain in flights
    ]
    rows.sort(key=lambda row: (row.mean, row.name))
    return Proposals(
        arena=(arena.x, arena.y, arena.z),
        seconds=seconds,
        targets=targets,
        fixed_targets=[name for name in targets if name in examination.freed],
        all_known=not free,
        flights=rows,
    )


def _ratio(now: Array, gain: Array, place: int, count: int) -> float:
    """Return an interval's width after a flight over that before, all fitted ones free too.

    Parameters
    ----------
    now, gain
        (N, N) information about all coefficients, of the recorded flights and of the candidate.
    place
        Of the coefficient in them.
    count
        How many of them, the first ones, are fitted.
    """
    places = [*range(count), *([place] if place >= count else [])]
    square = np.ix_(places, places)
    row = places.index(place)
    before, after = (_inverse(matrix[square])[row, row] for matrix in (now, now + gain))
    return float(np.sqrt(after / before))


def _volume(now: Array, gain: Array, count: int) -> float:
    """Return the factor on the geometric mean of the half axes of the fitted ones' ellipsoid."""
    before, after = (
        np.linalg.slogdet(_scaled(matrix[:count, :count], now[:count, :count]))[1]
        for matrix in (now, now + gain)
    )
    return float(np.exp(-0.5 * (after - before) / count))


def _scaled(matrix: Array, by: Array) -> Array:
    unit = 1.0 / np.sqrt(np.diag(by))
    return np.asarray(matrix * np.outer(unit, unit))


def _inverse(matrix: Array) -> Array:
    unit = 1.0 / np.sqrt(np.diag(matrix))
    return np.asarray(np.linalg.inv(_scaled(matrix, matrix)) * np.outer(unit, unit))


def _candidate_problem(
    objective: Objective,
    flights: Sequence[Candidate],
    *,
    seconds: float,
    spin_channels: Sequence[str],
) -> Objective:
    """Return the problem with candidates in the place of recordings, whose values are zero."""
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
    spins = np.array([flight.trajectory.name == "yaw_spin" for flight in flights])
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


def _candidate_point(
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


def _inside(
    objective: Objective, residuals: dict[str, jax.Array], arena: Arena
) -> NDArray[np.bool_]:
    """Return (C,) whether the simulated vehicle stays between the walls, if positions are known."""
    if "position" not in residuals:
        return np.ones(objective.segments.count, bool)
    weight = np.asarray(objective.segments.measured["position"].weight)
    distance = np.abs(np.asarray(residuals["position"])) / np.where(weight > 0, weight, np.inf)
    half = np.array([arena.x / 2, arena.y / 2, arena.z])
    return np.asarray((distance.max(axis=0) <= half[:, None]).all(axis=0))
