"""A long flight as its manoeuvres, and which of them show most.

Half an hour in the air is mostly hover, from which little is learnt, and too much to simulate in
one piece.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tuner.recordings.flight import Array, Series
from tuner.recordings.mission import Mission, stretches

LONG = 120.0
"""s beyond which a mission is taken apart."""
PIECE = 60.0
"""s of a manoeuvre, at most."""
FITTED = 180.0
"""s of a long recording that are fitted, at most."""
SHORTEST = 5.0
"""s of a manoeuvre, at least."""
PAUSE = 3.0
"""s of hover that end a manoeuvre."""
BEFORE = 1.0
"""s of hover before it that belong to it: what is simulated begins at rest."""
MOVES, TURNS = 0.3, 0.3
"""m/s and rad/s above which a vehicle does more than hover."""
BIN = 0.1
"""s of which one mean is taken."""


def manoeuvres(series: Mapping[str, Series], missions: Sequence[Mission]) -> tuple[Mission, ...]:
    """Return missions, the long ones as manoeuvres, those that show most marked as fitted.

    Parameters
    ----------
    series
        Signals; position among them.
    missions
        In the order of flight.
    """
    if all(mission.end - mission.start <= LONG for mission in missions):
        return tuple(missions)
    time, moving, turning = _motion(series)
    active = np.asarray((moving > MOVES) | (turning > TURNS), dtype=np.bool_)
    parts: list[Mission] = []
    for mission in missions:
        parts += [mission] if mission.end - mission.start <= LONG else _parts(mission, time, active)
    vivid = moving**2 + turning**2

    def shown(part: Mission) -> float:
        return float(vivid[(time >= part.start) & (time <= part.end)].sum())

    left, chosen = FITTED, set[int]()
    for number in sorted(range(len(parts)), key=lambda i: -shown(parts[i])):
        if parts[number].end - parts[number].start <= left:
            left -= parts[number].end - parts[number].start
            chosen.add(number)
    return tuple(replace(part, fitted=number in chosen) for number, part in enumerate(parts))


def _parts(mission: Mission, time: Array, active: NDArray[np.bool_]) -> list[Mission]:
    """Return the manoeuvres of a mission; its beginning where there are none."""
    inside = active & (time >= mission.start) & (time <= mission.end)
    parts = []
    for first, last in stretches(time, inside, bridged=PAUSE):
        begin = max(mission.start, first - BEFORE)
        count = int(np.ceil((last - begin) / PIECE - 1e-9))
        edges = np.linspace(begin, last, max(1, count) + 1)
        parts += [
            Mission(float(a), float(b), "a manoeuvre")
            for a, b in pairwise(edges)
            if b - a >= SHORTEST
        ]
    whole = replace(mission, end=mission.start + PIECE)
    return parts or [whole]


def _motion(series: Mapping[str, Series]) -> tuple[Array, Array, Array]:
    """Return (n,) bins' times, speeds in m/s and turn rates in rad/s."""
    position = series["position"]
    time = np.arange(position.time[0], position.time[-1], BIN) + 0.5 * BIN
    places = np.column_stack([_means(position, time, column) for column in range(3)])
    speed = np.linalg.norm(np.gradient(places, BIN, axis=0), axis=1)
    rates = series.get("body_rate")
    if rates is None:
        return time, speed, np.zeros(len(time))
    turning = np.column_stack([_means(rates, time, column) for column in range(3)])
    return time, speed, np.linalg.norm(turning, axis=1)


def _means(samples: Series, time: Array, column: int) -> Array:
    """Return (n,) means of a column over bins, between those where there is none."""
    bins = ((samples.time - time[0]) / BIN + 0.5).astype(np.int64)
    there = (bins >= 0) & (bins < len(time)) & np.isfinite(samples.values[:, column])
    count = np.bincount(bins[there], minlength=len(time))
    total = np.bincount(bins[there], samples.values[there, column], minlength=len(time))
    held = count > 0
    if not held.any():
        return np.zeros(len(time))
    return np.interp(time, time[held], total[held] / count[held])
