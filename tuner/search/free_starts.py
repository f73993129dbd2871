"""Where segments with free starts begin: about which starts their losses are linear models."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from tuner.objective.criterion import SegmentSums

FAR = 5.0
"""Standard deviations beyond which no start is believed to lie."""
MOVED = 0.3
"""Standard deviations by which a start may differ from the one about which it was linearised."""


def starts_asked_for(
    sums: SegmentSums | None, best: int, before: NDArray[np.float64] | None
) -> NDArray[np.float64] | None:
    """Return the segments' starts (L, F) that one of S points asks for.

    Parameters
    ----------
    sums
        At the points; None where they were not computed.
    best
        Number of the point.
    before
        (L, F) starts about which was linearised; None where they are known.
    """
    if before is None or sums is None or sums.states is None:
        return before
    asked = np.asarray(sums.states[best])
    return np.clip(np.where(np.isfinite(asked), asked, before), -FAR, FAR)


def are_far(starts: NDArray[np.float64] | None, reference: NDArray[np.float64] | None) -> bool:
    """Return whether a linear model about some starts (L, F) is not to be trusted at others."""
    if starts is None or reference is None:
        return False
    return bool(np.abs(starts - reference).max(initial=0.0) > MOVED)
