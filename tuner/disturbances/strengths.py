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

STEP = 0.02
"""Of a logarithm, over which is differentiated."""


class Likelihood(NamedTuple):
    """What a filter makes of recordings with some strengths.

    Attributes
    ----------
    loss
        Negative log-likelihood.
    white, root
        (T, m, F) innovations, each given those before it in its tick, over their standard
        deviations, and those.
    """

    loss: float
    white: Array
    root: Array


class Slopes(NamedTuple):
    """How the negative log-likelihood changes with the strengths, logarithms.

    Attributes
    ----------
    slope
        (7,) its derivatives.
    information
        (7, 7) Fisher's.
    moved
        (7, T, m, F) derivatives of the innovations over the standard deviations that they had.
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
    moves, spreads = np.zeros((2, len(steps), *here.white.shape))
    slope = np.zeros(len(steps))
    for number, (there, step) in enumerate(zip(beside, steps.tolist(), strict=True)):
        turn = there.root / here.root
        moves[number] = (turn * there.white - here.white) / step
        spreads[number] = np.sqrt(0.5) * (turn**2 - 1.0) / step
        bend = np.sum(moves[number] ** 2) + np.sum(spreads[number] ** 2)
        slope[number] = (there.loss - here.loss) / step - 0.5 * step * bend  # where it begins
    flat = (part.reshape(len(steps), -1) for part in (moves, spreads))
    return Slopes(slope, sum(part @ part.T for part in flat), moves)
