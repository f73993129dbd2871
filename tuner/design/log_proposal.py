"""A signal that could be logged, and what that would be worth."""

from __future__ import annotations

from typing import Literal

from tuner.core.files import Part


class LogProposal(Part):
    """A signal that could be logged, and by how much it would narrow the intervals.

    Attributes
    ----------
    signal
        Its name.
    change
        Whether it would be ``added``, logged ``faster``, or so fast that it can be ``fed`` into the
        simulation in place of the attitude.
    rate
        Hz at which it would be logged.
    noise
        Standard deviation that it is taken to have, in its unit; None where it is logged already.
    shrinks
        Coefficient -> width of its interval with it over that without; of one that is not fitted
        so far, that without is its prior's.
    """

    signal: str
    change: Literal["added", "faster", "fed"]
    rate: float
    noise: float | None = None
    shrinks: dict[str, float]
