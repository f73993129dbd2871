"""How far from rest a hover is at its end: no hover stands still.

Motor commands come in steps, gusts push: a hover swings about its trim by millimetres and
milliradians, and the mission begins somewhere on the way. A Kalman filter over the seconds of hover
before the mission says where. About each horizontal axis (Anderson and Moore, "Optimal filtering",
1979, ch. 3)

    position' = velocity, velocity' = ±g (tilt - trim) + gust, tilt' = rate, rate' = unrest,

with gust and unrest white, the trim (that of the vehicle and of the markers) unknown and steady;
position, tilt and rate are measured. How strong gust and unrest are is what makes the measurements
likeliest (Schweppe 1965). A hover that the filter cannot tell from one at rest is at
rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

import numpy as np
from scipy.special import chdtrc  # scipy.stats takes a quarter of a second to import

from sim_jax.constants import GRAVITY
from tuner.core.numerics import Array
from tuner.objective.initial_conditions import ROWS, rests
from tuner.objective.noise import FLOOR, white_noise
from tuner.recordings.flight import Flight, Series

BEFORE = 1.0
"""s of hover before a mission from which it is looked at."""
GUST = 0.05
"""m/s² of acceleration by what is no tilt, white at `PER_SECOND`."""
UNREST = 0.5
"""rad/s² of angular acceleration, likewise."""
STRENGTHS = (0.03, 0.1, 0.3, 1.0, 3.0)
"""Factors on both, among which the likeliest is taken."""
PER_SECOND = 100.0
"""Hz at which the two above are independent."""
TRIM = 0.1
"""rad, prior standard deviation of the tilt that holds still."""
CHANCE = 1e-6
"""Probability with which a hover at rest is taken to move."""
POSITION, VELOCITY, TILT, RATE, STEADY = range(5)
NOISE = {POSITION: FLOOR["position"], TILT: FLOOR["attitude"], RATE: FLOOR["body_rate"]}
"""Smallest standard deviation of what is measured."""


def wander_of(flights: Sequence[Flight]) -> Array | None:
    """Return how far the hovers were from rest when their missions began.

    Parameters
    ----------
    flights
        N flights.

    Returns
    -------
    array or None
        (L, N) in the units of `tuner.objective.initial_conditions.STATES`: velocity in the world,
        tilt and body rate about the body's axes; zero for a flight at rest, or one of whose hover
        too little was recorded. None where all are.
    """
    wander = np.zeros((max(rows.stop for rows in ROWS.values()), len(flights)))
    for number, flight in enumerate(flights):
        hover = _hover(flight)
        if hover is not None:
            wander[:, number] = _at_end(hover, flight)
    return wander if wander.any() else None


def _hover(flight: Flight) -> dict[int, Series] | None:
    """Return the hover before a mission, if it was one and was recorded: state -> (n, 2) samples.

    Position in m along the heading at its start and to its left; tilt in rad and rate in rad/s
    about body y and x, the latter without rows if no gyro was recorded.
    """
    pose = [flight.series.get(name) for name in ("position", "attitude")]
    if not rests(flight.initial) or any(series is None for series in pose):
        return None
    position, attitude = (_before(series) for series in pose if series is not None)
    if min(len(position.time), len(attitude.time)) < BEFORE * PER_SECOND / 4.0:
        return None
    if max(position.time[0], attitude.time[0]) > -BEFORE:
        return None
    qw, qx, qy, qz = attitude.values.T
    tilt = np.column_stack([2.0 * (qw * qy - qx * qz), 2.0 * (qw * qx + qy * qz)])
    gyro = flight.series.get("body_rate", Series(np.zeros(0), np.zeros((0, 3))))
    rate = _before(gyro)
    return {
        POSITION: Series(position.time, (_axes(flight) @ position.values[:, :2].T).T),
        TILT: Series(attitude.time, tilt),
        RATE: Series(rate.time, rate.values[:, 1::-1]),
    }


def _axes(flight: Flight) -> Array:
    """Return the horizontal axes (2, 2) along the heading at the start, and to its left."""
    w, z = flight.initial.attitude[0], flight.initial.attitude[3]
    heading = 2.0 * np.arctan2(z, w)
    cos, sin = np.cos(heading), np.sin(heading)
    return np.array([[cos, sin], [-sin, cos]])


def _before(series: Series) -> Series:
    inside = (series.time <= 0.0) & np.isfinite(series.values).all(axis=1)
    return Series(series.time[inside], series.values[inside])


def _at_end(hover: Mapping[int, Series], flight: Flight) -> Array:
    """Return the wander (L,) of one flight; zeros where it is at rest."""
    moves = np.zeros(max(rows.stop for rows in ROWS.values()))
    ends, covariances = _filtered(hover)
    square = np.einsum("ap,apq,aq->", ends, np.linalg.inv(covariances), ends)
    if chdtrc(ends.size, square) > CHANCE:
        return moves
    (vx, pitch, q), (vy, roll, p) = ends
    moves[ROWS["velocity"]] = [*(np.array([vx, vy]) @ _axes(flight)), 0.0]
    moves[ROWS["attitude"]] = [roll, pitch, 0.0]
    moves[ROWS["body_rate"]] = [p, q, 0.0]
    return moves


def _filtered(hover: Mapping[int, Series]) -> tuple[Array, Array]:
    """Return velocity, tilt beyond the trim and rate at time 0 (2, 3), with covariances (2, 3, 3).

    One row along the heading, one to its left. All strengths of unrest are filtered side by side,
    and the likeliest of each row is taken.
    """
    samples = {state: (s.time.tobytes(), s.values.tobytes()) for state, s in hover.items()}
    return _filtered_of(tuple(samples.items()))


@lru_cache(maxsize=256)
def _filtered_of(content: tuple[tuple[int, tuple[bytes, bytes]], ...]) -> tuple[Array, Array]:
    """Return the same of a hover's samples; a fit, its check and its exports ask for the same."""
    hover = {
        state: Series(np.frombuffer(time), np.frombuffer(values).reshape(-1, 2))
        for state, (time, values) in content
    }
    mean = np.zeros((2, len(STRENGTHS), 5))
    mean[..., POSITION] = hover[POSITION].values[0, :, None]
    covariance = np.diag([0.01, 0.1, TRIM, 0.1, TRIM]) ** 2 * np.ones((2, len(STRENGTHS), 1, 1))
    likelihood = np.zeros((2, len(STRENGTHS)))
    noises = {s: np.fmax(white_noise(series), NOISE[s]) for s, series in hover.items()}
    samples = [
        (time, state, row)
        for state, series in hover.items()
        for time, row in zip(series.time.tolist(), series.values, strict=True)
    ]
    samples.sort(key=lambda sample: sample[0])
    now = samples[0][0]
    for time, state, values in samples:
        if time > now:
            mean, covariance = _predicted(mean, covariance, time - now)
            now = time
        variance = covariance[..., state, state] + noises[state][:, None] ** 2
        gain = covariance[..., state] / variance[..., None]
        surprise = values[:, None] - mean[..., state]
        likelihood -= 0.5 * (surprise**2 / variance + np.log(variance))
        mean = mean + gain * surprise[..., None]
        covariance = covariance - gain[..., None] * covariance[..., state, None, :]
    mean, covariance = _predicted(mean, covariance, -now)
    best = (np.arange(2), np.argmax(likelihood, axis=1))
    beyond = np.eye(5)[[VELOCITY, TILT, RATE]]
    beyond[1, STEADY] = -1.0
    return mean[best] @ beyond.T, beyond @ covariance[best] @ beyond.T


def _predicted(mean: Array, covariance: Array, step: float) -> tuple[Array, Array]:
    """Return means (2, S, 5) and covariances (2, S, 5, 5) a step in s later."""
    ahead = np.tile(np.eye(5), (2, 1, 1, 1))
    ahead[..., POSITION, VELOCITY] = ahead[..., TILT, RATE] = step
    # pitch pushes forward, roll to the right
    push = GRAVITY * step * np.array([1.0, -1.0])[:, None]
    ahead[..., VELOCITY, TILT], ahead[..., VELOCITY, STEADY] = push, -push
    ahead[..., POSITION, TILT] = 0.5 * step * push
    ahead[..., POSITION, STEADY] = -0.5 * step * push
    covariance = ahead @ covariance @ np.swapaxes(ahead, -1, -2)
    squares = np.square(STRENGTHS) * step / PER_SECOND
    covariance[..., VELOCITY, VELOCITY] += GUST**2 * squares
    covariance[..., RATE, RATE] += UNREST**2 * squares
    return (ahead @ mean[..., None])[..., 0], covariance
