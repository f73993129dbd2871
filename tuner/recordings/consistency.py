"""Checks of recorded signals against each other, and corrections of their frames, signs and sizes.

A recorded signal must be the change of another: body rate of the attitude, velocity and
acceleration of the position, and body rate follows its set-point. Where one is not, the other
readings of `READINGS` are tried: axes, signs and units that loggers are known to confuse. A reading
is believed if it leaves less than half of the residual, and little of the motion; there must be
enough motion. Without one, the signal is doubted, as a whole or along single axes. A doubted
recording may still be fitted: wind or a poor gyro explain a doubt. A contradiction may not. It
takes a whole mission with much motion in which the attitude turns against the gyro or the position
moves against the velocity, as in a reversed recording, or in which the acceleration opposes the
tilt or does not depend on it, as with an attitude of another frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sim_jax.constants import GRAVITY
from tuner.core.numerics import Array
from tuner.recordings.clocks import lag_between
from tuner.recordings.flight import Series
from tuner.recordings.interpolation import (
    body_rate_of,
    both_known,
    correlation,
    derivative,
    middle_clock,
    resample,
    rms,
    rotate,
    runs,
    smooth,
    upward,
)
from tuner.recordings.missions import Mission
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import (
    IN_WORLD_AXES,
    INVERSE,
    READINGS,
    SCALAR_FIRST,
    SignalReading,
    force_and_tilt,
    to_enu_flu,
    turned_about_z,
)

DOUBTS = (
    NoteCode.ATTITUDE_DOUBTED,
    NoteCode.WEIGHT_NOT_FELT,
    NoteCode.BODY_RATE_DOUBTED,
    NoteCode.VELOCITY_DOUBTED,
    NoteCode.AXIS_DOUBTED,
    NoteCode.AXES_TURNED,
    NoteCode.SIGNAL_LATE,
    NoteCode.CLOCK_DOUBTED,
)
"""Notes on signals that no reading explains."""
MIN_ACCELERATION = 0.3
"""m/s^2. A smaller acceleration contradicts nothing."""
MAX_MARKER_OFFSET_M = 0.1
"""Markers may sit so far off the centre of mass: turning accelerates them without a tilt."""
MIN_AGREEMENT = 0.6
UPRIGHT_SHARE = 0.9
"""An attitude along which thrust carries a larger share of the weight is right."""
MIN_SCORE_GAIN = 0.3
"""A larger correlation is accepted as it is; an alternative must score better by so much."""
READING_PENALTY = 0.05
"""Each further misreading must improve the score by more."""
MAX_BELIEVED_SHARE = 0.7
"""The largest residual, as a share of the motion, of a reading that is believed."""
MAX_DOUBTED_AGREEMENT, MIN_CLEAR_GAIN = 0.8, 0.1
"""A signal with a larger correlation is not doubted as a whole; of signals that hardly move, a
reading with a larger one is believed, if that is larger by so much."""
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
MIN_SIGN_CORRELATION, MIN_SIZE_CORRELATION = 0.7, 0.97
"""Above these the sign, and the size ratio, of two signals are certain."""
MIN_AXES_ANGLE_RAD, MIN_SINGULAR_VALUE_RATIO = 0.1, 0.05
"""Body axes may be turned by less, as markers were defined; and the second singular value must be
at least so large beside the first for a rotation to show."""
MIN_YAW_AGREEMENT = 0.2
"""Markers that are turned about z show the same yaw."""

MAX_LAG_S = 0.08
"""An estimator's velocity is late by less against the position."""
MAX_CLOCK_DIFFERENCE = 0.05
"""Ratios of two signals to the changes of others are of one clock if they differ by less."""
MIN_SATURATED_RUN, MIN_SATURATED = 3, 12
"""Samples in a row, and in all, at the limit of a gyro that saturates."""

FlownSignals = Mapping[str, Array]
"""Signal -> (n, k) on one clock; NaN where unknown."""


def _turning(flown: FlownSignals) -> tuple[Array, Array]:
    """Return the change of the attitude over two steps, and the rate's mean over both.

    By Simpson's rule: rotors at their limits may shake a vehicle at 15 Hz.
    """
    rate = np.array(flown["body_rate"])
    rate[1:-1] = (rate[:-2] + 4.0 * rate[1:-1] + rate[2:]) / 6.0
    return smooth(body_rate_of(flown["attitude"]), 0.1), smooth(rate, 0.1)


def _specific_force(flown: FlownSignals) -> Array:
    """Return the motion's specific force in world axes, (n, 3) m/s^2."""
    push = smooth(derivative(smooth(derivative(smooth(flown["position"], 0.2)), 0.2)), 0.2)
    return np.asarray(push + np.array([0.0, 0.0, GRAVITY]))


def _smooth_thrice(force: Array) -> Array:
    return smooth(smooth(smooth(force, 0.2), 0.2), 0.2)


def _body_forces(flown: FlownSignals) -> tuple[Array, Array]:
    own = rotate(flown["attitude"] * INVERSE, _specific_force(flown))
    return own, _smooth_thrice(flown["acceleration"])


def _world_forces(flown: FlownSignals) -> tuple[Array, Array]:
    felt = rotate(flown["attitude"], flown["acceleration"])
    return _specific_force(flown), _smooth_thrice(felt)


@dataclass(frozen=True)
class SignalPair:
    """A signal, and the one whose change it must be.

    Attributes
    ----------
    other
        The signal whose change it is.
    compared
        Functions that return the change and the signal, (n, 3) each, in axes in which they must
        agree; readings are compared by the last.
    min_motion
        The least root mean square of both, in the signal's unit, that shows anything.
    min_size
        The least ratio, or its inverse, of the signal to the change: a gyro's scale is known to a
        few percent, estimators smooth velocity, second derivatives are noisy.
    max_share
        A signal that agrees little, and leaves a larger share of the change, is doubted,
    doubt
        with this code.
    max_unmatched
        A larger signal is doubted also where the other hardly changes.
    """

    other: str
    compared: Sequence[Callable[[FlownSignals], tuple[Array, Array]]]
    min_motion: float
    min_size: float = 0.0
    max_share: float = np.inf
    doubt: NoteCode = NoteCode.AXIS_DOUBTED
    max_unmatched: float = np.inf


PAIRS: Mapping[str, SignalPair] = {
    "body_rate": SignalPair(
        "attitude",
        [_turning],
        min_motion=0.1,
        min_size=0.93,
        max_share=0.9,
        doubt=NoteCode.BODY_RATE_DOUBTED,
    ),
    "velocity": SignalPair(
        "position",
        [lambda s: (smooth(derivative(s["position"]), 0.1), smooth(s["velocity"], 0.1))],
        min_motion=0.2,
        min_size=0.8,
        max_share=0.6,
        doubt=NoteCode.VELOCITY_DOUBTED,
        max_unmatched=1.0,
    ),
    # a flipped height shows in world axes, a turned accelerometer in body axes
    "acceleration": SignalPair("position", [_world_forces, _body_forces], MIN_ACCELERATION, 0.7),
    "rate_setpoint": SignalPair(
        "body_rate", [lambda s: (smooth(s["body_rate"]), smooth(s["rate_setpoint"]))], 0.1
    ),
}
"""Signal -> what it must agree with."""
_COVERED: Mapping[str, set[NoteCode]] = {
    "body_rate": {NoteCode.ATTITUDE_DOUBTED},
    "velocity": set(),
    "acceleration": {NoteCode.ATTITUDE_DOUBTED, NoteCode.WEIGHT_NOT_FELT},
}
"""Signal whose single axes are compared -> notes on the attitude that cover them too."""


def correct_frames(
    series: Mapping[str, Series], topics: Mapping[str, str]
) -> tuple[dict[str, Series], tuple[Note, ...]]:
    """Return the series with misread signals corrected, and notes on those and on doubts.

    A multirotor accelerates along its thrust: the attitude must tilt towards the acceleration of
    the position and turn the accelerometer's reading upwards. The others must agree as `PAIRS` say.
    """
    fixed, notes = dict(series), list[Note]()
    clock = middle_clock(series) if {"position", "attitude"} <= set(series) else np.empty(0)
    if len(clock) < 200:
        return fixed, ()
    flown = {
        n: resample(n, series[n], clock) for n in ("position", "attitude", *PAIRS) if n in series
    }
    for signal in ("attitude", *PAIRS):
        if signal not in flown or (signal == "rate_setpoint" and "body_rate" not in flown):
            continue
        topic = topics.get(signal, signal)
        judge = _judge_attitude if signal == "attitude" else _judge
        reading, doubts = judge(signal, flown)
        if reading is not None:
            measured = series[signal]
            values = reading.read(
                measured.values, resample("attitude", fixed["attitude"], measured.time)
            )
            fixed[signal] = replace(measured, values=values).complete()
            flown[signal] = resample(signal, fixed[signal], clock)
            notes.append(
                NoteCode.FRAME_TURNED.note(
                    signal, reading.name, topic=topic, count=len(measured.time)
                )
            )
        covering = _COVERED.get(signal)
        if covering is not None and not doubts and not covering & {note.code for note in notes}:
            doubts = _single_axis_doubts(signal, flown)
        notes += [replace(doubt, topic=topic) for doubt in doubts]
    if "body_rate" in fixed:
        notes += _saturation(fixed["body_rate"], topics.get("body_rate", ""))
    return fixed, tuple(_with_clock_doubted(notes))


def _with_clock_doubted(notes: Sequence[Note]) -> Sequence[Note]:
    """Return notes with one on the clock in place of doubts on the sizes of two signals."""
    times = {
        signal: float(np.median(found))
        for signal in ("body_rate", "velocity")
        if (found := [n.numbers["times"] for n in notes if _is_axis_doubt(n, signal)])
    }
    turned, moved = times.get("body_rate", 0.0), times.get("velocity", np.inf)
    if not 0.0 < abs(turned - moved) <= MAX_CLOCK_DIFFERENCE * turned:
        return notes
    others = [note for note in notes if note.code is not NoteCode.AXIS_DOUBTED]
    return [*others, NoteCode.CLOCK_DOUBTED.note(*times, times=turned)]


def _is_axis_doubt(note: Note, signal: str) -> bool:
    return note.code is NoteCode.AXIS_DOUBTED and note.names[0] == signal


def _saturation(gyro: Series, topic: str) -> list[Note]:
    """Return a note on a gyro that stays at one largest rate, both to the left and to the right."""
    limit = float(np.abs(gyro.values).max(initial=0.0))
    stays = [
        (first, behind, column)
        for column, values in enumerate(gyro.values.T)
        for sign in (1.0, -1.0)
        for first, behind in runs(sign * values >= (1.0 - 1e-6) * limit)
        if behind - first >= MIN_SATURATED_RUN
    ]
    signs = {float(np.sign(gyro.values[first, column])) for first, _, column in stays}
    count = sum(behind - first for first, behind, _ in stays)
    if limit < CLEAR_TURN_RATE or len(signs) < 2 or count < MIN_SATURATED:
        return []
    return [NoteCode.GYRO_SATURATED.note(topic=topic, count=count, limit=limit)]


def _judge(signal: str, flown: FlownSignals) -> tuple[SignalReading | None, Sequence[Note]]:
    """Return the right reading of a signal of `PAIRS`, or a doubt."""
    pair = PAIRS[signal]
    change, recorded = pair.compared[-1](flown)
    size = rms(change)
    slower, faster = sorted((size, rms(recorded)))
    moves = slower >= pair.min_motion
    if not moves:
        ups = np.nansum([change[:, 2], recorded[:, 2]], axis=1)
        if signal == "acceleration" and ups[0] * ups[1] < 0.0:  # the weight alone tells the axes
            return READINGS[signal][0], []
    left, agreement = _residual_share(change, recorded), correlation(change, recorded)
    tried = {
        reading: pair.compared[-1](
            {**flown, signal: reading.read(flown[signal], flown["attitude"])}
        )[1]
        for reading in READINGS[signal]
        # a marker body of another heading looks alike
        if reading is not IN_WORLD_AXES or not _angle_of(_rotation_between(change, recorded, 0.0))
    }
    alike = {reading: correlation(change, values) for reading, values in tried.items()}
    shares = {
        reading: _residual_share(change, values)
        for reading, values in tried.items()
        # noise favours small units: the slope tells sizes apart whatever the noise
        if size < MAX_SIZE_RATIO * alike[reading] * rms(values) < MAX_SIZE_RATIO**2 * size
    }
    best = min(shares, key=lambda reading: shares[reading], default=None)
    if best is not None:
        of_another_unit = shares[best] < left / 20 and alike[best] > MIN_AGREEMENT
        clear = alike[best] > max(MAX_DOUBTED_AGREEMENT, agreement + MIN_CLEAR_GAIN)
        halved = shares[best] < min(MAX_BELIEVED_SHARE, left / 2) or of_another_unit
        if halved if moves else clear:
            return best, []
    if not moves:
        unmatched = pair.doubt.note(left=1.0, agreement=0.0)
        return None, [unmatched] if faster > pair.max_unmatched else []
    doubt = pair.doubt.note(left=left, agreement=agreement)
    alike_in_size = faster < MAX_SIZE_RATIO * slower
    believed = left <= pair.max_share or (agreement >= MAX_DOUBTED_AGREEMENT and alike_in_size)
    return None, [] if believed else [doubt]


def _residual_share(change: Array, recorded: Array) -> float:
    """Return the share of a change (n, 3) that is left after subtraction of the recorded one."""
    change, recorded = both_known(change, recorded)
    size = rms(change)
    return rms(change - recorded) / size if size > 0.0 else np.inf


def _judge_attitude(_: str, flown: FlownSignals) -> tuple[SignalReading | None, Sequence[Note]]:
    """Return the right reading of the attitude, or a doubt on it or on the felt weight."""
    q, pull = flown["attitude"], _specific_force(flown)
    push = pull - np.array([0.0, 0.0, GRAVITY])
    gyro, force = flown.get("body_rate"), flown.get("acceleration")
    heading = 0.0 if gyro is None else _heading_of_markers(flown)
    if heading:
        name = f"of markers turned left by {np.degrees(heading) % 360:.0f} degrees"
        return SignalReading(name, lambda q, _: turned_about_z(q, -heading)), []
    turns = [smooth(rate) for rate in (body_rate_of(q), gyro) if rate is not None]
    of_markers = MAX_MARKER_OFFSET_M * min(
        np.nan_to_num(rate**2).sum(axis=1).mean() for rate in turns
    )

    def carried(up: Array) -> float:
        """Return the share of weight that is carried along (n, 3) forces."""
        known = up[np.isfinite(up)]
        return float(known.mean()) if len(known) else 1.0

    def agreement(turned: Array) -> tuple[float, float]:
        """Return the correlation with the motion, and the share of weight that thrust carries."""
        up = upward(turned)
        scores = []
        if rms(push[:, :2]) > MIN_ACCELERATION + of_markers:
            scores.append(correlation(smooth(up[:, :2], 0.2), push[:, :2]))
        # The axes of the IMU may be wrong too, though two errors are less likely than one.
        if gyro is not None and rms(gyro) > PAIRS["body_rate"].min_motion:
            frd = READINGS["body_rate"][0].read(gyro, turned)
            in_flu, in_frd = (
                correlation(*_turning({"attitude": turned, "body_rate": rate}))
                for rate in (gyro, frd)
            )
            scores.append(max(in_flu, in_frd - READING_PENALTY))
        if force is None:  # thrust points where the motion and gravity ask for it
            upright = carried((up * pull).sum(axis=1) / np.linalg.norm(pull, axis=1))
        else:
            in_frd = carried(rotate(turned, to_enu_flu(force, "acceleration"))[:, 2] / GRAVITY)
            in_flu = carried(rotate(turned, force)[:, 2] / GRAVITY)
            upright = max(in_flu, in_frd - READING_PENALTY)
        return min(scores, default=1.0), upright

    fit, upright = agreement(q)
    if fit > MIN_AGREEMENT and upright > 0.5:
        return None, []
    readings = [*READINGS["attitude"], *([] if gyro is None else [SCALAR_FIRST])]
    found = [agreement(reading.read(q, q)) for reading in readings]
    worth = [_score(*each) - READING_PENALTY * i for i, each in enumerate(found)]
    best = int(np.argmax(worth))
    better = _score(*found[best]) > _score(fit, upright) + MIN_SCORE_GAIN
    if better and found[best][0] > MIN_AGREEMENT and found[best][1] > 0.5:
        return readings[best], []
    by_motion = (upward(q) * pull).sum(axis=1) / np.linalg.norm(pull, axis=1)
    if fit > MIN_AGREEMENT and np.nanmean(by_motion) > UPRIGHT_SHARE:
        return None, [NoteCode.WEIGHT_NOT_FELT.note(share=upright)]
    doubt = NoteCode.ATTITUDE_DOUBTED.note(agreement=fit, upright=upright)
    return None, [doubt] if fit < 0.2 or upright < 0.5 else []


def _score(fit: float, upright: float) -> float:
    return fit + min(upright, 1.0)


def _single_axis_doubts(signal: str, flown: FlownSignals) -> list[Note]:
    """Return doubts on single axes of a signal of `PAIRS`, or on the direction of all."""
    pair, doubts = PAIRS[signal], list[Note]()
    for compared in pair.compared:
        change, recorded = compared(flown)
        if signal == "velocity" and min(rms(change), rms(recorded)) > pair.min_motion:
            late = lag_between(change, recorded) or 0.0
            if abs(late) > MAX_LAG_S:
                return [NoteCode.SIGNAL_LATE.note(signal, pair.other, seconds=late)]
        doubts = doubts or list(_axis_doubts(change, recorded, (signal, pair.other)))
    turned = _rotation_between(change, recorded) if signal == "body_rate" else np.eye(3)
    angle = _angle_of(turned)
    if angle > MIN_AXES_ANGLE_RAD and all(note.numbers["times"] > 0 for note in doubts):
        return [NoteCode.AXES_TURNED.note(degrees=float(np.degrees(angle)))]
    return doubts


def _axis_doubts(motion: Array, recorded: Array, names: tuple[str, str]) -> Iterator[Note]:
    """Yield the axes along which a signal is the pose's derivative with another sign or size.

    Axes turned by less than `MIN_AXES_ANGLE_RAD` mix in a part of the other axes' motion.

    Parameters
    ----------
    motion, recorded
        (n, 3) each, which should agree.
    names
        The signal, and the one whose derivative it is.
    """
    (motion, recorded), pair = both_known(motion, recorded), PAIRS[names[0]]
    for axis, name in enumerate("xyz"):
        a, b = (values[:, axis : axis + 1] for values in (motion, recorded))
        if not len(motion) or min(rms(a), rms(b)) < pair.min_motion:
            continue
        alike, times = correlation(a, b), rms(b) / rms(a)
        mixed_in = MIN_AXES_ANGLE_RAD * rms(np.delete(motion, axis, axis=1))
        of_another_size = (
            alike > MIN_SIZE_CORRELATION
            and not pair.min_size < times < 1.0 / pair.min_size
            and abs(rms(b) ** 2 - rms(a) ** 2) > mixed_in**2
        )
        if alike < -MIN_SIGN_CORRELATION or of_another_size:
            ratio = float(np.copysign(times, alike))
            yield NoteCode.AXIS_DOUBTED.note(names[0], name, names[1], times=ratio)


def _rotation_between(
    motion: Array, recorded: Array, min_ratio: float = MIN_SINGULAR_VALUE_RATIO
) -> Array:
    """Return the rotation (3, 3) from one signal's axes to another's; identity if uncertain.

    It is that of least squares (Kabsch 1976), and halves the residual or, in noise, makes the
    signals agree.
    """
    a, b = both_known(motion, recorded)
    if len(a) < 2 or min(rms(a), rms(b)) < PAIRS["body_rate"].min_motion:
        return np.eye(3)
    left, sizes, right = np.linalg.svd(b.T @ a)
    turned = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    certain = sizes[1] >= min_ratio * sizes[0]
    halved = _residual_share(a, b @ turned) <= 0.5 * _residual_share(a, b)
    agree = correlation(a, b @ turned) > max(MIN_AGREEMENT, correlation(a, b) + MIN_SCORE_GAIN)
    return np.asarray(turned) if certain and (halved or agree) else np.eye(3)


def _angle_of(rotation: Array) -> float:
    return float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))


def _heading_of_markers(flown: FlownSignals) -> float:
    """Return by how much, in rad, the attitude's body axes are turned left of the gyro's about z.

    0 where that is little or uncertain, or the axis is another. Near a multiple of 90 degrees it is
    that: so markers are set up.
    """
    turning, rate = _turning(flown)
    turned = _rotation_between(turning, rate)
    if _angle_of(turned) < MIN_AXES_ANGLE_RAD or turned[2, 2] < np.cos(2 * MIN_AXES_ANGLE_RAD):
        return 0.0
    heading = float(np.arctan2(turned[1, 0], turned[0, 0]))
    if abs(heading) > 0.75 * np.pi and correlation(turning[:, 2:], rate[:, 2:]) < MIN_YAW_AGREEMENT:
        return 0.0  # as in a recording that runs backwards
    quarter = 0.5 * np.pi * round(heading / (0.5 * np.pi))
    return quarter if abs(heading - quarter) < MIN_AXES_ANGLE_RAD else heading


_OPPOSED = (("attitude", "body_rate", CLEAR_TURN_RATE), ("position", "velocity", CLEAR_SPEED))
"""Pairs of signals that contradict each other with so much motion."""


def contradiction(series: Mapping[str, Series], missions: Sequence[Mission]) -> Note | None:
    """Return which two signals certainly deny each other through the longest mission.

    Parameters
    ----------
    series
        Signal -> its samples, as `correct_frames` reads them.
    """
    longest = max(missions, key=lambda m: m.end - m.start, default=None)
    if longest is None or longest.end - longest.start < MIN_MISSION_S:
        return None
    parts = {name: samples.between(longest.start, longest.end) for name, samples in series.items()}
    parts = {name: samples for name, samples in parts.items() if len(samples.time) > 1}
    if not {"position", "attitude"} <= set(parts):
        return None

    flown = {name: resample(name, of, middle_clock(parts)) for name, of in parts.items()}
    for other, signal, clear in _OPPOSED:
        if signal in flown:
            change, recorded = PAIRS[signal].compared[-1](flown)
            agreement = correlation(change, recorded)
            if agreement < OPPOSED_CORRELATION and min(rms(change), rms(recorded)) > clear:
                return NoteCode.CONTRADICTED.note(other, signal, agreement=agreement)
    denied = _tilt_contradiction(parts)
    if denied is None:
        return None
    return NoteCode.CONTRADICTED.note("attitude", "position", agreement=denied)


def contradiction_in(notes: Sequence[Note]) -> Note | None:
    """Return the contradiction that was noted when a recording was read."""
    return next((note for note in notes if note.code is NoteCode.CONTRADICTED), None)


def _tilt_contradiction(series: Mapping[str, Series]) -> float | None:
    """Return the correlation of tilt and acceleration if one does not follow from the other."""
    force, tilt = force_and_tilt(series["position"], series["attitude"])
    agreement, force_rms, weight_rms = correlation(force, tilt), rms(force), GRAVITY * rms(tilt)
    if force_rms < CLEAR_ACCELERATION or weight_rms < CLEAR_ACCELERATION:
        return None
    if agreement < OPPOSED_CORRELATION:
        return agreement
    alike_in_size = 1 / MAX_SIZE_RATIO < force_rms / weight_rms < MAX_SIZE_RATIO
    moves = correlation(force[1:], force[:-1]) > MIN_AUTOCORRELATION
    return agreement if abs(agreement) < UNRELATED_CORRELATION and alike_in_size and moves else None
