"""The missions in a recording: their start and end, their yaw spin, and which are fitted.

Half an hour in the air is mostly hover, which excites little, and too long for one simulation: long
missions are split into manoeuvres, and those with most motion are fitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array
from tuner.recordings.flight import Series
from tuner.recordings.interpolation import runs

MAX_REST_MOTION = 1e-5
"""A reference with less motion, in m or m/s, is at rest."""
MAX_PAUSE_S = 1.0
"""Set-points that pause for longer begin another mission."""
MAX_POSE_PAUSE_S = 10.0
"""A pose that pauses for longer, as where a clock was set, ends a mission."""
MIN_LANDING_S = 0.2
"""A shorter time on the ground is no landing: a bounce takes longer."""
MAX_TOUCHDOWN_S = 3.0
"""Motors that touched down idle within this."""
MIN_MISSION_S = 2.0
"""A shorter stretch is no mission."""
MAX_IDLE_COMMAND, MAX_OFF_COMMAND = 0.12, 0.02
MAX_IDLE_SHARE = 0.5
IDLE = {
    "command": (MAX_IDLE_COMMAND, MAX_OFF_COMMAND),
    "rotor_speed": (80.0, 20.0),
    "thrust_setpoint": (MAX_IDLE_COMMAND, MAX_OFF_COMMAND),
}
"""A mean motor command or thrust, and a rotor speed in rad/s, below the first is idle; but not
above `MAX_IDLE_SHARE` of its median in the air, nor below the second, that of stopped motors."""
MIN_FLYING_HEIGHT_M = 0.12
"""The vehicle flies if it is higher above the ground."""
MAX_RESTING_RANGE_M = 0.01
"""A position that stays within this for a second rests."""
BIN_S = 0.1
"""Positions are averaged over bins."""
MAX_FALL_S = 2.0
"""A vehicle falls and bounces for so long at most,"""
MIN_FALL = 0.5
"""gains at least this share of gravity, in the mean of any two bins,"""
MAX_IMPACT_S = 0.3
"""and bounces off within this."""
MIN_SPIN_S = 3.0
"""A yaw rate set-point that stays the same for longer is another experiment."""
MAX_SETPOINT_DELAY_S = 0.5
"""Set-points that begin so soon after the pose ran all the time."""
MAX_WHOLE_MISSION_S = 120.0
"""A longer mission is split into manoeuvres."""
MAX_MANOEUVRE_S = 60.0
"""A longer manoeuvre is split."""
MAX_FITTED_S = 180.0
"""At most so much of a long recording is fitted."""
MIN_MANOEUVRE_S = 5.0
"""A shorter stretch is no manoeuvre."""
MIN_HOVER_PAUSE_S = 3.0
"""A longer hover ends a manoeuvre."""
HOVER_LEAD_S = 1.0
"""A manoeuvre begins with so much hover, so that its simulation begins at rest."""
MAX_HOVER_SPEED, MAX_HOVER_TURN_RATE = 0.3, 0.3
"""m/s and rad/s. A vehicle that moves or turns faster does not hover."""

NOTHING, NO_RATES = (Series(np.zeros(0), np.zeros((0, columns))) for columns in (1, 3))


@dataclass(frozen=True)
class Mission:
    """A stretch of a recording that is flown and compared.

    Attributes
    ----------
    start, end
        Seconds in the time of the series.
    fitted
        Whether it is fitted: of a long recording only the manoeuvres that show most are.
    """

    start: float
    end: float
    begins_with: str
    fitted: bool = True


def find_missions(series: Mapping[str, Series]) -> tuple[Mission, ...]:
    """Return the missions in the order of flight; empty where nothing flies.

    A mission starts where the attitude set-points begin. Without set-points, or if they run from
    the start, it starts where the reference begins to move or, without one, in the air. Time on the
    ground, the first centimetres of take-off and the last of landing, and all after the last
    attitude are cut. A yaw spin between other manoeuvres is a mission of its own.
    """
    pose = series["position"].time
    first, last = float(pose[0]), float(pose[-1])
    if "attitude" in series and series["attitude"].time[-1] < last - MAX_PAUSE_S:
        last = float(series["attitude"].time[-1])
    setpoints = next((series[n] for n in ("rate_setpoint", "thrust_setpoint") if n in series), None)
    spans = [(-np.inf, np.inf)]
    if setpoints is not None and len(setpoints.time) > 1:
        spans = stretches(
            setpoints.time, np.ones(len(setpoints.time), np.bool_), max_break=MAX_PAUSE_S
        )
    begun = len(spans) > 1 or spans[0][0] >= first + MAX_SETPOINT_DELAY_S
    if not begun and "reference_position" in series:
        last = min(last, float(series["reference_position"].time[-1]))
    missions, flying = [], airborne(series)
    for start, end in spans:
        for up, down in flying:
            if begun and start >= up:
                begin, begins_with = start, "attitude set-points"
            else:  # they began on the ground, if at all
                flown = max(up, start)
                begin = _first_motion(series, flown, min(end, down))
                begins_with = "the reference's motion" if begin > flown else "flight"
            mission = Mission(begin, min(end, down, last), begins_with)
            for part in _split_at_pose_pauses(mission, series["position"].time):
                missions += _split_at_spins(part, series)
    return tuple(m for m in missions if m.end - m.start >= MIN_MISSION_S)


def mission_error(path: Path, series: Mapping[str, Series]) -> RecordingError:
    """Return why a recording has no mission."""
    position = series["position"]
    turned = replace(position, values=position.values * [1.0, 1.0, -1.0])
    if find_missions({**series, "position": turned}):
        return RecordingError(
            path,
            "flies only if z of its position points down, as in NED axes",
            "give position, and what else is so, frame: ned_frd in a topic map (--topics FILE)",
        )
    others = {name: samples for name, samples in series.items() if name not in IDLE}
    motors = next((name for name in IDLE if name in series), None)
    moves = np.ptp(position.values, axis=0).max() > 3 * MIN_FLYING_HEIGHT_M
    if motors and moves and find_missions(others):
        there = np.nanmedian(series[motors].values)
        return RecordingError(
            path,
            f"moves with motors that idle, by its {motors}, which is read as {there:.2g}",
            f"if it flew, give {motors} its unit in a topic map (--topics FILE)",
        )
    return RecordingError(
        path,
        "nothing flies in it for 2 s: no mission was found",
        "inspect it, or give 'start' and 'end' in a side-car",
    )


def _split_at_pose_pauses(mission: Mission, pose: Array) -> list[Mission]:
    """Return a mission without the pauses of its pose."""
    inside = pose[(pose >= mission.start) & (pose <= mission.end)]
    pieces = stretches(inside, np.ones(len(inside), np.bool_), max_break=MAX_POSE_PAUSE_S)
    if len(pieces) < 2:
        return [mission]
    first, *later = pieces
    return [
        replace(mission, end=first[1]),
        *(replace(mission, start=a, end=b, begins_with="flight") for a, b in later),
    ]


def _split_at_spins(mission: Mission, series: Mapping[str, Series]) -> list[Mission]:
    """Return the yaw spins in a mission along a reference, and what is before and after them.

    Attitude control sets the yaw rate elsewhere, and no loop is simulated that changes between.
    What follows a spin begins where it no longer turns back: rotors clip while it does.
    """
    setpoints = series.get("rate_setpoint", NO_RATES).between(mission.start - 1e-3, mission.end)
    whole, _ = yaw_spin(setpoints, mission.start, mission.end)
    if whole is not None or "reference_position" not in series:
        return [mission]
    time, yaw = setpoints.time, setpoints.values[:, 2]
    held = np.append(np.abs(np.diff(yaw)) < 1e-3 * np.abs(yaw[1:]), False)
    pieces, start, begins_with = [], mission.start, mission.begins_with
    for first, last in runs(held):
        begin, end = float(time[first]), float(time[last])
        if end - begin > MIN_SPIN_S and yaw_spin(setpoints, begin, end)[0] is not None:
            pieces.append(replace(mission, start=start, end=begin, begins_with=begins_with))
            pieces.append(replace(mission, start=begin, end=end, begins_with="a yaw spin"))
            settled = time[(time > end) & (np.abs(yaw) < MAX_HOVER_TURN_RATE)]
            start, begins_with = float(settled.min(initial=mission.end)), "flight"
    return [*pieces, replace(mission, start=start, begins_with=begins_with)]


def _first_motion(series: Mapping[str, Series], start: float, end: float) -> float:
    """Return the time at which the reference begins to move; the start if it does not.

    That is its first sample with a velocity, or the last one before its position changes.
    """
    firsts: list[float] = []
    if "reference_velocity" in series:
        samples = series["reference_velocity"].between(start, end).complete()
        moves = np.abs(samples.values).max(axis=1, initial=0.0) > MAX_REST_MOTION
        firsts += samples.time[moves][:1].tolist()
    if "reference_position" in series:
        samples = series["reference_position"].between(start, end).complete()
        away = np.abs(samples.values - samples.values[:1]).max(axis=1)
        moved = np.flatnonzero(away > MAX_REST_MOTION)[:1]
        rest, moving = samples.time[moved - 1], samples.time[moved]
        firsts += np.where(moving - rest < MAX_PAUSE_S, rest, moving).tolist()
    return min(firsts, default=start)


def airborne(series: Mapping[str, Series]) -> list[tuple[float, float]]:
    """Return the stretches in which the rotors carry the vehicle.

    The ground is known where motors idle, or where the recording begins or ends at rest and the
    vehicle climbs from there; a recording that shows no ground is all in the air. A vehicle that
    passes a guessed ground without rest, or whose motors stop for a moment, flies on.
    """
    position = series["position"]
    time, height = position.time, position.values[:, 2]
    rests = _is_still(time, position.values)
    idle, observed = _idle(series, time, height)
    stands = _lasting_idle(time, idle, rests)
    grounded = stands | (_is_on_ground(time, height) & rests & ~observed)
    if not grounded.any():
        return [(float(time[0]), float(time[-1]))]
    low = grounded | ~(height > _ground_height(time, height, grounded) + MIN_FLYING_HEIGHT_M)
    if not stands.any():  # the ground is a guess, and what passes it without a rest flies
        for first, last in runs(low):
            low[first:last] = (grounded | rests)[first:last].any()
    return [(up, _before_fall(time, height, down)) for up, down in stretches(time, ~low)]


def _before_fall(time: Array, height: Array, end: float) -> float:
    """Return the time at which a fall begins that ends with the flight, or else the flight's end.

    As after motors that were stopped, or a collision, where no command or rotor speed shows it.
    """
    at = end - 0.1 * BIN_S * np.arange(round(MAX_FALL_S / (0.1 * BIN_S)))
    before = [np.interp(at - back * BIN_S, time, height) for back in range(3)]
    falls = (before[0] - 2.0 * before[1] + before[2]) / BIN_S**2 < -MIN_FALL * GRAVITY
    for first, last in runs(falls):
        if at[first] > end - MAX_IMPACT_S:  # of the fall, or of what bounced after it
            end = float(at[last - 1]) - 1.5 * BIN_S
    return end


def _is_still(time: Array, positions: Array) -> NDArray[np.bool_]:
    """Return at which of n times the (n, 3) positions rest for a second around."""
    from scipy import ndimage  # noqa: PLC0415 (slow to import, seldom needed)

    bins = ((time - time[0]) / BIN_S).astype(np.int64)
    held, place = np.unique(bins, return_inverse=True)
    counts = np.bincount(place)
    spread = np.zeros(len(held))
    window = round(1.0 / BIN_S)
    for column in positions.T:
        means = np.bincount(place, column) / counts
        reach = ndimage.maximum_filter1d(means, window)
        reach -= ndimage.minimum_filter1d(means, window)
        spread = np.maximum(spread, reach)
    return np.asarray((spread < MAX_RESTING_RANGE_M)[place], dtype=np.bool_)


def _lasting_idle(
    time: Array, idle: NDArray[np.bool_], rests: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return where motors idle, without brief moments in flight."""
    lasting = idle.copy()
    for first, last in runs(idle):
        inside = first > 0 and last < len(time)
        if inside and time[last - 1] - time[first] < MAX_PAUSE_S and not rests[first:last].any():
            lasting[first:last] = False
    return lasting


def _idle(
    series: Mapping[str, Series], time: Array, height: Array
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return at which times the motors idle, and at which it is known whether they do.

    What is not recorded of commands, as where they are sent to armed motors alone, rotor speeds
    tell. Thrust set-points are those of no motor before it is armed: they tell of idling alone.
    """
    clear = height > float(np.quantile(height, 0.02)) + 3 * MIN_FLYING_HEIGHT_M
    idle, observed = np.zeros((2, len(time)), dtype=np.bool_)
    for name, (limit, off) in IDLE.items():
        samples = series.get(name, NOTHING)
        samples = samples.where(np.asarray(np.isfinite(samples.values).any(axis=1)))
        if len(samples.time) < 2:
            continue
        at = np.interp(time, samples.time, np.nanmean(samples.values, axis=1))
        told = (time >= samples.time[0] - MIN_LANDING_S) & (
            time <= samples.time[-1] + MIN_LANDING_S
        )
        flown = at[clear & told]
        carries = MAX_IDLE_SHARE * float(np.median(flown)) if len(flown) else limit
        idle |= told & ~observed & (at < max(off, min(limit, carries)))
        observed |= told & (name != "thrust_setpoint")
    return idle, observed


def _is_on_ground(time: Array, height: Array) -> NDArray[np.bool_]:
    """Return when the vehicle is on the ground at the start or the end of the recording.

    There it rests, and seen from there it climbs before it comes any lower.
    """
    resting = np.zeros(len(time), dtype=np.bool_)
    for onward in (slice(None), slice(None, None, -1)):
        seen = height[onward]
        near = seen[np.abs(time - time[onward][0])[onward] < 1.0]
        level = float(np.median(near))
        left = np.flatnonzero((seen < level - 0.03) | (seen > level + 3 * MIN_FLYING_HEIGHT_M))
        if np.ptp(near) < 0.01 and len(left) and seen[left[0]] > level:
            resting |= np.abs(height - level) < 0.03
    return resting


def _ground_height(time: Array, height: Array, grounded: NDArray[np.bool_]) -> Array:
    """Return the ground's height at each time: of where it landed, shortly before, or took off.

    That is the median over the last second there, or the first: it may be carried in between.
    """
    level, until = np.zeros(len(time)), [first for first, _ in runs(grounded)][1:]
    for (first, last), behind in zip(runs(grounded), [*until, len(time)], strict=True):
        on = slice(first, last)
        leaves = np.median(height[on][time[on] > time[last - 1] - MAX_PAUSE_S])
        lands = np.median(height[on][time[on] < time[first] + MAX_PAUSE_S])
        begins = np.searchsorted(time, time[first] - MAX_TOUCHDOWN_S) if level.any() else 0
        level[begins:first], level[first:behind] = lands, leaves
    return level


def stretches(
    time: Array, flags: NDArray[np.bool_], *, max_break: float = MIN_LANDING_S
) -> list[tuple[float, float]]:
    """Return the stretches of time with true flags, across breaks of up to `max_break` s."""
    holds = time[flags]
    if len(holds) == 0:
        return []
    parts = np.split(holds, np.flatnonzero(np.diff(holds) > max_break) + 1)
    return [(float(part[0]), float(part[-1])) for part in parts]


def yaw_spin(rate_setpoint: Series | None, start: float, end: float) -> tuple[float | None, bool]:
    """Return the constant yaw rate set-point of a mission, and whether level flight is held.

    Returns
    -------
    tuple
        rad/s, body z, None if it does not spin; and whether attitude control sets the roll and
        pitch rates, so that position and attitude are held. Else both set-points are zero, and only
        thrust is controlled.
    """
    rates = np.empty((0, 3))
    if rate_setpoint is not None:
        rates = rate_setpoint.between(start - 1e-3, end).values
    if len(rates) < 10:
        return None, False
    yaw = float(np.median(rates[:, 2]))
    constant = np.abs(rates[:, 2] - yaw) < 1e-3 * abs(yaw)
    if abs(yaw) < 0.05 or not _nearly_always(constant):
        return None, False
    if _nearly_always(constant & (np.abs(rates[:, :2]) < 1e-6).all(axis=1)):
        return yaw, False
    # a controller's corrections change from one set-point to the next
    corrected = np.ptp(rates[constant, :2], axis=0) > 1e-6
    return (yaw, True) if corrected.all() else (None, False)


def _nearly_always(flags: NDArray[np.bool_]) -> bool:
    return float(flags.mean()) > 0.95


def split_into_manoeuvres(
    series: Mapping[str, Series], missions: Sequence[Mission]
) -> tuple[Mission, ...]:
    """Return missions, long ones as manoeuvres, of which those with most motion are fitted.

    Parameters
    ----------
    missions
        In the order of flight.
    """
    if all(mission.end - mission.start <= MAX_WHOLE_MISSION_S for mission in missions):
        return tuple(missions)
    time, moving, turning = _motion(series)
    active = np.asarray(
        (moving > MAX_HOVER_SPEED) | (turning > MAX_HOVER_TURN_RATE), dtype=np.bool_
    )
    parts: list[Mission] = []
    for mission in missions:
        parts += (
            [mission]
            if mission.end - mission.start <= MAX_WHOLE_MISSION_S
            else _manoeuvres_of(mission, time, active)
        )
    activity = moving**2 + turning**2

    def activity_in(part: Mission) -> float:
        return float(activity[(time >= part.start) & (time <= part.end)].sum())

    remaining, chosen = MAX_FITTED_S, set[int]()
    for number in sorted(range(len(parts)), key=lambda i: -activity_in(parts[i])):
        if parts[number].end - parts[number].start <= remaining:
            remaining -= parts[number].end - parts[number].start
            chosen.add(number)
    return tuple(replace(part, fitted=number in chosen) for number, part in enumerate(parts))


def _manoeuvres_of(mission: Mission, time: Array, active: NDArray[np.bool_]) -> list[Mission]:
    """Return the manoeuvres of a mission; its beginning if it has none."""
    inside = active & (time >= mission.start) & (time <= mission.end)
    parts = []
    for first, last in stretches(time, inside, max_break=MIN_HOVER_PAUSE_S):
        begin = max(mission.start, first - HOVER_LEAD_S)
        count = int(np.ceil((last - begin) / MAX_MANOEUVRE_S - 1e-9))
        edges = np.linspace(begin, last, max(1, count) + 1)
        parts += [
            Mission(float(a), float(b), "a manoeuvre")
            for a, b in pairwise(edges)
            if b - a >= MIN_MANOEUVRE_S
        ]
    whole = replace(mission, end=mission.start + MAX_MANOEUVRE_S)
    return parts or [whole]


def _motion(series: Mapping[str, Series]) -> tuple[Array, Array, Array]:
    """Return (n,) bins' times, speeds in m/s and turn rates in rad/s."""
    position = series["position"]
    time = np.arange(position.time[0], position.time[-1], BIN_S) + 0.5 * BIN_S
    places = np.column_stack([_bin_means(position, time, column) for column in range(3)])
    speed = np.linalg.norm(np.gradient(places, BIN_S, axis=0), axis=1)
    rates = series.get("body_rate")
    if rates is None:
        return time, speed, np.zeros(len(time))
    turning = np.column_stack([_bin_means(rates, time, column) for column in range(3)])
    return time, speed, np.linalg.norm(turning, axis=1)


def _bin_means(samples: Series, time: Array, column: int) -> Array:
    """Return (n,) means of a column over bins, interpolated over empty ones."""
    bins = ((samples.time - time[0]) / BIN_S + 0.5).astype(np.int64)
    there = (bins >= 0) & (bins < len(time)) & np.isfinite(samples.values[:, column])
    count = np.bincount(bins[there], minlength=len(time))
    total = np.bincount(bins[there], samples.values[there, column], minlength=len(time))
    held = count > 0
    if not held.any():
        return np.zeros(len(time))
    return np.interp(time, time[held], total[held] / count[held])
