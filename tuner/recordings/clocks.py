"""Clocks of a recording: stamps against times of arrival, the mission's ticks, the pose's offset.

A stamp is the time of measurement, the arrival that of recording. A loop that publishes regularly
shows the ticks of the mission's uniform clock. Where different clocks stamp pose and gyro, their
cross-correlation shows the offset.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tuner.core.numerics import Array
from tuner.recordings.flight import Series
from tuner.recordings.interpolation import (
    RATE_HZ,
    body_rate_of,
    correlation,
    correlation_aligned,
    correlations,
    middle_clock,
    resample,
    rms,
    smooth,
)
from tuner.recordings.notes import Kind, Note, NoteCode
from tuner.recordings.recording import NS_PER_SECOND, Nanoseconds, TopicSamples

#: A stamp that leaves its neighbours by more, while its arrival does not, has jumped.
MIN_CLOCK_JUMP_NS = NS_PER_SECOND // 10
#: Topics whose stamps differ by more from the others' have a clock of their own.
MIN_CLOCK_OFFSET_NS = NS_PER_SECOND // 2
#: Stamps that are further apart than so many messages, as whole seconds, are too coarse; those of a
#: message for each of eight rotors are not.
MAX_STAMP_RATIO = 12
#: Share of a period by which a stamp may be off its tick.
MAX_TICK_DEVIATION = 0.2
#: s/s. No clock drifts faster: such stamps have another rate.
MAX_CLOCK_DRIFT = 0.01
#: A smaller offset is left to the fit, which estimates a time offset and latencies.
MIN_POSE_OFFSET_S = 0.02
#: Signals of motion capture, which a table may have beside those of the autopilot.
POSE_SIGNALS = ("position", "attitude", "velocity")
#: The search range of the offset, to either side.
MAX_POSE_OFFSET_S = 0.6
#: 1 - correlation at the offset over that without it, at most.
MAX_MISMATCH_RATIO = 0.8
#: rad/s, and a correlation: less is no evidence of an offset.
MIN_TURN_RATE = 0.1
MIN_CORRELATION = 0.6
#: Rows beyond the delay that signals show as they are, for that which they show once aligned.
ALIGNED_LAGS = 3
#: Both signals are averaged over this window against noise.
AVERAGING_WINDOW_S = 0.1


def message_times(
    samples: Mapping[str, TopicSamples],
    receive_only: Collection[str] = (),
    slow_topics: Collection[str] = (),
) -> tuple[dict[str, Nanoseconds], tuple[Note, ...]]:
    """Return the times of every topic's messages, all on one clock.

    Header stamps are times of measurement; arrivals are later by a varying delay. So stamps are
    used, after single wrong ones and jumps of a clock that was set are repaired by the arrivals. A
    topic stamped by another clock than the rest is moved onto theirs.

    Parameters
    ----------
    receive_only
        Topics whose stamps are ignored.
    slow_topics
        Topics that change so slowly that the arrival serves as well as a stamp.
    """
    notes: list[Note] = []
    unset_topics: list[str] = []
    times: dict[str, Nanoseconds] = {}
    offsets: dict[str, int] = {}
    for topic, messages in samples.items():
        if messages.stamp is None or topic in receive_only or not len(messages.stamp):
            continue
        receive_span, stamp_span = (
            np.ptp(np.quantile(t, (0.1, 0.9))) for t in (messages.receive, messages.stamp)
        )
        apart = float(np.median(np.diff(np.unique(messages.stamp)))) if stamp_span else 0.0
        is_coarse = apart > MAX_STAMP_RATIO * receive_span / len(messages.stamp)
        if receive_span > NS_PER_SECOND and (is_coarse or stamp_span < receive_span / 2):
            unset_topics.append(topic)
            continue
        stamp, repaired = _repair_stamps(topic, messages.stamp, messages.receive)
        notes.extend(repaired)
        times[topic] = stamp
        offsets[topic] = int(np.median(stamp - messages.receive))
    common = int(np.median(list(offsets.values()))) if offsets else 0
    for topic, offset in offsets.items():
        if abs(offset - common) > MIN_CLOCK_OFFSET_NS:
            times[topic] = times[topic] - (offset - common)
            seconds, count = (offset - common) / NS_PER_SECOND, len(times[topic])
            notes.append(NoteCode.OTHER_CLOCK.note(topic=topic, count=count, seconds=seconds))
    for topic, messages in samples.items():
        if topic not in times:
            # Where stamps count from a start-up, arrivals are shifted to count from there too.
            times[topic] = messages.receive + (common if abs(common) > NS_PER_SECOND else 0)
            if topic in unset_topics:
                notes.append(NoteCode.STAMPS_UNSET.note(topic=topic, count=len(messages.receive)))
            elif topic not in receive_only:
                kind: Kind = "info" if topic in slow_topics else "warning"
                notes.append(
                    NoteCode.NO_HEADER.note(kind=kind, topic=topic, count=len(messages.receive))
                )
    return times, tuple(notes)


def _repair_stamps(
    topic: str, stamp: Nanoseconds, receive: Nanoseconds
) -> tuple[Nanoseconds, list[Note]]:
    """Undo jumps of the stamps that the arrivals do not show."""
    if len(stamp) < 3:
        return stamp, []
    step, arrival = np.diff(stamp), np.diff(receive)
    usual = int(np.median(step))
    extra = step - arrival
    # A recorder that stalls delays arrivals while stamps go on as usual: that is no jump.
    jumped = np.flatnonzero(
        (np.abs(extra) > MIN_CLOCK_JUMP_NS) & (np.abs(step - usual) > MIN_CLOCK_JUMP_NS)
    )
    if len(jumped) == 0:
        return stamp, []
    fixed, notes, steps, wrong, left = stamp.copy(), list[Note](), list[int](), 0, deque(jumped)
    while left:
        here = int(left.popleft())
        back = int(left[0]) if left else -1
        if back - here in (1, 2, 3) and abs(int(extra[here] + extra[back])) < MIN_CLOCK_JUMP_NS:
            rows, near = slice(here + 1, int(left.popleft()) + 1), here
        elif here == 0:
            rows, near = slice(0, 1), 1
        elif here == len(step) - 1:
            rows, near = slice(here + 1, here + 2), here
        else:
            steps.append(here)
            continue
        fixed[rows] = receive[rows] + (stamp[near] - receive[near])
        wrong += rows.stop - rows.start
    if wrong:
        notes.append(NoteCode.STAMPS_REPLACED.note(topic=topic, count=wrong))
    if steps:
        bounds = [0, *(at + 1 for at in steps), len(stamp)]
        parts = list(pairwise(bounds))
        level = [int(np.median(fixed[a:b] - receive[a:b])) for a, b in parts]
        longest = max(range(len(parts)), key=lambda k: parts[k][1] - parts[k][0])
        for (a, b), offset in zip(parts, level, strict=True):
            fixed[a:b] -= offset - level[longest]
        largest = max(abs(offset - level[longest]) for offset in level) / NS_PER_SECOND
        notes.append(NoteCode.CLOCK_JUMPED.note(topic=topic, count=len(steps), seconds=largest))
    return fixed, notes


@dataclass(frozen=True)
class Grid:
    """Ticks at `origin` + k / `rate`.

    Attributes
    ----------
    origin
        s, the time of one tick.
    rate
        Hz; the requested rate, or a multiple of it that the publisher keeps.
    drift
        Seconds per second by which the publisher's clock runs slower than its stamps.
    spread
        s, the 95th percentile of the stamps' delay after their ticks.
    """

    origin: float
    rate: float
    drift: float = 0.0
    spread: float = 0.0

    def tick_nearest(self, time: float) -> float:
        """Return the time of the tick nearest to a time."""
        return self.origin + round((time - self.origin) * self.rate) / self.rate

    def snap(self, time: Array) -> Array:
        """Return (n,) stamps moved to their ticks; unchanged if they follow none.

        A loop that publishes on every tick stamps a fraction of a millisecond late. Held on the
        uniform clock, such a sample would otherwise be read a whole tick late.
        """
        phase = (time - self.origin) * self.rate
        on_drifting = phase * (1 - self.drift)
        tick = np.rint(on_drifting)
        if np.quantile(np.abs(on_drifting - tick), 0.99) > MAX_TICK_DEVIATION:
            return time
        snapped = self.origin + tick / self.rate
        return snapped if np.all(np.diff(snapped) > 0) else time


def fit_grid(time: Array, rate: float) -> Grid | None:
    """Fit ticks of a known rate, or a multiple, to (n,) increasing stamps that come a little late.

    A publisher's timer fires on the tick and the stamp is written a little later, never earlier:
    the ticks are the lower envelope of the stamps, taken as the first percentile of their delays
    after removal of a steady drift. None if the stamps follow no ticks.
    """
    if len(time) < 20:
        return None
    period = np.median(np.diff(time))
    if period * rate < 1 - MAX_TICK_DEVIATION:  # published more often than the wanted clock ticks
        rate *= max(1, round(1 / (period * rate)))
    stride = round(period * rate)
    if stride < 1 or abs(period * rate - stride) > MAX_TICK_DEVIATION:
        return None
    tick = np.cumsum(np.concatenate([[0], np.rint(np.diff(time) * rate)]))
    late = time - time[0] - tick / rate
    blocks = np.array_split(np.arange(len(time)), min(20, len(time) // 10))
    middle = np.array([np.median(tick[block]) for block in blocks]) / rate
    low = np.array([np.quantile(late[block], 0.1) for block in blocks])
    drift = float(np.polyfit(middle, low, 1)[0]) if len(blocks) > 2 else 0.0
    if abs(drift) > MAX_CLOCK_DRIFT:
        return None
    if abs(drift) * (time[-1] - time[0]) < 1e-3:
        drift = 0.0
    steady = late - drift * tick / rate
    origin = float(np.quantile(steady, 0.01))
    spread = float(np.quantile(steady - origin, 0.95))
    if spread > MAX_TICK_DEVIATION / rate:
        return None
    return Grid(float(time[0]) + origin, rate, drift, spread)


def clock_of(
    series: Mapping[str, Series], rate: float, start: float = -np.inf, end: float = np.inf
) -> Grid | None:
    """Return the ticks of the reference or, without one, of the set-points."""
    for name in ("reference_position", "rate_setpoint", "thrust_setpoint"):
        grid = fit_grid(series[name].between(start, end).time, rate) if name in series else None
        if grid is not None:
            return grid
    return None


def pose_offset(series: Mapping[str, Series]) -> float | None:
    """Return the delay in s of the attitude's stamps against the gyro's.

    None if one is missing or the vehicle turns too little.
    """
    if "attitude" not in series or "body_rate" not in series:
        return None
    clock = middle_clock(series)
    if len(clock) < 3 * MAX_POSE_OFFSET_S * RATE_HZ:
        return None
    turning = smooth(
        body_rate_of(resample("attitude", series["attitude"], clock)), AVERAGING_WINDOW_S
    )
    gyro = smooth(resample("body_rate", series["body_rate"], clock), AVERAGING_WINDOW_S)
    late = None if rms(gyro) < MIN_TURN_RATE else lag_between(turning, gyro)
    if not late:
        return late
    # on a circle, markers whose axes are askew look late
    aligned = lag_between(turning, gyro, alike=correlation_aligned) or 0.0
    delayed = correlation(*_overlapping(turning, gyro, round(late * RATE_HZ)))
    askew, both = (
        correlation_aligned(*_overlapping(turning, gyro, round(lag * RATE_HZ)))
        for lag in (0.0, aligned)
    )
    is_askew = askew > delayed or 1 - both < MAX_MISMATCH_RATIO * (1 - delayed)
    return aligned if is_askew else late


def _overlapping(one: Array, other: Array, lag: int) -> tuple[Array, Array]:
    """Return the rows that two signals share once the one is moved back by a lag."""
    rows = len(one)
    return one[max(0, lag) : rows + min(0, lag)], other[max(0, -lag) : rows - max(0, lag)]


def lag_between(
    one: Array, other: Array, *, alike: Callable[[Array, Array], float] = correlation
) -> float | None:
    """Return the delay in s of one signal (n, k) against another, both at `RATE_HZ`.

    None if they are not alike; 0 if another delay makes them hardly more so.
    """
    # The best whole lag first, then a parabola through the three highest points.
    furthest = round(MAX_POSE_OFFSET_S * RATE_HZ)

    def score(lag: int) -> float:
        return alike(*_overlapping(one, other, lag))

    best, on_time = int(np.argmax(correlations(one, other, furthest))) - furthest, score(0)
    if alike is not correlation:
        lags = range(min(best, 0) - ALIGNED_LAGS, max(best, 0) + ALIGNED_LAGS + 1)
        best = max((lag for lag in lags if abs(lag) <= furthest), key=score)
    left, peak, right = (score(best + side) for side in (-1, 0, 1))
    if (
        peak < MIN_CORRELATION
        or abs(best) == furthest
        or 1 - peak > MAX_MISMATCH_RATIO * (1 - on_time)
    ):
        return 0.0 if on_time > MIN_CORRELATION else None
    curvature = left - 2 * peak + right
    fine = 0.5 * (left - right) / curvature if curvature < 0 else 0.0
    return float((best + fine) / RATE_HZ)


def align_pose(
    series: Mapping[str, Series], topics: Mapping[str, str]
) -> tuple[dict[str, Series], tuple[Note, ...]]:
    """Move the pose onto the clock of the gyro where they clearly differ.

    Parameters
    ----------
    topics
        Signal -> topic; signals of the attitude's topic are moved with it, of a table those of
        `POSE_SIGNALS`.
    """
    aligned = dict(series)
    topic = topics.get("attitude", "")
    is_table = topic == topics.get("body_rate")
    offset = pose_offset(series)
    if offset is None:
        return aligned, ()
    if abs(offset) < MIN_POSE_OFFSET_S:
        if is_table:
            return aligned, ()
        return aligned, (NoteCode.POSE_ON_TIME.note(kind="info", topic=topic, seconds=offset),)
    for signal, samples in series.items():
        if topics.get(signal) == topic and (signal in POSE_SIGNALS or not is_table):
            aligned[signal] = Series(samples.time - offset, samples.values)
    count = len(series["attitude"].time)
    return aligned, (NoteCode.POSE_MOVED.note(topic=topic, count=count, seconds=offset),)
