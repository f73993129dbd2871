"""Gyro, accelerometer and commands on one clock, in the band in which rotors turn a vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from tuner.core.numerics import Array
from tuner.objective.inlets import linear_interpolation
from tuner.recordings.flight import Series

CUTOFF = 30.0
"""Hz of the low-pass that measured and modelled signals pass alike: above it are propellers' and
frames' vibrations, below it what motors of tens of ms can follow."""
FASTEST = 500.0
"""Hz of the common clock, at most."""
END_MARGIN = 0.5
"""s at both ends of a stretch that are left out: take-off, landing and the filters' ends."""
BLOCK = 1.0
"""s, longer than residuals are alike: the standard errors count such blocks, not samples."""


@dataclass(frozen=True)
class Stretch:
    """A stretch of flight, uniformly sampled.

    Attributes
    ----------
    time
        (n,) s.
    body_rate
        (n, 3) rad/s.
    force
        (n, 3) m/s², the specific force that the accelerometer shows.
    command
        (n, 4) 0..1.
    """

    time: Array
    body_rate: Array
    force: Array
    command: Array

    @property
    def step(self) -> float:
        """The s between two samples."""
        return float(self.time[1] - self.time[0])

    @property
    def inside(self) -> NDArray[np.bool_]:
        """Which samples are far enough from the ends to be compared."""
        ends = self.time[0] + END_MARGIN, self.time[-1] - END_MARGIN
        return np.asarray((self.time > ends[0]) & (self.time < ends[1]), dtype=np.bool_)

    @property
    def coarser(self) -> Stretch:
        """The same at half the rate."""
        even = len(self.time) // 2 * 2
        command = self.command[:even].reshape(-1, 2, self.command.shape[1]).mean(axis=1)
        every = slice(0, even, 2)
        return Stretch(self.time[every], self.body_rate[every], self.force[every], command)


def stretches_of(
    series: Mapping[str, Series], flying: tuple[tuple[float, float], ...]
) -> tuple[Stretch, ...]:
    """Return the stretches in the air on the clock of the slowest of the three signals."""
    names = ("body_rate", "acceleration", "command")
    rate = min(FASTEST, *(series[name].rate for name in names))
    stretches = []
    for begin, end in flying:
        count = int((end - begin) * rate)
        if count >= 4 * END_MARGIN * rate - 1:
            time = begin + np.arange(count) / rate
            stretches.append(
                Stretch(time, *(linear_interpolation(series[name], time) for name in names))
            )
    return tuple(stretches)


def smoothed(values: Array, step: float) -> Array:
    """Return (n, k) values without what is above the band, not delayed."""
    return low_passed(values, step, CUTOFF)


def low_passed(values: Array, step: float, cutoff: float) -> Array:
    """Return (n, k) values without what is above a frequency in Hz, not delayed."""
    sections = signal.butter(2, cutoff, fs=1.0 / step, output="sos")
    return np.asarray(signal.sosfiltfilt(sections, values, axis=0))


def blocks_of(stretches: tuple[Stretch, ...], order: int) -> NDArray[np.int64]:
    """Return the number of its block for every compared step, but the first few of a stretch."""
    numbers, first = [], 0
    for stretch in stretches:
        inside = stretch.time[:-1][stretch.inside[:-1]][order:]
        block = first + ((inside - inside[0]) / BLOCK).astype(np.int64)
        numbers.append(block)
        first = int(block[-1]) + 1
    return np.concatenate(numbers)
