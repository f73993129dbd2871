"""Measurement noise of each recorded signal, estimated from the recording itself."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuner.config import CHANNELS
from tuner.core.numerics import Array, robust_sd
from tuner.recordings.flight import Flight, Series

#: Smallest believable standard deviation, in the channel's unit (attitude: rad).
MIN_NOISE = {
    "position": 1e-4,
    "attitude": 1e-4,
    "body_rate": 1e-3,
    "rotor_speed": 0.3,
    "command": 2e-4,
    "acceleration": 0.02,
}


def white_noise(series: Series) -> Array:
    """Return each column's standard deviation of the noise between neighbouring samples.

    Every sample is compared with the parabola through its neighbours at their own times, so that
    jitter of stamps does not matter; the median is robust to jumps.

    Parameters
    ----------
    series
        (n, k) samples.

    Returns
    -------
    array
        (k,), NaN where a column was not measured.
    """
    spread = np.full(series.values.shape[1], np.nan)
    for column in range(series.values.shape[1]):
        measured = np.isfinite(series.values[:, column])
        time, values = series.time[measured], series.values[measured, column]
        if len(values) > 8:
            error = _third_difference(time, values)
            spread[column] = robust_sd(error)
    return spread


def _third_difference(time: Array, values: Array) -> Array:
    """Return divided third differences, scaled so that white noise keeps its variance."""
    stamps = np.stack([time[i : len(time) - 3 + i] for i in range(4)])
    samples = np.stack([values[i : len(values) - 3 + i] for i in range(4)])
    gaps = stamps[:, None] - stamps[None]
    gaps[np.arange(4), np.arange(4)] = 1.0
    weights = 1.0 / gaps.prod(axis=1)
    scaled = (weights * samples).sum(axis=0) / np.sqrt((weights**2).sum(axis=0))
    return np.asarray(scaled)


def noise_of(flights: Sequence[Flight], channels: Sequence[str] = CHANNELS) -> dict[str, float]:
    """Return the measurement noise of every channel that some flight recorded."""
    recorded = [c for c in channels if any(flight.has(c) for flight in flights)]
    return {channel: channel_noise(flights, channel) for channel in recorded}


def channel_noise(flights: Sequence[Flight], channel: str) -> float:
    """Return one standard deviation for a channel over all flights, in its unit (attitude: rad).

    Commands come in steps and are smooth between them, so that only rounding counts: their noise
    is the step's share.
    """
    per_flight = []
    for flight in flights:
        series = flight.series.get(channel)
        if series is None or not np.isfinite(series.values).any():
            continue
        if channel == "command":
            gaps = np.diff(np.unique(series.values[np.isfinite(series.values)]))
            steps = gaps[gaps > 1e-9]  # between different values of a quantised signal
            per_flight.append(float(np.min(steps)) / np.sqrt(12.0) if len(steps) else 0.0)
        elif channel == "attitude":
            per_flight.append(2.0 * float(np.nanmedian(white_noise(series)[1:])))
        else:
            per_flight.append(float(np.nanmedian(white_noise(series))))
    known = [value for value in per_flight if np.isfinite(value)]
    return max(float(np.median(known)) if known else 0.0, MIN_NOISE[channel])


def repeat_counts(values: Array) -> Array:
    """Return the length of the run of equal samples that each of (n, k) belongs to.

    A run of equal rounded values has one rounding error: it is one reading. Counted as many, those
    of a steady yaw spin had biased the moment constant.
    """
    counts = np.ones(values.shape)
    for column, samples in enumerate(values.T):
        begins = np.flatnonzero(np.append(True, samples[1:] != samples[:-1]))
        lengths = np.diff(np.append(begins, len(samples)))
        counts[:, column] = np.repeat(lengths, lengths)
    return counts
