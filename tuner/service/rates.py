"""How often one visitor may ask: a bucket of tokens that refills steadily."""

from __future__ import annotations

import time
from collections import OrderedDict

MOST_VISITORS = 10_000


class RateLimit:
    """A bucket for each visitor.

    Parameters
    ----------
    per_second
        At which a bucket refills.
    burst
        That it holds.
    """

    def __init__(self, per_second: float, burst: float) -> None:
        self._per_second = per_second
        self._burst = burst
        self._buckets: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def allows(self, visitor: str, now: float | None = None) -> bool:
        """Take one request out of a visitor's bucket, if there is one in it."""
        now = time.monotonic() if now is None else now
        left, seen = self._buckets.pop(visitor, (self._burst, now))
        left = min(self._burst, left + (now - seen) * self._per_second)
        allowed = left >= 1.0
        self._buckets[visitor] = (left - float(allowed), now)
        while len(self._buckets) > MOST_VISITORS:
            self._buckets.popitem(last=False)
        return allowed
