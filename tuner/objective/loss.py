"""The loss of residuals: half their squares, growing linearly beyond a limit (Huber)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import huber_weights

Array = NDArray[np.float64]

ROWS_AT_ONCE = 1024
"""Residuals whose products are summed up by one call of BLAS: few enough for one thread, so that
sums do not depend on how many there are."""


def robust(error: Array, limit: float) -> Array:
    """Return Huber's loss of an error: its square, growing linearly beyond a limit."""
    size = np.abs(error)
    beyond = size > limit
    if not beyond.any():
        return error * error
    return np.where(beyond, 2.0 * limit * size - limit * limit, error * error)


def gauss_newton(columns: Array, scaled: Array, scale: Array, huber: float) -> tuple[Array, Array]:
    """Return gradient (F, Q) and Gauss-Newton Hessian (F, Q, Q) of one channel's robust loss.

    Parameters
    ----------
    columns
        (F, n, k, Q) derivatives of the unscaled residuals.
    scaled, scale
        (F, n, k) residuals, and the (F,) by which they were divided.
    huber
        As for `robust`.
    """
    segments, size = columns.shape[0], columns.shape[-1]
    root = np.sqrt(huber_weights(scaled, huber))
    rows = columns.reshape(segments, -1, size) * (
        root.reshape(segments, -1, 1) / scale[:, None, None]
    )
    error = (scaled * root).reshape(segments, -1)
    gradient, hessian = np.zeros((segments, size)), np.zeros((segments, size, size))
    for first in range(0, rows.shape[1], ROWS_AT_ONCE):
        some = rows[:, first : first + ROWS_AT_ONCE]
        gradient += np.einsum("fr,frq->fq", error[:, first : first + ROWS_AT_ONCE], some)
        hessian += np.swapaxes(some, 1, 2) @ some
    return gradient, hessian
