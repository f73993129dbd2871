"""Profile likelihood: one coefficient fixed at a value, all the others fitted again.

A profile needs no quadratic approximation: one that stays flat on a side has no interval there
(Raue et al., "Structural and practical identifiability analysis of partially observed dynamical
models by exploiting the profile likelihood", 2009).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tuner.core.numerics import Array
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal_equations import Objective
from tuner.search.levenberg_marquardt import advance, initial_step
from tuner.uncertainty.covariance import PRIOR_WIDENING
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import FullProblem
from tuner.uncertainty.records import CHI_SQUARE_95, Profile
from tuner.vehicle import COEFFICIENTS

POINTS = 13
"""Number of the coefficient's values, the middle one that of the fit."""
GRID_REACH_SE = 3.5
"""Distance of the outermost values in standard errors."""
MAX_GRID_REACH = 1.2
"""Largest distance of the outermost values in the scaled coordinate, a factor of three."""
MAX_ITERATIONS = 12
"""Iterations of refitting the others."""
TOLERANCE = 0.01
"""Decrease of every point's χ² below which refitting stops."""


def profile_likelihood(
    full_problem: FullProblem, uncertainty: Uncertainty, criterion: Criterion, name: str
) -> Profile:
    """Return the profile of one coefficient, fitted or fixed.

    Parameters
    ----------
    full_problem
        The problem in all coefficients, at the fit's point.
    uncertainty
        At this point, of the coefficient and of those that are refitted for each of its values.
    criterion
        Weights of the residuals; priors are weakened until they only prevent divergence.
    """
    space, indices = full_problem.subspace(uncertainty.names)
    objective = replace(full_problem.objective, space=space)
    index = space.names.index(name)
    vector = np.asarray(full_problem.point.coefficients)[indices]
    centre = space.scaled(vector)
    error = float(uncertainty.covariance.data_error[index])
    reach = min(GRID_REACH_SE * error, MAX_GRID_REACH * uncertainty.reference[index])
    parameter = space.parameters[index]
    low, high = parameter.scaled(parameter.lower), parameter.scaled(parameter.upper)
    grid = np.linspace(max(centre[index] - reach, low), min(centre[index] + reach, high), POINTS)
    along = (
        uncertainty.covariance.data_only[:, index] / uncertainty.covariance.data_only[index, index]
    )
    # the others start from the quadratic approximation
    scaled = centre + np.outer(grid - centre[index], along)
    scaled[:, index] = grid
    starts = space.vector_at(scaled)
    chi = _refitted(objective, full_problem.point, criterion, starts, index)
    values = np.array([space.from_scaled(index, float(x)) for x in grid])
    # as the standard errors do, the likelihood allows for residuals that are not white noise
    rise = (chi - chi.min()) / uncertainty.covariance.beyond_noise[index] ** 2
    lowest = int(np.argmin(chi))
    quadratic = ((grid - grid[lowest]) / error) ** 2
    below = _crossing(values[lowest::-1], rise[lowest::-1])
    return Profile(
        name=name,
        unit=COEFFICIENTS[name].unit,
        values=values.tolist(),
        rise=rise.tolist(),
        quadratic=quadratic.tolist(),
        interval=(below, _crossing(values[lowest:], rise[lowest:])),
    )


def _refitted(
    objective: Objective, point: Point, criterion: Criterion, starts: Array, index: int
) -> Array:
    """Return χ² (S,) with one coordinate fixed and all others at their minimum."""
    offsets = np.asarray(point.offsets)
    count = len(objective.space)
    free = np.concatenate([np.ones(count), (offsets != 0.0).astype(float).ravel()])
    free[index] = 0.0
    weak_priors = replace(criterion, prior=1.0 / PRIOR_WIDENING)
    points = Point(starts, np.repeat(offsets[None], len(starts), axis=0))
    step, previous = initial_step(points), np.full(len(starts), np.inf)
    for _ in range(MAX_ITERATIONS):
        step = advance(objective, step, weak_priors, free)
        assert step.sums is not None
        chi = 2.0 * np.asarray(step.loss) * step.sums.compared[0]
        if np.all(previous - chi < TOLERANCE):
            break
        previous = chi
    return np.asarray(chi)


def _crossing(values: Array, rise: Array) -> float | None:
    """Return where a profile passes the threshold, on its way from its lowest point."""
    beyond = np.flatnonzero(rise > CHI_SQUARE_95)
    if len(beyond) == 0:
        return None
    outer = int(beyond[0])
    share = (CHI_SQUARE_95 - rise[outer - 1]) / (rise[outer] - rise[outer - 1])
    return float(values[outer - 1] + share * (values[outer] - values[outer - 1]))
