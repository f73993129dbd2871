"""Identifiability: undetermined coefficients are held at initial values, the rest refitted.

Coefficients that trade off exactly keep their product however far they drift. Setting all back to
their initial values would worsen the fit; so one of every such group, the stand-in, is held, and
the others are fitted given its value.

A selected term that the flights do not determine and that ends at a bound is in the model by
chance: it goes back to its initial value, whatever the loss. A law that a vehicle does not follow
(`by_law`) is no such term: far from its value there it has no effect, and flights tell no more.

The profile of the likelihood shows how far one coefficient may go where all others follow.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array, scaled_solve
from tuner.core.phrases import listed
from tuner.objective.criterion import Criterion, Point
from tuner.objective.normal_equations import Objective, normal_equations
from tuner.search.continuation import RIDGE
from tuner.search.estimation import BOTH_POLISHES, LAST_POLISH, free_parameters, polished
from tuner.search.listener import Reporter
from tuner.search.optimisers import advance, initial_step
from tuner.search.problem import Job
from tuner.search.progress import Fit
from tuner.uncertainty.covariance import PRIOR_WIDENING
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import Examination, FullProblem, examine
from tuner.uncertainty.model_error import alternatives_of, model_errors_of
from tuner.uncertainty.records import CHI_SQUARE_95, Profile
from tuner.uncertainty.verdict import MAX_IDENTIFIABLE_ERROR, ReasonCode
from tuner.vehicle import COEFFICIENTS

MAX_ROUNDS = 3
"""Largest number of rounds: holding some coefficients may leave others undetermined."""
SEARCH_TOLERANCE = 0.002
"""Largest relative rise of the loss by holding one of an exact trade-off: an optimiser's remainder.
A larger one shows that the others could not follow, by their bounds for example."""
CLOSED_LOOP_TOLERANCE = 2.0
"""Largest relative rise of the loss in closed loop: gusts raise it by less."""


def hold_undetermined(
    job: Job,
    fitted: Fit,
    reporter: Reporter,
    *,
    selection_shifts: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Fit, Examination]:
    """Return the fit with undetermined coefficients held, and its examination.

    A fit that predicts from recorded states holds only those that trade off: together the others
    predict even where they are undetermined, as their verdicts say. Nothing is held where that
    raises the loss by more than the tolerances.
    """
    model_errors = model_errors_of(fitted, job.fitted)

    def examined(fitted: Fit) -> Examination:
        alternatives = alternatives_of(fitted.objective, fitted.point, job.fitted)
        return examine(
            fitted,
            alternatives=alternatives,
            selection_shifts=selection_shifts,
            model_errors=model_errors,
        )

    examination = examined(fitted)
    segments = fitted.objective.segments
    predicts = segments.windowed and segments.start_sd is None
    for _ in range(MAX_ROUNDS):
        undetermined = stand_ins_of(examination.uncertainty)
        if predicts:
            traded = {stand_in for name, stand_in in undetermined.items() if name != stand_in}
            undetermined = {
                name: stand_in for name, stand_in in undetermined.items() if stand_in in traded
            }
        stand_ins = undetermined | dict(fitted.held)
        names = sorted(set(stand_ins.values()))
        if set(names) <= set(fitted.held.values()):
            break
        reporter.on_message(
            f"The flights do not identify {listed(names)}: held at the initial value, and the "
            "others are fitted again."
        )
        rest = hold(
            job, fitted, stand_ins, reporter, stages=LAST_POLISH if predicts else BOTH_POLISHES
        )
        if not _loss_ratio(fitted, rest) < (
            1.0 + SEARCH_TOLERANCE if predicts else CLOSED_LOOP_TOLERANCE
        ):
            reporter.on_message(
                f"With {listed(names)} at the initial value the flights are met worse: all keep "
                "their values."
            )
            break
        fitted = rest
        examination = examined(fitted)
    for _ in range(MAX_ROUNDS):
        idle = _undetermined_terms(job, fitted, examination.uncertainty)
        if not idle:
            break
        reporter.on_message(
            f"The flights do not identify {listed(idle)}, which ended at a bound: taken out of the "
            "model, and the others are fitted again."
        )
        stand_ins = dict(fitted.held) | {name: name for name in idle}
        fitted = hold(job, fitted, stand_ins, reporter)
        examination = examined(fitted)
    return fitted, examination


def _undetermined_terms(job: Job, fitted: Fit, uncertainty: Uncertainty) -> tuple[str, ...]:
    """Return the undetermined coefficients of selected terms that ended at a bound.

    Those elsewhere may improve predictions.
    """
    settings, held = job.settings.job, set(fitted.held.values())
    chosen = set(settings.free or ())
    if not isinstance(settings.terms, str):
        chosen.update(name for names in job.first_terms.values() for name in names)
    return tuple(
        name
        for name in uncertainty.names
        if (row := COEFFICIENTS[name]).group
        and row.by_law is None
        and name not in held | chosen
        and not uncertainty.estimates[name].reason.identifiable
        and uncertainty.estimates[name].reason.bound is not None
    )


def _loss_ratio(fitted: Fit, other: Fit) -> float:
    """Return the loss at another fit over that at a fit, both by the noise of the fit."""
    before, after = (
        float(np.sum(fitted.objective.sums(f.point, fitted.criterion, derivatives=False).loss))
        for f in (fitted, other)
    )
    return after / before


def stand_ins_of(uncertainty: Uncertainty) -> dict[str, str]:
    """Return each coefficient that the flights do not identify -> its stand-in, which is held.

    A coefficient is its own stand-in unless it trades off against another one. Coefficients that
    noise alone would leave determined keep their values, with a wide interval: the initial value
    is no better. So do those of a law, unless they trade off, and all where the flights refute the
    fit.
    """
    undetermined = [
        name
        for name in uncertainty.names
        if not uncertainty.estimates[name].identifiable
        and uncertainty.estimates[name].reason.code is not ReasonCode.REFUTED
        and name not in _narrow_by_noise(uncertainty)
    ]
    stand_ins: dict[str, str] = {}
    for direction in uncertainty.directions:
        members = [
            name for name in direction.moves if name in undetermined and name not in stand_ins
        ]
        if not direction.null or len(members) < 2:
            continue
        ranks = {name: COEFFICIENTS[name].hold_rank for name in members}
        order = {
            name: (math.inf if rank is None else rank, -abs(direction.moves[name]))
            for name, rank in ranks.items()
        }
        stand_ins |= dict.fromkeys(members, min(members, key=order.__getitem__))
    alone = (name for name in undetermined if name not in stand_ins)
    return stand_ins | {name: name for name in alone if COEFFICIENTS[name].by_law is None}


def _narrow_by_noise(uncertainty: Uncertainty) -> frozenset[str]:
    """Return the coefficients that would be identifiable if residuals were noise alone."""
    covariance = uncertainty.covariance
    of_noise = covariance.data_error / covariance.beyond_noise / uncertainty.reference
    return frozenset(
        name
        for name, error in zip(uncertainty.names, of_noise, strict=True)
        if uncertainty.estimates[name].reason.code is ReasonCode.WIDE_INTERVAL
        and error < MAX_IDENTIFIABLE_ERROR
    )


def hold(
    job: Job,
    fitted: Fit,
    stand_ins: Mapping[str, str],
    reporter: Reporter,
    *,
    stages: slice = BOTH_POLISHES,
) -> Fit:
    """Return the fit with the stand-ins held at their initial values and the others refitted.

    The refit starts where the others make up for that to first order.

    Parameters
    ----------
    stand_ins
        Coefficient -> stand-in, as of `stand_ins_of`; the stand-ins are held, the others stay free.
    """
    names, space = set(stand_ins.values()), job.space
    is_held = np.array([name in names for name in space.names])
    if not is_held.any():
        return fitted
    clock = time.perf_counter()
    free = free_parameters(job, held=names)
    point = _point_after_holding(
        fitted, np.where(is_held, space.initial, fitted.point.coefficients), free
    )
    end = polished(
        job,
        replace(fitted, point=point),
        free=free,
        stages=stages,
        title=f"with {len(names)} held",
        on_progress=lambda progress: reporter.on_progress(job, progress),
    )
    return replace(
        end, held=dict(stand_ins), wall_time=fitted.wall_time + time.perf_counter() - clock
    )


def _point_after_holding(fitted: Fit, vector: NDArray[np.float64], free: Point) -> Point:
    """Return the point with the coefficients at a vector (K,), and the free ones moved to suit."""
    objective, point = fitted.objective, fitted.point
    sums = objective.sums(point, fitted.criterion)
    hessian = normal_equations(objective, point, fitted.criterion, sums).hessian
    change = np.zeros(len(hessian))
    change[: len(vector)] = vector - point.coefficients
    follow = np.flatnonzero(free.packed)
    square = hessian[np.ix_(follow, follow)]
    change[follow] = -scaled_solve(square, (hessian @ change)[follow], RIDGE)
    return point.after(change)


POINTS = 13
"""Number of the coefficient's values, the middle one that of the fit."""
GRID_REACH_SE = 3.5
"""Distance of the outermost values in standard errors."""
MAX_GRID_REACH = 1.2
"""Largest distance of the outermost values in the scaled coordinate, a factor of three."""
MAX_ITERATIONS = 12
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
    values = np.array([space.parameters[index].value_at(x) for x in grid])
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
    free = Point(np.arange(len(objective.space)) != index, offsets != 0.0).packed
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
