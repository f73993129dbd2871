"""Whether the residuals are white noise; where they are not, the model lacks something."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Z95
from tuner.objective.criterion import Criterion, Jacobian
from tuner.objective.normal import Objective
from tuner.uncertainty.records import Residual

Array = NDArray[np.float64]

LAGS = 50
"""Number of lags of the autocorrelation, in samples."""
OUTSIDE = 0.1
"""Share of the lags outside the band of 95 % up to which residuals count as white: twice chance."""
MIN_SAMPLES = 4 * LAGS
"""Samples below which the autocorrelation is not computed."""


def whiteness(
    objective: Objective, jacobian: Jacobian, criterion: Criterion, flights: Sequence[str]
) -> tuple[Residual, ...]:
    """Return the autocorrelation of the residuals of every channel of every flight."""
    results = []
    seconds = float(criterion.horizon) / float(objective.schedule.log_rate)
    segment_flight = np.asarray(objective.segments.flight)
    for number, name in enumerate(flights):
        segments = np.flatnonzero(segment_flight == number)  # windows follow each other
        for channel, measured in objective.segments.measured.items():
            weight = np.concatenate(np.moveaxis(np.asarray(measured.weight)[..., segments], -1, 0))
            local = np.asarray(measured.time)[:, segments]
            time = (local + objective.segments.begins[segments]).T.ravel()
            used = (weight > 0).any(axis=1) & (local.T.ravel() < seconds)
            if used.sum() < MIN_SAMPLES:
                continue
            residuals = np.asarray(jacobian.residuals[channel])[..., segments]
            error = np.concatenate(np.moveaxis(residuals, -1, 0))[used]
            axes = (weight[used] > 0).all(axis=0)
            if axes.any():
                results.append(_residual(name, channel, time[used], error[:, axes]))
    return tuple(results)


def _residual(flight: str, channel: str, time: Array, error: Array) -> Residual:
    spacing = float(np.median(np.diff(time)))
    centred = error - error.mean(axis=0)
    power = np.maximum((centred**2).sum(axis=0), 1e-300)
    count = len(time)
    correlation = np.array(
        [1.0]
        + [
            float(np.mean((centred[lag:] * centred[:-lag]).sum(axis=0) / power))
            for lag in range(1, LAGS)
        ]
    )
    limit = Z95 / np.sqrt(count * error.shape[1])
    return Residual(
        flight=flight,
        channel=channel,
        rms=float(np.sqrt(np.mean(error**2))),
        spacing=spacing,
        autocorrelation=correlation.round(4).tolist(),
        limit=float(limit),
        memory=float(spacing * (1.0 + 2.0 * (correlation[1:] ** 2).sum())),
        white=bool(np.mean(np.abs(correlation[1:]) > limit) <= OUTSIDE),
    )
