"""Which further flight would narrow the intervals of what is not known well yet the most.

Every candidate is simulated with the fitted coefficients, differentiated by all of them, and
weighed with the noise that the recorded flights had in each channel; its information is added to
theirs. The measures are those of experiment design: the D-optimal flight shrinks the volume of the
confidence ellipsoid the most, the A-optimal one the sum of squared relative errors (Goodwin and
Payne, "Dynamic System Identification: Experiment Design and Data Analysis", 1977).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import log_determinant, scaled_inverse, unit_diagonal
from tuner.design.candidates import Arena, Candidate, candidate_point, candidate_problem, candidates
from tuner.design.proposals import Proposal, Proposals
from tuner.objective.criterion import Criterion
from tuner.objective.information import information_from_jacobian
from tuner.objective.normal import Objective
from tuner.uncertainty.covariance import WIDE
from tuner.uncertainty.examination import Examination
from tuner.uncertainty.verdict import Verdict
from tuner.vehicle import COEFFICIENTS

Array = NDArray[np.float64]


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
    at_once = min(full_problem.objective.segments.count, len(flights))
    kinds = (np.asarray(full_problem.point.offsets) != 0.0).any(axis=1)
    offsets_fitted = np.repeat(kinds[:, None], at_once, axis=1)
    gains, flown = [], []
    for first in range(0, len(flights), at_once):
        # the last ones again where too few are left: as many as the program was compiled for
        some = [flights[min(first + i, len(flights) - 1)] for i in range(at_once)]
        objective = candidate_problem(
            full_problem.objective, some, seconds=seconds, spin_channels=spin_channels
        )
        point, weights = candidate_point(full_problem.point, criterion, objective, seconds=seconds)
        jacobian = objective.jacobian(point, weights)
        information = information_from_jacobian(
            objective, point, weights, jacobian, offsets_fitted=offsets_fitted
        )
        inside = _inside(objective, jacobian.residuals, arena)
        gains += list(information.blocks.sum(axis=(0, 2)))
        flown += list(~information.crashed & inside)
    now = examination.information.data + examination.information.prior / WIDE**2
    return _ranked(
        examination,
        [
            (flight, gain)
            for flight, gain, flies in zip(flights, gains, flown, strict=False)
            if flies
        ],
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
    names = tuple(examination.sensitivity.steps)
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
    before, after = (scaled_inverse(matrix[square])[row, row] for matrix in (now, now + gain))
    return float(np.sqrt(after / before))


def _volume(now: Array, gain: Array, count: int) -> float:
    """Return the factor on the geometric mean of the half axes of the fitted ones' ellipsoid."""
    unit = unit_diagonal(now[:count, :count])
    before, after = (
        log_determinant(matrix[:count, :count] * np.outer(unit, unit))
        for matrix in (now, now + gain)
    )
    return float(np.exp(-0.5 * (after - before) / count))


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
