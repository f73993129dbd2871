"""Samples that cannot be true, distinguished from fast motion by what surrounds them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tuner.recordings.flight import Array

#: Multiples of how far samples stick out nearby that make an outlier.
THRESHOLD = 6.0


@dataclass(frozen=True)
class Honest:
    """How far noise and honest motion take a sample from its neighbours.

    Attributes
    ----------
    floor
        In the signal's unit.
    share
        Share of the column's median that the floor is at least: small rotors turn, and change,
        several times faster than large ones.
    curvature
        Largest second derivative in time of honest motion, unit/s^2.
    jump
        Smallest leap from one sample to the next that nothing honest makes.
    """

    floor: float
    share: float = 0.0
    curvature: float = 0.0
    jump: float = np.inf

    def floor_of(self, values: Array) -> float:
        """Return the floor for (n,) values of one column."""
        level = float(np.median(np.abs(values))) if self.share and len(values) else 0.0
        return max(self.floor, self.share * level)


#: Signals with an outlier test. A quadcopter reaches 3 g; its quaternion bends by half the
#: angular acceleration; a rotor that turns at some 600 rad/s needs tens of ms for 30 up and back.
HONEST: Mapping[str, Honest] = {
    "position": Honest(floor=0.02, curvature=30.0, jump=0.08),
    "attitude": Honest(floor=0.03, curvature=100.0, jump=0.15),
    "rotor_speed": Honest(floor=30.0, share=0.05),
}

#: Seconds after which a pose that jumped away is not expected back.
AWAY = 1.0


def sticking_out(time: Array, values: Array, honest: Honest) -> NDArray[np.bool_]:
    """Return which samples of a signal stick out on one side of all that surrounds them.

    A sample is compared with the medians of the three samples before and the three after it. Ramps
    and steps lie between the two, so that fast motion and a motor's jump are kept; one or two
    samples that leave and come back are not. The bound adapts to the signal's own roughness.

    Parameters
    ----------
    time
        (n,) s, strictly increasing.
    values
        (n,) one column.
    honest
        What the signal may do by itself.
    """
    if len(values) < 7:
        return np.zeros(len(values), dtype=bool)
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(values, 3, mode="reflect", reflect_type="odd"), 7
    )
    before = _middle(*windows[:, :3].T)
    after = _middle(*windows[:, 4:].T)
    low, high = np.minimum(before, after), np.maximum(before, after)
    excess = np.maximum(np.maximum(low - values, values - high), 0.0)
    rough = np.lib.stride_tricks.sliding_window_view(np.pad(excess, 12, mode="symmetric"), 25)
    apart = np.pad((time[4:] - time[:-4]) / 4, 2, mode="edge")
    bound = honest.floor_of(values) + 2 * honest.curvature * apart**2
    usual = np.sort(rough, axis=1)[:, 20]  # the fifth largest of 25
    return np.asarray(excess > np.maximum(bound, THRESHOLD * usual), dtype=np.bool_)


def _middle(a: Array, b: Array, c: Array) -> Array:
    """Return the median of three, element by element."""
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))


def frozen(time: Array, values: Array, honest: Honest) -> NDArray[np.bool_]:
    """Return which samples of (n, k) values repeat the one before although the vehicle moved on.

    Motion capture that loses its markers goes on sending the last pose. A vehicle at rest in a
    simulator repeats itself too, but does not leap when it starts to move.
    """
    stuck = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 4:
        return stuck
    same = np.concatenate([[False], (values[1:] == values[:-1]).all(axis=1)])
    edges = np.flatnonzero(np.diff(np.concatenate([[False], same, [False]]).astype(np.int8)))
    for first, behind in zip(edges[::2], edges[1::2], strict=True):
        if behind - first < 3 or behind >= len(values):
            continue
        leap = np.abs(values[behind] - values[behind - 1]).max()
        usual = honest.floor / 4 + honest.curvature * (time[behind] - time[behind - 1]) ** 2
        stuck[first:behind] = leap > usual
    return stuck


def excursions(time: Array, values: Array, honest: Honest) -> tuple[NDArray[np.bool_], int]:
    """Return which samples of (n, k) values lie between a leap away and the leap back.

    Returns
    -------
    tuple
        (n,) which samples, and how many leaps did not come back within `AWAY`.
    """
    away = np.zeros(len(values), dtype=np.bool_)
    if len(values) < 12:
        return away, 0
    span = np.diff(time)
    speed = np.diff(values, axis=0) / span[:, None]
    if np.abs(np.diff(speed, axis=0) * span[1:, None]).max() < honest.jump / 4:
        return away, 0  # nothing leaps at all, and running medians take their time
    windows = np.lib.stride_tricks.sliding_window_view(
        np.pad(speed, ((5, 5), (0, 0)), mode="edge"), 11, axis=0
    )
    leap = np.diff(values, axis=0) - np.median(windows, axis=2) * span[:, None]
    size = np.sqrt((leap**2).sum(axis=1))
    at = np.flatnonzero(size > honest.jump + honest.curvature * span**2)
    lasting = 0
    i = 0
    while i < len(at):
        back = next(
            (
                j
                for j in range(i + 1, min(len(at), i + 40))
                if time[at[j]] - time[at[i]] < AWAY
                and np.linalg.norm(leap[at[i]] + leap[at[j]]) < 0.3 * size[at[i]] + honest.floor
            ),
            None,
        )
        if back is None:
            lasting += 1
            i += 1
        else:
            away[at[i] + 1 : at[back] + 1] = True
            i = back + 1
    return away, lasting
