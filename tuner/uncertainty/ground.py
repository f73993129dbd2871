"""Comparison of coefficients from ground measurements, from flights, and from both."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.core.numerics import Array, scaled_inverse, unit_diagonal
from tuner.findings.findings import Code, Finding
from tuner.objective.space import Space
from tuner.search.progress import Fitted
from tuner.uncertainty.estimates import Uncertainty
from tuner.uncertainty.records import CONFLICT_SE, Sources
from tuner.vehicle import COEFFICIENTS


def sources_of(fitted: Fitted, uncertainty: Uncertainty, total: Array) -> dict[str, Sources]:
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
        estimate = uncertainty.estimates[name]
        ground = float(prior.mean[place])
        known = bool(moves[index])
        spread = float(np.hypot(alone_error[index], ground_error[place]))
        sources[name] = Sources(
            ground=space.from_scaled(index, ground),
            ground_error=_error(space, index, ground, ground_error[place]),
            flights=space.from_scaled(index, alone[index]) if known else None,
            flights_error=_error(space, index, alone[index], alone_error[index]) if known else None,
            both=estimate.value,
            both_error=estimate.std_error,
            deviation=float(alone[index] - ground) / spread if known else None,
        )
    return sources


def _error(space: Space, index: int, scaled: float, error: float) -> float:
    value = space.from_scaled(index, float(scaled))
    return float(error * value) if space.is_log[index] else float(error)


def ground_conflicts(sources: Mapping[str, Sources], mass: float | None) -> tuple[Finding, ...]:
    """Return findings on coefficients where ground measurements and flights contradict each other.

    Where flights determine only a coefficient over the mass, with the mass at which they agree.
    ``mass`` is that of the fit in kg, None if it was fitted.
    """
    findings = []
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
        findings.append(Finding(Code.GROUND_CONFLICT, "warning", name, numbers, (row.unit,)))
    return tuple(findings)
