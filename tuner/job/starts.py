"""Where a search begins: at the vehicle file's coefficients, and at random ones around them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tuner.coefficients.space import Parameter
from tuner.job.prepare import Job

INSIDE = 0.02
"""Share of its range by which a start keeps away from a bound."""


def starting_vectors(job: Job) -> NDArray[np.float64]:
    """Return S start vectors (S, K): the vehicle file's, then random ones around it.

    A logarithmic coefficient is drawn between the vehicle file's value divided by the job's
    ``spread`` and that value times it, evenly in the logarithm; a linear one evenly within its
    usual uncertainty on either side.
    """
    settings, space = job.settings.job.search, job.space
    generator = np.random.default_rng(settings.seed)
    first = space.initial
    centre, width = space.share(first), space.width
    reach = np.array([_reach(p, settings.spread) for p in space.parameters]) / width
    drawn = generator.uniform(-1.0, 1.0, (settings.starts - 1, len(space)))
    shares = np.clip(centre + drawn * reach, INSIDE, 1.0 - INSIDE)
    return np.stack([first, *(space.at_share(share) for share in shares)])


def _reach(parameter: Parameter, spread: float) -> float:
    return float(np.log(spread)) if parameter.scale == "log" else parameter.prior_sd
