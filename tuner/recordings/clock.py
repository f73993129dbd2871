"""The mission's uniform clock, laid onto the ticks of what was published regularly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tuner.recordings.flight import Array

#: A stamp this part of a period off its tick still belongs to that tick.
ON_TICK = 0.2
#: No clock drifts faster, in s/s: such stamps have another rate.
FASTEST_DRIFT = 0.01


@dataclass(frozen=True)
class Grid:
    """Ticks at `origin` + k / `rate`.

    Attributes
    ----------
    origin
        s, the time of one tick.
    rate
        Hz; the wanted clock's, or a multiple of it that the publisher keeps.
    drift
        Seconds per second by which the publisher's clock runs slower than its stamps.
    spread
        s, the 95th percentile of how late stamps are on their ticks.
    """

    origin: float
    rate: float
    drift: float = 0.0
    spread: float = 0.0

    def tick_nearest(self, time: float) -> float:
        """Return the time of the tick nearest to a time."""
        return self.origin + round((time - self.origin) * self.rate) / self.rate

    def snap(self, time: Array) -> Array:
        """Return (n,) stamps moved to their ticks, or unchanged where they follow no ticks.

        A loop that publishes on every tick stamps a fraction of a millisecond late. Held on the
        uniform clock as it stands, such a sample would be read one whole tick late.
        """
        phase = (time - self.origin) * self.rate
        on_drifting = phase * (1 - self.drift)
        tick = np.rint(on_drifting)
        if np.quantile(np.abs(on_drifting - tick), 0.99) > ON_TICK:
            return time
        snapped = self.origin + tick / self.rate
        return snapped if np.all(np.diff(snapped) > 0) else time


def fit_grid(time: Array, rate: float) -> Grid | None:
    """Fit ticks of a known rate, or a multiple, to (n,) increasing stamps that come a little late.

    A publisher's timer fires on the tick and the stamp is written a little later, never earlier,
    so that the ticks are the lower envelope of the stamps: the first percentile of how late they
    are, once a steady drift of the clock is taken away. None if the stamps follow no such ticks.
    """
    if len(time) < 20:
        return None
    period = np.median(np.diff(time))
    if period * rate < 1 - ON_TICK:  # published more often than the wanted clock ticks
        rate *= max(1, round(1 / (period * rate)))
    stride = round(period * rate)
    if stride < 1 or abs(period * rate - stride) > ON_TICK:
        return None
    tick = np.cumsum(np.concatenate([[0], np.rint(np.diff(time) * rate)]))
    late = time - time[0] - tick / rate
    blocks = np.array_split(np.arange(len(time)), min(20, len(time) // 10))
    middle = np.array([np.median(tick[block]) for block in blocks]) / rate
    low = np.array([np.quantile(late[block], 0.1) for block in blocks])
    drift = float(np.polyfit(middle, low, 1)[0]) if len(blocks) > 2 else 0.0
    if abs(drift) > FASTEST_DRIFT:
        return None
    if abs(drift) * (time[-1] - time[0]) < 1e-3:
        drift = 0.0
    steady = late - drift * tick / rate
    origin = float(np.quantile(steady, 0.01))
    spread = float(np.quantile(steady - origin, 0.95))
    if spread > ON_TICK / rate:
        return None
    return Grid(float(time[0]) + origin, rate, drift, spread)
