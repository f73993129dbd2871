"""Everything that one Jacobian at the end of a fit can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.objective.flight_batches import portion, portions
from tuner.search.fitted import Fitted
from tuner.sensitivity.local import LocalSensitivity, local_sensitivity
from tuner.uncertainty.estimates import Uncertainty, references, uncertainty_at
from tuner.uncertainty.full_problem import FullProblem, full_problem_of
from tuner.uncertainty.information import FisherInformation, information_from_jacobian
from tuner.uncertainty.whiteness import Residual, whiteness

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Examination:
    """What the flights say about every coefficient, the fixed ones too.

    Attributes
    ----------
    uncertainty
        Of the fitted ones.
    freed
        Fixed coefficient -> what would be known, had it been fitted beside the others; it is the
        last parameter there.
    bias
        (L, K): percent by which each fitted coefficient is wrong for each percent by which a fixed
        one is; the fixed ones in the order of ``freed``, the fitted in that of ``uncertainty``.
    sensitivity
        Of the flights to all, the fitted first.
    residuals
        Of every flight and channel.
    every, evidence
        The problem in all coefficients, the fitted first, and the information about them.
    """

    uncertainty: Uncertainty
    freed: Mapping[str, Uncertainty]
    bias: Array
    sensitivity: LocalSensitivity
    residuals: tuple[Residual, ...]
    full_problem: FullProblem
    information: FisherInformation


def examine(
    fitted: Fitted,
    *,
    names: Sequence[str] | None = None,
    clocks: NDArray[np.bool_] | None = None,
) -> Examination:
    """Look at a fit, or at a point where nothing was fitted, from all sides.

    Flights whose Jacobian would not fit the objective's memory take turns.

    Parameters
    ----------
    fitted
        A search's result.
    names
        Of the fitted flights in the order of the objective; ``fitted.scales``' by default.
    clocks
        (offsets, N) which offsets were fitted; by default those that are not exactly zero.
    """
    names = tuple(fitted.scales) if names is None else tuple(names)
    full_problem = full_problem_of(fitted.objective, fitted.point)
    objective, point, criterion = full_problem.objective, full_problem.point, fitted.criterion
    reference = references(objective.space, np.asarray(point.coefficients))
    evidences, sensitivities = [], []
    residuals: list[Residual] = []
    for flights in portions(objective, point, criterion):
        some = portion(objective, point, criterion, flights)
        jacobian = some[0].jacobian(*some[1:], columns=full_problem.columns)
        own = [names[number] for number in flights]
        free = None if clocks is None else clocks[:, flights]
        evidences.append(information_from_jacobian(*some, jacobian, clocks=free))
        sensitivities.append(local_sensitivity(*some, jacobian, reference=reference, flights=own))
        residuals.extend(whiteness(some[0], jacobian, some[2], own))
    information = FisherInformation.joined(evidences)
    return Examination(
        uncertainty=_judged(full_problem, information, full_problem.fitted, names),
        freed={
            name: _judged(full_problem, information, (*full_problem.fitted, name), names)
            for name in full_problem.fixed
        },
        bias=_bias(full_problem, information, reference),
        sensitivity=LocalSensitivity.joined(sensitivities),
        residuals=tuple(residuals),
        full_problem=full_problem,
        information=information,
    )


def _judged(
    full_problem: FullProblem,
    information: FisherInformation,
    names: tuple[str, ...],
    flights: Sequence[str],
) -> Uncertainty:
    space, places = full_problem.only(names)
    vector = np.asarray(full_problem.point.coefficients)[places]
    return uncertainty_at(space, vector, part(information, places), flights)


def part(information: FisherInformation, places: NDArray[np.intp]) -> FisherInformation:
    """Return what the data say about some coefficients while the others stay as they are."""
    square = np.ix_(places, places)
    return replace(
        information,
        blocks=information.blocks[..., places, :][..., places],
        score=information.score[..., places],
        clock_prior=information.clock_prior[square],
        prior=information.prior[square],
    )


def _bias(full_problem: FullProblem, information: FisherInformation, reference: Array) -> Array:
    """Return how the fitted coefficients follow the fixed ones, relative to both references."""
    count = len(full_problem.fitted)
    total, data = information.total[:count, :count], information.data[:count, count:]
    follow = -np.linalg.solve(total, data).T
    return np.asarray(follow * reference[count:, None] / reference[:count])
