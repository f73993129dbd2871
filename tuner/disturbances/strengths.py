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

from tuner.disturbances.disturbances import MOST

Array = NDArray[np.float64]

AT_ONCE = 2**16
"""Numbers of a row whose products are summed up at a time."""
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
    factors
        (n, m, m) the triangular root of their covariance before. In single precision where memory
        counts: no more than derivatives are made of it.
    """

    loss: float
    white: NDArray[np.floating]
    factors: NDArray[np.floating]


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
    some = np.flatnonzero(here.white.any(axis=1))  # the others are as they were
    wide = here.white.shape[1]
    whitens, one = np.linalg.inv(here.factors[some].astype(float)), np.eye(wide)
    moves = np.zeros((len(steps), *here.white.shape))
    below = np.tril_indices(wide)
    # of a symmetric matrix's squares those off the diagonal count twice, and all by a half
    counts = np.where(below[0] == below[1], np.sqrt(0.5), 1.0)
    slope, spreads = np.zeros(len(steps)), []
    for number, (there, step) in enumerate(zip(beside, steps.tolist(), strict=True)):
        turn = whitens @ there.factors[some]
        turned = np.matmul(turn, there.white[some, :, None])[..., 0]
        moved = moves[number, some] = (turned - here.white[some]) / step
        spread = counts * ((turn @ np.swapaxes(turn, 1, 2) - one) / step)[:, *below]
        spreads.append(spread.astype(np.float32).ravel())
        ahead = (there.loss - here.loss) / step
        bend = np.sum(moved**2) + np.sum(spread**2)
        slope[number] = ahead - 0.5 * step * bend  # of a parabola where it begins
    flat = moves.reshape(len(steps), -1)
    information = flat @ flat.T
    for first in range(0, len(spreads[0]), AT_ONCE):
        part = np.array([spread[first : first + AT_ONCE] for spread in spreads], float)
        information += part @ part.T
    return Slopes(slope, information, moves)
