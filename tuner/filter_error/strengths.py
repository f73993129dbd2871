"""What the likelihood of the innovations does with the strengths of the disturbances.

How strong disturbances are and how long they last is what makes the recordings likeliest (Schweppe
1965). Strengths trade off: gusts and turbulence explain the same innovations, and where they are
too large or too small together, that biases the coefficients. So they all move together, and with
the coefficients: by Gauss and Newton's steps with Fisher's information of innovations and their
covariance (Maine and Iliff, "Formulation and implementation of a practical algorithm for parameter
estimation with process and measurement noise", 1980; Harvey, "Forecasting, structural time series
models and the Kalman filter", 1989, 3.4.5).
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tuner.filter_error.disturbances import MOST

Array = NDArray[np.float64]

STEP = 0.02
"""Of a logarithm, over which is differentiated."""


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
        single precision where memory counts: no more than derivatives are made of them.
    """

    loss: float
    white: NDArray[np.floating]
    whitens: NDArray[np.floating]


class Slopes(NamedTuple):
    """How the negative log-likelihood changes with the strengths, logarithms.

    Attributes
    ----------
    slope
        (7,) its derivatives.
    information
        (7, 7) Fisher's.
    moved
        (7, n, m) derivatives of the innovations, whitened by the covariance that they had.
    """

    slope: Array
    information: Array
    moved: Array


def steps_from(strengths: Array) -> Array:
    """Return the steps (7,) over which is differentiated by each of the strengths, logarithms."""
    return np.where(strengths + STEP <= MOST, STEP, -STEP)


def slopes_of(here: Likelihood, beside: Iterable[Likelihood], steps: Array) -> Slopes:
    """Return how the likelihood changes with the strengths, by differences.

    Parameters
    ----------
    here
        At the strengths.
    beside
        Where one of them is a step away, each in turn.
    steps
        (7,) see `steps_from`.
    """
    slope, moves, rows = np.zeros(len(steps)), [], []
    for number, (there, step) in enumerate(zip(beside, steps.tolist(), strict=True)):
        turn = here.whitens @ np.linalg.inv(there.whitens)
        moved = (np.einsum("nij,nj->ni", turn, there.white) - here.white) / step
        spread = (turn @ np.swapaxes(turn, 1, 2) - np.eye(turn.shape[1])) / step
        moves.append(moved)
        rows.append(np.concatenate([moved.ravel(), np.sqrt(0.5) * spread.ravel()]))
        ahead = (there.loss - here.loss) / step
        slope[number] = ahead - 0.5 * step * (rows[-1] @ rows[-1])  # of a parabola where it begins
    information = np.array([[row @ other for other in rows] for row in rows], float)
    return Slopes(slope, information, np.array(moves, float))
