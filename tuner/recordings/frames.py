"""Frames and element orders that a topic map has wrong, and signals that contradict each other.

A misread frame shows as motion that contradicts itself, and is replaced by the consistent one. A
doubted recording may still be fitted: wind or a poor gyro explain a doubt. A contradiction may not.
It takes a whole mission with much motion in which the attitude turns against the gyro or the
position moves against the velocity, as in a reversed recording, or in which the acceleration
opposes the tilt or does not depend on it, as with an attitude of another frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from sim_jax.constants import GRAVITY
from tuner.core.numerics import Array
from tuner.recordings.flight import Series
from tuner.recordings.interpolation import (
    body_rate_of,
    correlation,
    derivative,
    middle_clock,
    on_clock,
    rms,
    rotate,
    smooth,
    upward,
)
from tuner.recordings.missions import Mission
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import (
    ATTITUDE_READINGS,
    RawSeries,
    Reading,
    force_and_tilt,
    to_enu_flu,
)

DOUBTS = (
    NoteCode.ATTITUDE_DOUBTED,
    NoteCode.WEIGHT_NOT_FELT,
    NoteCode.BODY_RATE_DOUBTED,
    NoteCode.VELOCITY_DOUBTED,
    NoteCode.AXIS_DOUBTED,
    NoteCode.AXES_TURNED,
)
"""Notes on signals that no reading explains."""
MIN_ACCELERATION = 0.3
MIN_TURN_RATE = 0.1
MIN_SPEED = 0.2
"""Less motion, in m/s^2, rad/s and m/s, contradicts nothing."""
MAX_UNMATCHED_SPEED = 1.0
"""m/s. Position and velocity both show faster motion, or one of them is wrong."""
MAX_MARKER_OFFSET_M = 0.1
"""Markers may sit so far off the centre of mass: turning accelerates them without a tilt."""
MIN_AGREEMENT = 0.6
UPRIGHT_SHARE = 0.9
"""An attitude along which thrust carries a larger share of the weight is right."""
MIN_SCORE_GAIN = 0.3
"""A larger correlation is accepted as it is; an alternative must score better by so much."""
INVERSE = np.array([1.0, -1.0, -1.0, -1.0])
"""Turns a quaternion (w, x, y, z) into its inverse."""
READING_PENALTY = 0.05
"""Each further misreading must improve the score by more."""


_Judgement = tuple[Reading | None, Note | None]
"""The right reading of a signal, or a doubt."""


_DEGREES = np.pi / 180
_RATES = (
    Reading("in FRD axes", lambda w: to_enu_flu(w, "body_rate")),
    Reading("in degrees per second", lambda w: w * _DEGREES),
    Reading("in FRD axes and degrees", lambda w: to_enu_flu(w, "body_rate") * _DEGREES),
)
OPPOSED_CORRELATION = -0.5
"""Two signals that should agree are opposites below this."""
UNRELATED_CORRELATION = 0.2
"""Two signals are unrelated below this, whatever the sign."""
MAX_SIZE_RATIO = 3.0
"""Unrelated signals differ in size by at most this factor: the excess would be noise."""
MIN_AUTOCORRELATION = 0.5
"""Autocorrelation of an acceleration over one bin; noise of a position has less."""
MIN_MISSION_S = 5.0
"""A shorter mission is too short for a contradiction."""
CLEAR_ACCELERATION, CLEAR_TURN_RATE, CLEAR_SPEED = 1.0, 0.3, 0.3
"""Much motion: m/s^2, rad/s and m/s, root mean square."""


def correct_frames(
    series: Mapping[str, Series], topics: Mapping[str, str]
) -> tuple[dict[str, Series], tuple[Note, ...]]:
    """Return the series with misread attitude, body rate and velocity corrected.

    A multirotor accelerates along its thrust: the attitude must tilt towards the acceleration of
    the position and turn the accelerometer's reading upwards. The attitude's rate of change must be
    the body rate, the position's the velocity. A reading that fails is replaced by one that passes,
    with a warning; if none passes, a warning says so.
    """
    fixed = dict(series)
    notes: list[Note] = []
    if not {"position", "attitude"} <= set(series):
        return fixed, ()
    clock = middle_clock(series)
    if len(clock) < 200:
        return fixed, ()

    def apply(signal: str, reading: Reading | None, doubt: Note | None) -> None:
        topic = topics.get(signal, signal)
        if reading is not None:
            measured = fixed[signal]
            values = reading.read(measured.values)
            known = np.isfinite(values).all(axis=1)
            fixed[signal] = Series(measured.time[known], values[known])
            count, names = len(measured.time), (signal, reading.name)
            notes.append(Note(NoteCode.FRAME_TURNED, topic=topic, count=count, names=names))
        elif doubt is not None:
            notes.append(replace(doubt, topic=topic))

    apply("attitude", *_judge_attitude(fixed, clock))
    if "body_rate" in fixed:
        apply("body_rate", *_judge_rate(fixed, clock))
    if "velocity" in fixed:
        apply("velocity", *_judge_velocity(fixed, clock))
    for signal, of in _AXIS_CHECKS.items():
        if signal in fixed and not any(note.code in _GENERAL_DOUBTS[signal] for note in notes):
            notes += [replace(n, topic=topics.get(signal, signal)) for n in of(fixed, clock)]
    if {"rate_setpoint", "body_rate"} <= set(fixed):
        apply("rate_setpoint", _judge_setpoint(fixed, clock), None)
    return fixed, tuple(notes)


def _judge_attitude(series: Mapping[str, Series], clock: Array) -> _Judgement:
    q = on_clock(series, "attitude", clock)
    pull = _specific_force(series, clock)
    push = pull - np.array([0.0, 0.0, GRAVITY])
    gyro = on_clock(series, "body_rate", clock) if "body_rate" in series else None
    force = on_clock(series, "acceleration", clock) if "acceleration" in series else None
    turns = [smooth(rate) for rate in (body_rate_of(q), gyro) if rate is not None]
    of_markers = MAX_MARKER_OFFSET_M * min(
        np.nan_to_num(rate**2).sum(axis=1).mean() for rate in turns
    )

    def agreement(reading: Callable[[Array], Array]) -> tuple[float, float]:
        """Return the correlation with the motion, and the share of weight that thrust carries."""
        turned = reading(q)
        up = upward(turned)
        scores = []
        if rms(push[:, :2]) > MIN_ACCELERATION + of_markers:
            scores.append(correlation(smooth(up[:, :2], 0.2), push[:, :2]))
        if gyro is not None and rms(gyro) > MIN_TURN_RATE:
            # The gyro's own axes may be wrong too, though two errors are less likely than one.
            turning = smooth(body_rate_of(turned))
            in_flu = correlation(turning, smooth(gyro))
            in_frd = correlation(turning, smooth(_RATES[0].read(gyro)))
            scores.append(max(in_flu, in_frd - READING_PENALTY))
        if force is None:  # thrust points where the motion and gravity ask for it
            carried = (up * pull).sum(axis=1) / np.linalg.norm(pull, axis=1)
        else:
            carried = rotate(turned, force)[:, 2] / GRAVITY
        known = carried[np.isfinite(carried)]
        return min(scores, default=1.0), float(known.mean()) if len(known) else 1.0

    fit, upright = agreement(lambda values: values)
    if fit > MIN_AGREEMENT and upright > 0.5:
        return None, None
    worth = [
        _score(*agreement(r.read)) - READING_PENALTY * i for i, r in enumerate(ATTITUDE_READINGS)
    ]
    best = ATTITUDE_READINGS[int(np.argmax(worth))]
    best_fit, best_upright = agreement(best.read)
    better = _score(best_fit, best_upright) > _score(fit, upright) + MIN_SCORE_GAIN
    if better and best_fit > MIN_AGREEMENT and best_upright > 0.5:
        return best, None
    by_motion = (upward(q) * pull).sum(axis=1) / np.linalg.norm(pull, axis=1)
    if fit > MIN_AGREEMENT and np.nanmean(by_motion) > UPRIGHT_SHARE:
        return None, Note(NoteCode.WEIGHT_NOT_FELT, numbers={"share": upright})
    if fit < 0.2 or upright < 0.5:
        numbers = {"agreement": fit, "upright": upright}
        return None, Note(NoteCode.ATTITUDE_DOUBTED, numbers=numbers)
    return None, None


def _score(fit: float, upright: float) -> float:
    return fit + min(upright, 1.0)


def _body_rates(series: Mapping[str, Series], clock: Array) -> tuple[Array, Array]:
    """Return the attitude's rate of change and the gyro, (n, 3) rad/s each."""
    turning = body_rate_of(on_clock(series, "attitude", clock))
    return smooth(turning), smooth(on_clock(series, "body_rate", clock))


def _velocities(series: Mapping[str, Series], clock: Array) -> tuple[Array, Array]:
    """Return the position's rate of change and the velocity, (n, 3) m/s each."""
    moving = derivative(on_clock(series, "position", clock))
    return smooth(moving, 0.1), smooth(on_clock(series, "velocity", clock), 0.1)


def _residual_share(motion: Array, recorded: Array) -> float:
    """Return the share of a motion (n, 3) that is left after subtraction of the recorded one."""
    known = np.isfinite(motion).all(axis=1) & np.isfinite(recorded).all(axis=1)
    size = rms(motion[known])
    return rms((motion - recorded)[known]) / size if size > 0.0 else np.inf


def _judge_rate(series: Mapping[str, Series], clock: Array) -> _Judgement:
    turning, gyro = _body_rates(series, clock)
    if min(rms(turning), rms(gyro)) < MIN_TURN_RATE:
        return None, None
    here = _residual_share(turning, gyro)
    own = on_clock(series, "attitude", clock) * INVERSE
    measured = series["body_rate"]
    at_samples = on_clock(series, "attitude", measured.time) * INVERSE
    readings = {reading: reading.read(gyro) for reading in _RATES}
    if _angle_between(turning, gyro) == 0.0:  # a marker body of another heading looks alike
        in_world = Reading("in world axes", lambda _: rotate(at_samples, measured.values))
        readings[in_world] = smooth(rotate(own, on_clock(series, "body_rate", clock)))
    best = min(readings, key=lambda r: _residual_share(turning, readings[r]))
    there = _residual_share(turning, readings[best])
    alike = correlation(turning, readings[best])
    slope = alike * rms(readings[best]) / rms(turning)  # whatever the gyro's noise
    of_another_unit = there < here / 20 and alike > MIN_AGREEMENT and slope < MAX_SIZE_RATIO
    if (there < 0.7 and there < here / 2) or of_another_unit:
        return best, None
    doubt = Note(NoteCode.BODY_RATE_DOUBTED, numbers={"left": here})
    return None, doubt if here > 0.9 else None


MIN_SIZE_RATIO = {"body_rate": 0.93, "velocity": 0.8, "acceleration": 0.7}
"""The least ratio, or its inverse, of a measured signal to the pose's derivative: a gyro's scale is
known to a few percent, estimators smooth velocity, second derivatives are noisy."""
MIN_SIGN_CORRELATION, MIN_SIZE_CORRELATION = 0.7, 0.97
"""Above these the sign, and the size ratio, of two signals are certain."""
MIN_AXES_ANGLE_RAD, MIN_SINGULAR_VALUE_RATIO = 0.1, 0.05
"""Body axes may be turned by less, as markers were defined; and the second singular value must be
at least so large beside the first for a rotation to show."""


def _rate_doubts(series: Mapping[str, Series], clock: Array) -> Iterator[Note]:
    turning, gyro = _body_rates(series, clock)
    doubts = list(_axis_doubts(turning, gyro, ("body_rate", "attitude"), MIN_TURN_RATE))
    angle = _angle_between(turning, gyro)
    if all(note.numbers["times"] > 0 for note in doubts) and angle > MIN_AXES_ANGLE_RAD:
        numbers = {"degrees": float(np.degrees(angle))}
        doubts = [Note(NoteCode.AXES_TURNED, "warning", numbers=numbers)]
    yield from doubts


def _force_doubts(series: Mapping[str, Series], clock: Array) -> Iterator[Note]:
    """Yield the axes, of the world or else of the body, along which forces contradict the motion.

    A flipped height shows in world axes, a turned accelerometer in body axes.
    """
    q, pull = on_clock(series, "attitude", clock), _specific_force(series, clock)
    force = on_clock(series, "acceleration", clock)
    names = ("acceleration", "position")
    doubts = tuple(_axis_doubts(pull, _smooth_thrice(rotate(q, force)), names, MIN_ACCELERATION))
    if not doubts:
        own = rotate(q * INVERSE, pull)
        doubts = tuple(_axis_doubts(own, _smooth_thrice(force), names, MIN_ACCELERATION))
    yield from doubts


def _specific_force(series: Mapping[str, Series], clock: Array) -> Array:
    """Return the motion's specific force in world axes, (n, 3) m/s^2."""
    position = smooth(on_clock(series, "position", clock), 0.2)
    push = smooth(derivative(smooth(derivative(position), 0.2)), 0.2)
    return np.asarray(push + np.array([0.0, 0.0, GRAVITY]))


def _smooth_thrice(force: Array) -> Array:
    return smooth(smooth(smooth(force, 0.2), 0.2), 0.2)


def _axis_doubts(
    motion: Array, recorded: Array, names: tuple[str, str], least_motion: float
) -> Iterator[Note]:
    """Yield the axes along which a signal is the pose's derivative with another sign or size.

    Axes turned by less than `MIN_AXES_ANGLE_RAD` mix in a part of the other axes' motion.

    Parameters
    ----------
    motion, recorded
        (n, 3) each, which should agree.
    names
        The signal, and the one whose derivative it is.
    """
    known = np.isfinite(motion).all(axis=1) & np.isfinite(recorded).all(axis=1)
    least = MIN_SIZE_RATIO[names[0]]
    for axis, name in enumerate("xyz"):
        a, b = (values[known, axis : axis + 1] for values in (motion, recorded))
        if not known.any() or min(rms(a), rms(b)) < least_motion:
            continue
        alike, times = correlation(a, b), rms(b) / rms(a)
        mixed_in = MIN_AXES_ANGLE_RAD * rms(np.delete(motion[known], axis, axis=1))
        of_another_size = (
            alike > MIN_SIZE_CORRELATION
            and not least < times < 1.0 / least
            and abs(rms(b) ** 2 - rms(a) ** 2) > mixed_in**2
        )
        if alike < -MIN_SIGN_CORRELATION or of_another_size:
            numbers = {"times": float(np.copysign(times, alike))}
            signal, other = names
            yield Note(
                NoteCode.AXIS_DOUBTED, "warning", numbers=numbers, names=(signal, name, other)
            )


def _angle_between(motion: Array, recorded: Array) -> float:
    """Return the angle, in rad, between the axes of two signals; 0 where it is uncertain.

    The rotation is that of least squares (Kabsch 1976).
    """
    known = np.isfinite(motion).all(axis=1) & np.isfinite(recorded).all(axis=1)
    a, b = motion[known], recorded[known]
    if len(a) < 2 or min(rms(a), rms(b)) < CLEAR_TURN_RATE:
        return 0.0
    left, sizes, right = np.linalg.svd(b.T @ a)
    if sizes[1] < MIN_SINGULAR_VALUE_RATIO * sizes[0]:
        return 0.0
    turned = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    before, behind = _residual_share(a, b), _residual_share(a, b @ turned)
    if behind > 0.5 * before:
        return 0.0
    return float(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)))


_AXIS_CHECKS: Mapping[str, Callable[[Mapping[str, Series], Array], Iterable[Note]]] = {
    "body_rate": _rate_doubts,
    "velocity": lambda s, clock: _axis_doubts(
        *_velocities(s, clock), ("velocity", "position"), MIN_SPEED
    ),
    "acceleration": _force_doubts,
}
"""Derivative of the pose -> its doubts along single axes."""
_GENERAL_DOUBTS = {
    "body_rate": (NoteCode.ATTITUDE_DOUBTED, NoteCode.BODY_RATE_DOUBTED),
    "velocity": (NoteCode.VELOCITY_DOUBTED, NoteCode.UNIT_DOUBTED),
    "acceleration": (NoteCode.ATTITUDE_DOUBTED, NoteCode.WEIGHT_NOT_FELT, NoteCode.UNIT_DOUBTED),
}
"""Signal -> notes that cover its single axes too."""


def _judge_setpoint(series: Mapping[str, Series], clock: Array) -> Reading | None:
    """Return the right reading of rate set-points, which the body rate follows."""
    rate = smooth(on_clock(series, "body_rate", clock))
    wanted = smooth(on_clock(series, "rate_setpoint", clock))
    if min(rms(rate), rms(wanted)) < MIN_TURN_RATE:
        return None
    best = min(_RATES, key=lambda r: _residual_share(rate, r.read(wanted)))
    there, here = _residual_share(rate, best.read(wanted)), _residual_share(rate, wanted)
    return best if there < MIN_AGREEMENT and there < here / 3 else None


def _judge_velocity(series: Mapping[str, Series], clock: Array) -> _Judgement:
    moving, velocity = _velocities(series, clock)
    slower, faster = sorted((rms(moving), rms(velocity)))
    if slower < MIN_SPEED:
        doubt = Note(NoteCode.VELOCITY_DOUBTED, numbers={"agreement": 0.0})
        return None, doubt if faster > MAX_UNMATCHED_SPEED else None
    measured = series["velocity"]
    at_samples = on_clock(series, "attitude", measured.time)
    readings = {
        Reading("in body axes", lambda _: rotate(at_samples, measured.values)): rotate(
            on_clock(series, "attitude", clock), velocity
        ),
        Reading("in NED axes", lambda v: to_enu_flu(v, "velocity")): to_enu_flu(
            velocity, "velocity"
        ),
    }
    best = min(readings, key=lambda r: _residual_share(moving, readings[r]))
    there, here = _residual_share(moving, readings[best]), _residual_share(moving, velocity)
    if there < MIN_AGREEMENT and there < here / 2:
        return best, None
    fit = correlation(moving, velocity)
    doubt = Note(NoteCode.VELOCITY_DOUBTED, numbers={"agreement": fit})
    return None, doubt if fit < 0.8 else None


def contradiction(series: Mapping[str, Series], missions: Sequence[Mission]) -> Note | None:
    """Return which two signals certainly deny each other through the longest mission.

    Parameters
    ----------
    series
        Signal -> its samples, in the frames that `frames` finds best.
    """
    longest = max(missions, key=lambda m: m.end - m.start, default=None)
    if longest is None or longest.end - longest.start < MIN_MISSION_S:
        return None
    flown = {name: samples.between(longest.start, longest.end) for name, samples in series.items()}
    flown = {name: samples for name, samples in flown.items() if len(samples.time) > 1}
    for pair, opposed in _CONTRADICTION_CHECKS.items():
        if set(pair) <= set(flown) and {"position", "attitude"} <= set(flown):
            agreement = opposed(flown)
            if agreement is not None:
                return Note(NoteCode.CONTRADICTED, numbers={"agreement": agreement}, names=pair)
    return None


def contradiction_in(notes: Sequence[Note]) -> Note | None:
    """Return the contradiction that was noted when a recording was read."""
    return next((note for note in notes if note.code is NoteCode.CONTRADICTED), None)


def _opposition(derived: Array, recorded: Array, min_rms: float) -> float | None:
    """Return the correlation of two signals if they are opposites with much motion."""
    agreement = correlation(derived, recorded)
    return (
        agreement
        if agreement < OPPOSED_CORRELATION and min(rms(derived), rms(recorded)) > min_rms
        else None
    )


def _tilt_contradiction(series: Mapping[str, Series]) -> float | None:
    """Return the correlation of tilt and acceleration if one does not follow from the other."""
    position, attitude = (
        RawSeries(series[name].time, series[name].values) for name in ("position", "attitude")
    )
    force, tilt = force_and_tilt(position, attitude)
    agreement, force_rms, weight_rms = correlation(force, tilt), rms(force), GRAVITY * rms(tilt)
    if force_rms < CLEAR_ACCELERATION or weight_rms < CLEAR_ACCELERATION:
        return None
    if agreement < OPPOSED_CORRELATION:
        return agreement
    alike_in_size = 1 / MAX_SIZE_RATIO < force_rms / weight_rms < MAX_SIZE_RATIO
    moves = correlation(force[1:], force[:-1]) > MIN_AUTOCORRELATION
    return agreement if abs(agreement) < UNRELATED_CORRELATION and alike_in_size and moves else None


_CONTRADICTION_CHECKS: Mapping[tuple[str, str], Callable[[Mapping[str, Series]], float | None]] = {
    ("attitude", "body_rate"): lambda s: _opposition(
        *_body_rates(s, middle_clock(s)), CLEAR_TURN_RATE
    ),
    ("position", "velocity"): lambda s: _opposition(*_velocities(s, middle_clock(s)), CLEAR_SPEED),
    ("attitude", "position"): _tilt_contradiction,
}
"""A pair of signals -> their correlation if they contradict each other for certain, else None."""
