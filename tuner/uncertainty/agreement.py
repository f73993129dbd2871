"""Whether flights agree on each coefficient, or some of them call for another value.

A coefficient is given a second value in some of the flights, as the last of K + 1 coefficients: how
large the difference is, and its error, follow from what residuals say at the fit. What flights call
for one by one splits them in two, so that two vehicles, payloads or sets of gains show.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri  # scipy.stats takes a quarter of a second to import

from tuner.findings.findings import Code, Finding
from tuner.objective.information import Change, FisherInformation
from tuner.search.progress import Fitted
from tuner.uncertainty.covariance import covariance_of
from tuner.uncertainty.examination import Examination

LEVEL = 0.001
"""Probability of a false alarm among all coefficients and splits."""
MATTERS = 0.01
"""Difference, as a share of the coefficient, below which one vehicle is as good as two."""
TOLD = 0.01
"""Share of what flights say of a coefficient, all others beside it, from which they tell of it."""


class Split(NamedTuple):
    """Flights that call for another value of a coefficient than the others do.

    ``number`` is the coefficient's, ``error`` the difference's were residuals independent.
    """

    number: int
    flights: NDArray[np.intp]
    difference: float
    error: float

    @property
    def ratio(self) -> float:
        """The difference in standard errors."""
        return self.difference / self.error


def flights_disagree(fitted: Fitted, examination: Examination) -> tuple[Finding, ...]:
    """Return which flights are surest to call for another value of a coefficient, if some do.

    Nothing where a flight is told already to be another's, or to have gains of its own.
    """
    uncertainty, errors = examination.uncertainty, examination.model_errors
    told = any(finding.code is Code.FLIGHT_UNMATCHED for finding in fitted.findings)
    if told or (errors is not None and any(one.flight for one in errors.controller_estimates)):
        return ()
    names = uncertainty.names
    information = examination.information.about(np.arange(len(names)))
    searched = [index for index, name in enumerate(names) if name not in fitted.held]
    splits = _splits(information, searched, len(uncertainty.flights))
    if not splits:
        return ()
    split = max(splits, key=lambda one: abs(one.ratio))
    error = float(covariance_of(_with_two_values(information, split)).error[-1])
    sure = abs(split.difference) > float(ndtri(1.0 - 0.5 * LEVEL / len(splits))) * error
    reference = float(uncertainty.reference[split.number])
    if not sure or abs(split.difference) < MATTERS * reference:
        return ()
    numbers = {"difference": split.difference / reference, "error": error / reference}
    flights = ", ".join(uncertainty.flights[flight] for flight in split.flights)
    return (Finding(Code.FLIGHTS_DISAGREE, "warning", flights, numbers, (names[split.number],)),)


def _splits(information: FisherInformation, searched: Sequence[int], flights: int) -> list[Split]:
    """Return all splits in two by what each flight calls for, the smaller part of each."""
    size = information.score.shape[-1]
    known, score = np.zeros((flights, size, size)), np.zeros((flights, size))
    np.add.at(known, information.flight, information.blocks.sum(axis=(0, 2)))
    np.add.at(score, information.flight, information.score.sum(axis=(0, 2)))
    inverse = information.inverse.matrix
    to_minimum = -inverse @ information.slope

    def split(index: int, some: NDArray[np.intp]) -> Split:
        across = known[some, :, index].sum(axis=0)
        own = across[index] - across @ inverse @ across
        if own <= TOLD * across[index]:
            return Split(index, np.sort(some), 0.0, np.inf)
        left = score[some, index].sum() + across @ to_minimum
        return Split(index, np.sort(some), float(-left / own), float(own**-0.5))

    found = []
    for index in searched:
        order = np.argsort([split(index, one).ratio for one in np.arange(flights)[:, None]])
        for part in range(1, flights):
            few = order[:part] if 2 * part <= flights else order[part:]
            found.append(split(index, few))
    return found


def _with_two_values(information: FisherInformation, split: Split) -> FisherInformation:
    """Return the information with a coefficient's difference in some flights as the last."""
    inside = np.isin(information.flight, split.flights)[:, None]
    across = np.where(inside[..., None], information.blocks[..., split.number], 0.0)
    score = np.where(inside, information.score[..., split.number], 0.0)
    return information.beside(Change(across, across[..., split.number], score))
