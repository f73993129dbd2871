"""How much larger than noise says errors may be, from few stretches of time or few flights."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Z95

Array = NDArray[np.float64]

QUARTILE = 2.0
"""Of the logarithm of τ, a priori: half of all are between a seventh and seven."""
APART = float(np.log(2.0))
"""Quartile of how far the logarithms of the τ of one fit's coefficients are from their centre: half
of them within a factor of two."""
GRID = 200
SMALLEST, BEYOND = 1e-3, 1e3
"""Of the τ that are looked at, and times the observed one."""
FREEDOM = (1.0, 200.0)
"""Degrees of freedom, at least and at most."""
HALVINGS = 40


def allowed_for(ratio: Array, freedom: Array, correlation: Array, expected: Array) -> Array:
    """Return the factors (K,) on the standard errors that noise says.

    With them, 1.96 standard errors are 95 % intervals of errors whose variance is 1 + τ² times the
    noise's. A priori log τ is Cauchy about a centre that the coefficients of a fit share, for what
    disturbs flights disturbs all of them, though not alike (``expected``): a gust is slow, and a
    latency is told by what is quick. And so is that centre about 1: τ is as likely small as
    large, and as large as it must be where observations say so. A normal distribution would trust
    the observed scatter as it is, and few flights scatter less than they should half of the time;
    Student's t, which knows nothing of τ, makes intervals of noise alone twice as wide as they need
    be where two flights speak.

    Parameters
    ----------
    ratio
        (K,) observed variance over the noise's.
    freedom
        (K,) degrees of freedom of the χ² that the observation is.
    correlation
        (K, K) of the estimates: observations that go together are counted once.
    expected
        (K,) variances over the noise's by how disturbed what determines each coefficient is: by
        how much they differ, the τ are expected to; their common size does not matter.

    Notes
    -----
    After Gelman, "Prior distributions for variance parameters in hierarchical models", 2006, whose
    half-Cauchy leaves intervals too narrow where τ is large: its logarithm has the longer tail.
    Each coefficient's evidence of the centre is tempered to the share of all that is its own; the
    squares of two errors are correlated as the square of the errors' correlation.
    """
    freedom = np.clip(freedom, *FREEDOM)
    largest = BEYOND * np.sqrt(max(float(ratio.max()), 1.0))
    log_excess = np.linspace(np.log(SMALLEST), np.log(largest), GRID)
    variance = 1.0 + np.exp(2.0 * log_excess)
    likelihood = -0.5 * freedom[:, None] * (np.log(variance) + ratio[:, None] / variance)
    likelihood = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    own = 1.0 / np.square(correlation).sum(axis=1)
    usual = 0.5 * np.log(expected)
    usual = usual - own @ usual / own.sum()
    beside = log_excess[:, None] - log_excess - usual[:, None, None]
    about = 1.0 / (1.0 + (beside / APART) ** 2)
    about /= about.sum(axis=1, keepdims=True)  # (K, excess, centre): of an excess, given a centre
    of_centre = np.log(np.einsum("kx,kxc->kc", likelihood, about))
    centre = -np.log1p((log_excess / QUARTILE) ** 2) + own @ of_centre
    centre = np.exp(centre - centre.max())
    weight = likelihood * (about @ centre)
    weight /= weight.sum(axis=1, keepdims=True)
    sd, half = np.sqrt(variance), Z95
    low, high = np.zeros_like(ratio), np.full_like(ratio, np.log(sd[-1]))
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        tails = special.ndtr(-half * np.exp(middle)[:, None] / sd)
        too_narrow = 2.0 * (weight * tails).sum(axis=1) > 0.05
        low, high = np.where(too_narrow, middle, low), np.where(too_narrow, high, middle)
    return np.asarray(np.exp(0.5 * (low + high)))
