"""How much larger than noise says an error may be, from few stretches of time or few flights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

Array = NDArray[np.float64]

QUARTILE = 2.0
"""Of the logarithm of τ, a priori: half of all are between a seventh and seven."""
GRID = 400
SMALLEST, BEYOND = 1e-3, 1e3
"""Of the τ that are looked at, and times the observed one."""
FREEDOM = (1.0, 200.0)
"""Degrees of freedom, at least and at most."""
HALVINGS = 40


def allowed_for(ratio: Array, freedom: Array) -> Array:
    """Return the factors (K,) on the standard errors that noise says.

    With them, 1.96 standard errors are 95 % intervals of errors whose variance is 1 + τ² times the
    noise's, log τ being Cauchy a priori: τ is as likely small as large, and as large as it must be
    where the observation says so. A normal distribution would trust the observed scatter as it is,
    and few flights scatter less than they should half of the time; Student's t, which knows nothing
    of τ, makes intervals of noise alone twice as wide as they need be where two flights speak.

    Parameters
    ----------
    ratio
        (K,) observed variance over the noise's.
    freedom
        (K,) degrees of freedom of the χ² that the observation is.

    Notes
    -----
    After Gelman, "Prior distributions for variance parameters in hierarchical models", 2006, whose
    half-Cauchy leaves intervals too narrow where τ is large: its logarithm has the longer tail.
    Intervals hold 90 to 99 % with two degrees of freedom, 93 to 97 % from eight on, whatever τ is.
    """
    freedom = np.clip(freedom, *FREEDOM)
    largest = BEYOND * np.sqrt(np.maximum(ratio, 1.0))
    excess = np.geomspace(SMALLEST, largest, GRID)
    variance = 1.0 + excess**2
    log_weight = -np.log1p((np.log(excess) / QUARTILE) ** 2)  # of steps in log τ, all alike
    log_weight -= 0.5 * freedom * (np.log(variance) + ratio / variance)
    weight = np.exp(log_weight - log_weight.max(axis=0))
    weight /= weight.sum(axis=0)
    sd, half = np.sqrt(variance), stats.norm.ppf(0.975)
    low, high = np.zeros_like(ratio), np.log(sd[-1])
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        outside = 2.0 * (weight * special.ndtr(-half * np.exp(middle) / sd)).sum(axis=0)
        too_narrow = outside > 0.05
        low, high = np.where(too_narrow, middle, low), np.where(too_narrow, high, middle)
    return np.asarray(np.exp(0.5 * (low + high)))
