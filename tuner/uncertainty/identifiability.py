"""Identifiability: what the flights do not identify is held at initial values, the rest refitted.

Coefficients that trade off exactly keep their product however far they drift. Setting each back to
its initial value would worsen the fit; so one of every such group, the stand-in, is held, and the
others are fitted given its value.

A term that nobody asked for, that the flights do not identify and that ends at a bound is in the
model by chance: it goes back to where it began, whatever the fitted flights gained by it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import scaled_solve
from tuner.core.phrases import listed
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import normal_equations
from tuner.search.estimation import LAST, LAST_TWO, free_offsets, polished
from tuner.search.problem import Job
from tuner.search.progress import Fitted, Free, Progress
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.examination import Examination, examine
from tuner.uncertainty.model_error import alternatives_of, lack_of
from tuner.uncertainty.verdict import IDENTIFIABLE_ERROR, ReasonCode
from tuner.vehicle import COEFFICIENTS

MAX_ROUNDS = 3
"""Largest number of rounds: what is held may leave something else undetermined."""
SEARCH_TOLERANCE = 0.002
"""Share of the loss by which it may rise where one of what trades off exactly is held: what an
optimiser leaves. More says that the others cannot follow, their bounds being in the way, say."""
RIDGE = 1e-12
"""Added to a Hessian of unit diagonal."""
CLOSED_LOOP_TOLERANCE = 2.0
"""Times the loss of flights in their closed loop, likewise: gusts make less of a difference."""


def with_undetermined_held(
    job: Job,
    fitted: Fitted,
    on_progress: Callable[[Job, Progress], None],
    on_message: Callable[[str], None],
    *,
    in_doubt: Mapping[str, float] = MappingProxyType({}),
) -> tuple[Fitted, Examination]:
    """Return the fit once all that it does not identify is held, and its examination.

    A fit that predicts from recorded states keeps the values of all but those that trade off:
    together they predict, even where the flights do not tell them apart, and each one's verdict
    says so. All are kept where the flights are met worse by what follows: by anything there, and by
    twice the loss in a closed loop.
    """
    lack = lack_of(fitted, job.fitted)

    def examined(fitted: Fitted) -> Examination:
        otherwise = alternatives_of(fitted.objective, fitted.point, job.fitted)
        return examine(fitted, otherwise=otherwise, in_doubt=in_doubt, lack=lack)

    examination = examined(fitted)
    segments = fitted.objective.segments
    predicts = segments.windowed and segments.freedom is None
    for _ in range(MAX_ROUNDS):
        found = stand_ins_of(examination.uncertainty)
        if predicts:
            traded = {stand_in for name, stand_in in found.items() if name != stand_in}
            found = {name: stand_in for name, stand_in in found.items() if stand_in in traded}
        stand_ins = found | dict(fitted.held)
        names = sorted(set(stand_ins.values()))
        if set(names) <= set(fitted.held.values()):
            break
        on_message(
            f"The flights do not identify {listed(names)}: held at the initial value, and the "
            "others are fitted again."
        )
        rest = hold(job, fitted, stand_ins, on_progress, stages=LAST if predicts else LAST_TWO)
        if not _rise(fitted, rest) < (
            1.0 + SEARCH_TOLERANCE if predicts else CLOSED_LOOP_TOLERANCE
        ):
            on_message(
                f"With {listed(names)} at the initial value the flights are met worse: all keep "
                "their values."
            )
            break
        fitted = rest
        examination = examined(fitted)
    for _ in range(MAX_ROUNDS):
        idle = _idle_terms(job, fitted, examination.uncertainty)
        if not idle:
            break
        on_message(
            f"The flights do not identify {listed(idle)}, which ended at a bound: taken out of the "
            "model, and the others are fitted again."
        )
        stand_ins = dict(fitted.held) | {name: name for name in idle}
        fitted = hold(job, fitted, stand_ins, on_progress)
        examination = examined(fitted)
    return fitted, examination


def _idle_terms(job: Job, fitted: Fitted, uncertainty: Uncertainty) -> tuple[str, ...]:
    """Return what was free of terms that the job does not ask for, and ended undetermined.

    At a bound, that is: elsewhere it may be of use, though nobody can say how large it is.
    """
    settings, held = job.settings.job, set(fitted.held.values())
    asked = set(settings.free or ())
    if not isinstance(settings.terms, str):
        asked.update(name for names in job.first_terms.values() for name in names)
    return tuple(
        name
        for name in uncertainty.names
        if COEFFICIENTS[name].group
        and name not in held | asked
        and not uncertainty.estimates[name].reason.identifiable
        and uncertainty.estimates[name].reason.bound is not None
    )


def _rise(fitted: Fitted, other: Fitted) -> float:
    """Return how many times as large a fit's loss, by its own noise, is where another has led."""
    before, after = (
        float(np.sum(fitted.objective.sums(f.point, fitted.criterion, derivatives=False).loss))
        for f in (fitted, other)
    )
    return after / before


def stand_ins_of(uncertainty: Uncertainty) -> dict[str, str]:
    """Return each coefficient that the flights do not identify -> its stand-in, which is held.

    A coefficient is its own stand-in unless it trades off against another one. What they determine
    but for disturbances and model error stays where they put it, with a wide interval: it is no
    better known where the search began. So does all where the fitted vehicle flies otherwise.
    """
    undetermined = [
        name
        for name in uncertainty.names
        if not uncertainty.estimates[name].identifiable
        and uncertainty.estimates[name].reason.code is not ReasonCode.REFUTED
        and name not in _known_roughly(uncertainty)
    ]
    stand_ins: dict[str, str] = {}
    for direction in uncertainty.directions:
        members = [
            name for name in direction.moves if name in undetermined and name not in stand_ins
        ]
        if not direction.null or len(members) < 2:
            continue
        ranked = sorted(members, key=lambda name: _rank(name, direction.moves))
        stand_ins |= dict.fromkeys(members, ranked[0])
    return stand_ins | {name: name for name in undetermined if name not in stand_ins}


def _known_roughly(uncertainty: Uncertainty) -> frozenset[str]:
    """Return the coefficients whose interval would be narrow if residuals were noise alone."""
    covariance = uncertainty.covariance
    of_noise = covariance.data_error / covariance.beyond_noise / uncertainty.reference
    return frozenset(
        name
        for name, error in zip(uncertainty.names, of_noise, strict=True)
        if uncertainty.estimates[name].reason.code is ReasonCode.WIDE_INTERVAL
        and error < IDENTIFIABLE_ERROR
    )


def _rank(name: str, moves: Mapping[str, float]) -> tuple[float, float]:
    rank = COEFFICIENTS[name].hold_rank
    return math.inf if rank is None else rank, -abs(moves[name])


def hold(
    job: Job,
    fitted: Fitted,
    stand_ins: Mapping[str, str],
    on_progress: Callable[[Job, Progress], None],
    *,
    stages: slice = LAST_TWO,
) -> Fitted:
    """Return the fit with the held coefficients at their initial values and the others polished.

    From where the others make up for that to first order.

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
    free = Free(~is_held, free_offsets(job))
    point = _moved(fitted, np.where(is_held, space.initial, fitted.point.coefficients), free)
    end = polished(
        job,
        replace(fitted, point=point),
        free=free,
        stages=stages,
        title=f"with {len(names)} held",
        on_progress=lambda progress: on_progress(job, progress),
    )
    return replace(
        end, held=dict(stand_ins), wall_time=fitted.wall_time + time.perf_counter() - clock
    )


def _moved(fitted: Fitted, vector: NDArray[np.float64], free: Free) -> Point:
    """Return the point with some coefficients elsewhere (K,), what is free following them."""
    objective, point = fitted.objective, fitted.point
    sums = objective.sums(point, fitted.criterion)
    hessian = normal_equations(objective, point, fitted.criterion, sums).hessian
    change = np.zeros(len(hessian))
    change[: len(vector)] = vector - point.coefficients
    follow = np.flatnonzero(np.concatenate([free.coefficients, free.offsets.ravel()]))
    square = hessian[np.ix_(follow, follow)]
    change[follow] = -scaled_solve(square, (hessian @ change)[follow], RIDGE)
    return Point(
        point.coefficients + change[: len(vector)],
        point.offsets + change[len(vector) :].reshape(point.offsets.shape),
    )
