"""What a standard error is made of: noise, residuals, flights, terms, steps, readings, lack."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95, Inverse
from tuner.objective.alternatives import DRAWS, LACK, READINGS, STEP
from tuner.objective.information import FisherInformation
from tuner.uncertainty.overdispersion import IndependentErrors, flights_apart

Array = NDArray[np.float64]

SIMULATORS_STEP = 1.0 / 4000.0
"""s of a simulator's finest usual step. A lag that it steps by Euler's rule, as most do, is half a
step shorter than its time constant says: ln(1 - h/τ) = -h/(τ - h/2) to second order. Not by more:
the standard error of what is only known to lie within limits is their half-width over √3."""
WIDER = float(stdtrit(DRAWS, 0.975) / Z95)
"""Times the root mean square of so many draws: Student's t, whose errors are as large by chance."""
SAME_ERRORS = ("noise", "residuals", "left_out")
"""Parts that show the same errors, each in its way."""
FEWEST = 3
"""Flights, or parts of them, that can disagree: of two, one degree of freedom is left."""
TELLS = 1e-3
"""Share of a variance by which it must grow without a flight that tells of the coefficient."""


def quoted(parts: Mapping[str, Array]) -> Array:
    """Return the honest standard error (K,) from its parts, as of `parts_of`.

    Noise, residuals and left-out flights show the same errors in three ways, of which the largest
    counts. On top comes what terms would move that were left out: a fit without them does not
    depend on what the flights say of them, and their effect stands in no residual as long as
    coefficients take it up. And what steps do, those of the simulation and those that the search
    did not take, what inputs do that were read with errors, and what the model is seen to lack.
    """
    same = [parts[name] for name in SAME_ERRORS if name in parts]
    others = [np.square(part) for name, part in parts.items() if name not in SAME_ERRORS]
    return np.asarray(np.sqrt(np.max(same, axis=0) ** 2 + sum(others)))


def parts_of(information: FisherInformation, residuals: Array, lags: Array) -> dict[str, Array]:
    """Return the known `ErrorParts`, each (K,) in the scaled coordinates.

    Parameters
    ----------
    information
        Of the fit.
    residuals
        (K,) standard errors with all that is in the residuals.
    lags
        (K,) how far a parameter moves for each s by which a lag is longer; zero for what is none.
    """
    inverse = Inverse.of(information.total, information.given)
    moved = {
        name: np.abs(inverse.matrix @ change.sum(axis=0))
        for name, change in information.changes.items()
    }
    if STEP in moved:
        moved[STEP] = np.hypot(moved[STEP], lags * SIMULATORS_STEP / 2.0 / np.sqrt(3.0))
    drawn = [moves for name, moves in moved.items() if name.startswith(READINGS)]
    parts = {
        "noise": noise_alone(information),
        "residuals": residuals,
        "left_out": left_out(information),
        "terms": information.in_doubt,
        "step": moved.get(STEP),
        "readings": WIDER * np.sqrt(np.mean(np.square(drawn), axis=0)) if drawn else None,
        "lack": moved.get(LACK),
        "search": np.abs(inverse.matrix @ information.slope),
    }
    return {name: part for name, part in parts.items() if part is not None}


def noise_alone(information: FisherInformation) -> Array:
    """Return the standard errors (K,) were the residuals measurement noise alone."""
    flights = np.einsum("cf,cfbpq->pq", information.scale**2, information.blocks)
    noisy = Inverse.of(flights + information.given, information.given).matrix
    return np.asarray(np.sqrt(np.diag(noisy)))


def left_out(information: FisherInformation) -> Array | None:
    """Return the standard errors (K,) that leaving flights out in turn speaks for.

    Without a flight the estimate moves by δ = (H - H_i)⁻¹ g_i, one Gauss-Newton step; if H were
    right, the covariance of δ would be (H - H_i)⁻¹ - H⁻¹. The mean of the ratio of their squares
    scales the errors that H speaks for; a flight counts by how much it tells of the coefficient,
    and not at all where the others and the priors leave it open: nothing contradicts it there.
    H - H_i is summed up from the others, for the difference would be rounding errors of any sign.
    (The plain jackknife takes all flights for alike, and one that alone tells of a coefficient for
    one that contradicts the others.) Errors that last for a whole flight show here alone; few
    flights leave open how large they are (`allowed_for`).
    """
    parts = flights_apart(information)
    if parts.count < FEWEST:
        return None
    total, independent = information.total, IndependentErrors.of(information)
    inverse = independent.inverse
    known = np.diag(inverse.matrix)
    weights, squares = np.zeros_like(parts.score), np.zeros_like(parts.score)
    for number in range(parts.count):
        others = np.delete(parts.information, number, axis=0).sum(axis=0)
        rest = Inverse.of(others + information.given, information.given)
        without = rest.matrix
        expected = np.maximum(np.diag(without) - known, 0.0)
        tells = (expected > TELLS * known) & rest.known
        moved = (without @ parts.score[number]) ** 2
        weights[number] = np.where(tells, expected / (expected + known), 0.0)
        squares[number] = np.where(tells, moved / np.where(tells, expected, 1.0), 0.0)
    of_all = np.maximum(weights.sum(axis=0), 1e-300)
    beyond = np.where(weights.any(axis=0), (weights * squares).sum(axis=0) / of_all, 1.0)
    alike = of_all**2 / np.maximum((weights**2).sum(axis=0), 1e-300)
    given = np.diag(inverse.sandwiched(np.zeros_like(total), information.given))
    # one degree of freedom is the estimate's own
    return independent.widened(beyond * np.maximum(known - given, 0.0), alike - 1.0)
