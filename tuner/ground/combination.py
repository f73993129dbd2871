"""Several measurements into one set of coefficients: generalised least squares and its tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc  # scipy.stats takes a second to import

from tuner.core.numerics import scaled_inverse, scaled_solve, symmetric_eigen
from tuner.ground.measurement import Array, Measurement
from tuner.vehicle import COEFFICIENTS

CONFLICT = 3.0
"""Standard errors apart beyond which two measurements of one number contradict each other."""
UNKNOWN = 1e-11
"""Share of the best-known direction's information below which a direction is not measured."""
DISAGREE = 0.01
"""p-value below which the experiments are said to disagree."""
SMALL = 1e-6
"""Share of a coefficient that may lie in unmeasured directions, for rounding."""


@dataclass(frozen=True)
class Conflict:
    """An experiment that contradicts what all others say of the same number.

    Attributes
    ----------
    experiment
        Its name.
    names
        The coefficients that its number depends on.
    measured, expected
        Its number, in scaled coordinates, and what the others predict.
    deviation
        Their difference in standard errors.
    """

    experiment: str
    names: tuple[str, ...]
    measured: float
    expected: float
    deviation: float


@dataclass(frozen=True)
class Combination:
    """What all measurements together say.

    Attributes
    ----------
    names
        The N coefficients that some measurement speaks of.
    scaled
        (N,) best scaled coordinates.
    information
        (N, N) inverse covariance, singular where a combination of coefficients was not measured.
    covariance
        (N, N) in the directions that were measured, zero in the others.
    determined
        (N,) whether the measurements alone determine it.
    chi_square, degrees_of_freedom, p_value
        Of the hypothesis that all agree; a p-value of 1 where nothing was measured twice.
    conflicts
        Experiments that the others contradict, the worst first.
    """

    names: tuple[str, ...]
    scaled: Array
    information: Array
    covariance: Array
    determined: np.ndarray[tuple[int], np.dtype[np.bool_]]
    chi_square: float
    degrees_of_freedom: int
    p_value: float
    conflicts: tuple[Conflict, ...]


def combine(measurements: Sequence[Measurement], known: Mapping[str, float]) -> Combination:
    """Return the generalised least squares estimate (Gauss-Markov) of all coefficients.

    Of what was not measured (a torque stand without a thrust stand) the estimate moves as little
    from the vehicle file as it can, each coefficient in units of its prior's standard deviation.

    Parameters
    ----------
    measurements
        At least one.
    known
        Coefficient -> scaled coordinate in the vehicle file.
    """
    names = tuple(dict.fromkeys(n for measurement in measurements for n in measurement.names))
    start = np.array([known[name] for name in names])
    information, pull = _normal_equations(measurements, names, start)
    covariance, unmeasured = _inverse(information, names)
    lost = (unmeasured**2).sum(axis=1)
    scaled = start + covariance @ pull
    numbers = sum(len(measurement.value) for measurement in measurements)
    freedom = numbers - (len(names) - unmeasured.shape[1])
    chi_square = float(sum(_chi_square(m, names, scaled) for m in measurements))
    return Combination(
        names=names,
        scaled=scaled,
        information=information,
        covariance=covariance,
        determined=lost < SMALL,
        chi_square=chi_square,
        degrees_of_freedom=freedom,
        p_value=float(chdtrc(freedom, chi_square)) if freedom > 0 else 1.0,
        conflicts=_conflicts(measurements, names, start),
    )


def _inverse(information: Array, names: Sequence[str]) -> tuple[Array, Array]:
    """Return the covariance of what was measured, and (N, U) the directions that were not.

    The directions are those of coordinates in units of the default priors' standard deviations.
    """
    unit = np.array([COEFFICIENTS[name].prior_sd for name in names])
    values, vectors = symmetric_eigen(information * np.outer(unit, unit))
    measured = values > UNKNOWN * values.max(initial=1e-300)
    inverse = (vectors[:, measured] / values[measured]) @ vectors[:, measured].T
    return inverse * np.outer(unit, unit), vectors[:, ~measured]


def _design(measurement: Measurement, names: Sequence[str]) -> Array:
    return np.array([[row.get(name, 0.0) for name in names] for row in measurement.rows])


def _normal_equations(
    measurements: Sequence[Measurement], names: Sequence[str], start: Array
) -> tuple[Array, Array]:
    information, pull = np.zeros((len(names), len(names))), np.zeros(len(names))
    for measurement in measurements:
        design = _design(measurement, names)
        weight = scaled_inverse(measurement.covariance)
        information += design.T @ weight @ design
        pull += design.T @ weight @ (measurement.value - design @ start)
    return information, pull


def _chi_square(measurement: Measurement, names: Sequence[str], scaled: Array) -> float:
    residual = measurement.value - _design(measurement, names) @ scaled
    return float(residual @ scaled_solve(measurement.covariance, residual))


def _conflicts(
    measurements: Sequence[Measurement], names: Sequence[str], start: Array
) -> tuple[Conflict, ...]:
    """Return the experiments that all others together contradict, each left out in turn."""
    conflicts = []
    for left_out in measurements:
        others = [m for m in measurements if m is not left_out]
        if not others:
            continue
        information, pull = _normal_equations(others, names, start)
        covariance, unmeasured = _inverse(information, names)
        unit = np.array([COEFFICIENTS[name].prior_sd for name in names])
        predicted = start + covariance @ pull
        for row, value, variance in zip(
            _design(left_out, names), left_out.value, np.diag(left_out.covariance), strict=True
        ):
            reach = np.abs(unmeasured.T @ (row * unit)).max(initial=0.0)
            if reach > SMALL * np.linalg.norm(row * unit):
                continue  # the others say nothing of this number
            expected = float(row @ predicted)
            error = float(np.sqrt(variance + row @ covariance @ row))
            deviation = (float(value) - expected) / error
            if abs(deviation) > CONFLICT:
                members = tuple(n for n, factor in zip(names, row, strict=True) if factor)
                conflicts.append(
                    Conflict(left_out.experiment, members, float(value), expected, deviation)
                )
    return tuple(sorted(conflicts, key=lambda conflict: -abs(conflict.deviation)))
