"""How strong disturbances are and how long they last: what makes the recordings likeliest.

The likelihood is that of the innovations (Schweppe 1965). Strengths trade off: gusts and turbulence
explain the same innovations, and where they are too large or too small together, that biases the
coefficients. So they move together: by Gauss and Newton's steps with Fisher's information of
innovations and their covariance (Maine and Iliff, "Formulation and implementation of a practical
algorithm for parameter estimation with process and measurement noise", 1980; Harvey, "Forecasting,
structural time series models and the Kalman filter", 1989, 3.4.5), damped (Levenberg).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tuner.filter_error.disturbances import LEAST, MOST, within

Array = NDArray[np.float64]

STEP = 0.1
"""Of a logarithm, over which is differentiated."""
FURTHEST = float(np.log(4.0))
"""That a strength moves at a time: beyond, the likelihood is no parabola."""
ENOUGH = 1.0
"""Gain of the logarithmic likelihood that is not worth another step: a standard error or so."""
STEPS = 6
DAMPED = 4
"""Times that a step is damped more, where it does not lead down."""


class Likelihood(NamedTuple):
    """What a filter makes of recordings with some strengths.

    Attributes
    ----------
    loss
        Negative log-likelihood.
    white
        (n, m) innovations, whitened.
    whitens
        (n, m, m) what whitens them: the inverse of their covariance's triangular root. Both in
        single precision where memory counts: only Fisher's information is made of them.
    """

    loss: float
    white: NDArray[np.floating]
    whitens: NDArray[np.floating]


def likeliest(filtered: Callable[[Array], Likelihood], begin: Array) -> Array:
    """Return the strengths (6,), logarithms, of least negative log-likelihood.

    Parameters
    ----------
    filtered
        Of strengths.
    begin
        (6,) where to begin.
    """
    here = filtered(begin)
    for _ in range(STEPS):
        slope, information = _slope_and_information(filtered, begin, here)
        held = (begin <= LEAST) & (slope > 0.0) | (begin >= MOST) & (slope < 0.0)
        free = np.flatnonzero(~held)
        # the loss of a strength that vanishes goes with its square, of which Fisher knows nothing
        bend = information + np.diag(2.0 * np.maximum(slope, 0.0) + 1e-9)
        for damping in (0.0, *np.logspace(-1, 2, DAMPED)):
            change = np.zeros(len(begin))
            damped = bend + damping * np.diag(np.diag(bend))
            step = -np.linalg.solve(damped[np.ix_(free, free)], slope[free])
            change[free] = step * (FURTHEST / np.abs(step).max(initial=FURTHEST))
            if -0.5 * (slope @ change) < ENOUGH:
                return begin
            tried = within(begin + change)
            there = filtered(tried)
            if there.loss < here.loss:
                break
        else:
            return begin
        gained, here, begin = here.loss - there.loss, there, tried
        if gained < ENOUGH:
            break
    return begin


def _slope_and_information(
    filtered: Callable[[Array], Likelihood], begin: Array, here: Likelihood
) -> tuple[Array, Array]:
    """Return the slope (6,) of the loss, and Fisher's information (6, 6)."""
    slope, rows = np.zeros(len(begin)), []
    for number, axis in enumerate(np.eye(len(begin))):
        step = STEP if begin[number] + STEP <= MOST[number] else -STEP
        beside = filtered(begin + step * axis)
        slope[number] = (beside.loss - here.loss) / step
        turn = here.whitens @ np.linalg.inv(beside.whitens)
        moved = (np.einsum("nij,nj->ni", turn, beside.white) - here.white) / step
        spread = (turn @ np.swapaxes(turn, 1, 2) - np.eye(turn.shape[1])) / step
        rows.append(np.concatenate([moved.ravel(), np.sqrt(0.5) * spread.ravel()]))
        slope[number] -= 0.5 * step * (rows[-1] @ rows[-1])  # of a parabola at the step's beginning
    return slope, np.array([[row @ other for other in rows] for row in rows], float)
