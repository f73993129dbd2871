"""Agreement of flights with each other, and with measurements on the ground.

Flights may need different values of a coefficient. It gets a second value in some of them, as the
last of K + 1 coefficients: size and error of the difference follow from the residuals at the fit.
Flights are split in two by the values that each needs, so that two vehicles, payloads or sets of
gains show.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Array, scaled_inverse, unit_diagonal
from tuner.disturbances.predictor import hidden_by_setpoints
from tuner.findings.findings import Code, Finding
from tuner.objective.information import FisherInformation, ResidualChange
from tuner.search.progress import Fit
from tuner.uncertainty.covariance import covariance_of
from tuner.uncertainty.estimates import READINGS, STUDENT_FACTOR, Uncertainty
from tuner.uncertainty.examination import Examination
from tuner.uncertainty.records import CONFLICT_SE, Sources
from tuner.vehicle import COEFFICIENTS

FALSE_ALARM_LEVEL = 0.001
"""Probability of a false alarm among all coefficients and splits."""
MIN_DIFFERENCE = 0.01
"""Least relative difference that is reported."""
MIN_LAG_STEPS = 0.5
"""Least difference of latencies and other lags about zero, in physics steps."""
MIN_OWN_INFORMATION = 0.01
"""Least share of the information on a coefficient that the others do not explain."""


class Split(NamedTuple):
    """Flights that need another value of a coefficient than the others.

    ``number`` is the coefficient's, ``error`` the difference's were residuals independent, and
    ``read`` that by errors of the voltmeter, which last for seconds and differ between flights.
    """

    number: int
    flights: NDArray[np.intp]
    difference: float
    error: float
    read: float = 0.0

    @property
    def ratio(self) -> float:
        """The difference in standard errors."""
        return self.difference / float(np.hypot(self.error, self.read))


def flights_disagree(fitted: Fit, examination: Examination) -> tuple[Finding, ...]:
    """Return the finding on the most significant split of flights, if one is significant.

    There is none where a flight already is reported as unmatched, or with gains of its own, and,
    where disturbances are estimated, none on coefficients that set-points hide: simulated flights
    alone show those, in which a gust's mean over a flight passes for a value of its own.
    """
    uncertainty, errors = examination.uncertainty, examination.model_errors
    reported = any(finding.code is Code.FLIGHT_UNMATCHED for finding in fitted.findings)
    if reported or (errors is not None and any(one.flight for one in errors.controller)):
        return ()
    names = uncertainty.names
    information = examination.information.about(np.arange(len(names)))
    followed = any(finding.code is Code.DISTURBANCES_FOLLOWED for finding in fitted.findings)
    hidden = hidden_by_setpoints(names, fitted.objective.model) & followed
    searched = [i for i, name in enumerate(names) if name not in fitted.held and not hidden[i]]
    splits = _splits(information, searched, len(uncertainty.flights))
    least = MIN_DIFFERENCE * np.asarray(uncertainty.reference)
    is_lag = [COEFFICIENTS[n].unit == "s" and COEFFICIENTS[n].neutral == 0.0 for n in names]
    least[is_lag] = MIN_LAG_STEPS * fitted.objective.schedule.step
    material = [one for one in splits if abs(one.difference) >= least[one.number]]
    if not material:
        return ()
    split = max(material, key=lambda one: abs(one.ratio))
    error = float(
        np.hypot(covariance_of(_with_two_values(information, split)).error[-1], split.read)
    )
    sure = abs(split.difference) > float(ndtri(1.0 - 0.5 * FALSE_ALARM_LEVEL / len(splits))) * error
    if not sure:
        return ()
    reference = float(uncertainty.reference[split.number])
    flights = ", ".join(uncertainty.flights[flight] for flight in split.flights)
    name, unit = names[split.number], tuple[str, ...]()
    if COEFFICIENTS[name].neutral == 0.0:  # a share of about nothing says nothing
        space = fitted.objective.space
        if not space.is_log[space.names.index(name)]:
            reference, unit = 1.0, (COEFFICIENTS[name].unit,)
    return (
        Code.FLIGHTS_DISAGREE.warning(
            flights, name, *unit, difference=split.difference / reference, error=error / reference
        ),
    )


def _splits(information: FisherInformation, searched: Sequence[int], flights: int) -> list[Split]:
    """Return all splits in two by the value that each flight needs, the smaller part of each."""
    size = information.score.shape[-1]
    blocks, score = np.zeros((flights, size, size)), np.zeros((flights, size))
    np.add.at(blocks, information.flight, information.blocks.sum(axis=(0, 2)))
    np.add.at(score, information.flight, information.score.sum(axis=(0, 2)))
    inverse = information.inverse.matrix
    to_minimum = -inverse @ information.slope
    drawn = [one for name, one in information.changes.items() if name.startswith(READINGS)]
    read = np.zeros((max(len(drawn), 1), flights, size))
    for slopes, change in zip(read, drawn, strict=False):
        np.add.at(slopes, information.flight, change.across.sum(axis=(0, 2)))

    def split(index: int, some: NDArray[np.intp]) -> Split:
        across = blocks[some, :, index].sum(axis=0)
        own = across[index] - across @ inverse @ across
        if own <= MIN_OWN_INFORMATION * across[index]:
            return Split(index, np.sort(some), 0.0, np.inf)
        left = score[some, index].sum() + across @ to_minimum
        moved = (read[:, some, index].sum(axis=1) - read.sum(axis=1) @ inverse @ across) / own
        by_readings = STUDENT_FACTOR * float(np.sqrt(np.mean(moved**2)))
        return Split(index, np.sort(some), float(-left / own), float(own**-0.5), by_readings)

    splits = []
    for index in searched:
        order = np.argsort([split(index, one).ratio for one in np.arange(flights)[:, None]])
        for part in range(1, flights):
            few = order[:part] if 2 * part <= flights else order[part:]
            splits.append(split(index, few))
    return splits


def _with_two_values(information: FisherInformation, split: Split) -> FisherInformation:
    """Return the information with a coefficient's difference in some flights as the last."""
    inside = np.isin(information.flight, split.flights)[:, None]
    across = np.where(inside[..., None], information.blocks[..., split.number], 0.0)
    score = np.where(inside, information.score[..., split.number], 0.0)
    return information.with_change(ResidualChange(across, across[..., split.number], score))


def sources_of(fitted: Fit, uncertainty: Uncertainty, total: Array) -> dict[str, Sources]:
    """Return each measured coefficient's value on the ground, from flights alone, and from both.

    It is empty for a fit without ground measurements.

    One Gauss-Newton step from the end of the fit without the ground measurements leads to the
    values of flights alone: there the loss's slope is minus that of the measurements. Standard
    errors of flights are widened for model error as those of the fit are.

    Parameters
    ----------
    fitted, uncertainty
        The fit; coefficients held at initial values have none from flights.
    total
        (K, K) information about its parameters, priors and ground measurements included.
    """
    space = fitted.objective.space
    prior, rows, offset = space.joint_prior, space.joint_rows, space.joint_offset
    if prior is None:
        return {}
    end = space.scaled(fitted.point.coefficients)
    flights_only = total - rows.T @ rows
    held = set(fitted.held.values())
    moves = np.array([name not in held for name in space.names])
    inverse = np.zeros_like(flights_only)
    inverse[np.ix_(moves, moves)] = scaled_inverse(flights_only[np.ix_(moves, moves)])
    alone = end + inverse @ rows.T @ (rows @ end + offset)
    alone_error = np.sqrt(np.diag(inverse)) * uncertainty.covariance.beyond_noise
    unit = unit_diagonal(prior.information)
    measured = np.linalg.pinv(prior.information * np.outer(unit, unit), rcond=1e-10)
    ground_error = np.sqrt(np.diag(measured)) * unit
    sources = {}
    for place, name in enumerate(prior.names):
        if name not in space.names:
            continue
        index = space.names.index(name)
        parameter = space.parameters[index]
        estimate = uncertainty.estimates[name]
        ground = float(prior.mean[place])
        identified = bool(moves[index])
        spread = float(np.hypot(alone_error[index], ground_error[place]))
        sources[name] = Sources(
            ground=parameter.value_at(ground),
            ground_error=parameter.error_at(ground, ground_error[place]),
            flights=parameter.value_at(alone[index]) if identified else None,
            flights_error=parameter.error_at(alone[index], alone_error[index])
            if identified
            else None,
            both=estimate.value,
            both_error=estimate.std_error,
            deviation=float(alone[index] - ground) / spread if identified else None,
        )
    return sources


def ground_conflicts(sources: Mapping[str, Sources], mass: float | None) -> Iterator[Finding]:
    """Return findings on coefficients where ground measurements and flights contradict each other.

    Where flights determine only a coefficient over the mass, with the mass at which they agree.
    ``mass`` is that of the fit in kg, None if it was fitted.
    """
    for name, source in sources.items():
        if (
            source.flights is None
            or source.deviation is None
            or abs(source.deviation) <= CONFLICT_SE
        ):
            continue
        row, ground, flights = COEFFICIENTS[name], source.ground, source.flights
        numbers = {"deviation": source.deviation, "ground": ground, "flights": flights}
        if mass is not None and row.mass_exponent == 1:
            numbers["mass"] = mass * ground / flights
        yield Code.GROUND_CONFLICT.warning(name, row.unit, **numbers)
