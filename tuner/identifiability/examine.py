"""Everything that one Jacobian at the end of a fit can tell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tuner.identifiability.every import Every, every_coefficient
from tuner.identifiability.evidence import Evidence, summed
from tuner.identifiability.portions import portion, portions
from tuner.identifiability.sensitivity import Sensitivity, sensitivity
from tuner.identifiability.uncertainty import Uncertainty, judged, references
from tuner.identifiability.whiteness import Residual, whiteness
from tuner.search.fitted import Fitted

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
    sensitivity: Sensitivity
    residuals: tuple[Residual, ...]
    every: Every
    evidence: Evidence


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
    every = every_coefficient(fitted.objective, fitted.point)
    objective, point, stage = every.objective, every.point, fitted.stage
    reference = references(objective.space, np.asarray(point.coefficients))
    evidences, sensitivities = [], []
    residuals: list[Residual] = []
    for flights in portions(objective, point, stage):
        some = portion(objective, point, stage, flights)
        jacobian = some[0].jacobian(*some[1:], columns=every.columns)
        own = [names[number] for number in flights]
        free = None if clocks is None else clocks[:, flights]
        evidences.append(summed(*some, jacobian, clocks=free))
        sensitivities.append(sensitivity(*some, jacobian, reference=reference, flights=own))
        residuals.extend(whiteness(some[0], jacobian, some[2], own))
    evidence = Evidence.joined(evidences)
    return Examination(
        uncertainty=_judged(every, evidence, every.fitted, names),
        freed={
            name: _judged(every, evidence, (*every.fitted, name), names) for name in every.fixed
        },
        bias=_bias(every, evidence, reference),
        sensitivity=Sensitivity.joined(sensitivities),
        residuals=tuple(residuals),
        every=every,
        evidence=evidence,
    )


def _judged(
    every: Every, evidence: Evidence, names: tuple[str, ...], flights: Sequence[str]
) -> Uncertainty:
    space, places = every.only(names)
    vector = np.asarray(every.point.coefficients)[places]
    return judged(space, vector, part(evidence, places), flights)


def part(evidence: Evidence, places: NDArray[np.intp]) -> Evidence:
    """Return what the data say about some coefficients while the others stay as they are."""
    square = np.ix_(places, places)
    return replace(
        evidence,
        information=evidence.information[..., places, :][..., places],
        score=evidence.score[..., places],
        clock_prior=evidence.clock_prior[square],
        prior=evidence.prior[square],
    )


def _bias(every: Every, evidence: Evidence, reference: Array) -> Array:
    """Return how the fitted coefficients follow the fixed ones, relative to both references."""
    count = len(every.fitted)
    total, data = evidence.total[:count, :count], evidence.data[:count, count:]
    follow = -np.linalg.solve(total, data).T
    return np.asarray(follow * reference[count:, None] / reference[:count])
