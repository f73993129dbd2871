"""A coefficient from ground measurements, from flights, and from both, for ``result.json``."""

from __future__ import annotations

from tuner.core.files import FiniteOrNone, Part

CONFLICT = 3.0
"""Standard errors apart beyond which ground measurements and flights contradict each other."""


class Sources(Part):
    """A coefficient from ground measurements, from flights alone, and from both, in its unit.

    ``flights`` is None where they do not identify it. ``deviation`` is that of flights from the
    ground in standard errors, model error included.
    """

    ground: float
    ground_error: FiniteOrNone
    flights: FiniteOrNone
    flights_error: FiniteOrNone
    both: float
    both_error: FiniteOrNone
    deviation: FiniteOrNone
