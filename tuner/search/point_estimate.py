"""A coefficient where a search ended, before anything is said of how far it can be trusted."""

from __future__ import annotations

from tuner.core.files import Part


class PointEstimate(Part):
    """A coefficient where a search ended.

    Attributes
    ----------
    name
        Of the coefficient.
    unit
        Of both numbers.
    initial
        Value in the vehicle or controller file.
    estimate
        Value where the search ended.
    """

    name: str
    unit: str
    initial: float
    estimate: float
