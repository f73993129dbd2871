"""Which time to believe: what a message says, or when it was recorded."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import pairwise

import numpy as np

from tuner.recordings.notes import Kind, Note, NoteCode
from tuner.recordings.recording import Nanoseconds, Samples

SECOND = 1_000_000_000
#: A stamp that leaves its neighbours by more than this, while its arrival does not, has jumped.
JUMP = SECOND // 10
#: Topics whose stamps differ by more than this from the others' are on a clock of their own.
APART = SECOND // 2


def believe(
    samples: Mapping[str, Samples],
    receive_only: Collection[str] = (),
    unhurried: Collection[str] = (),
) -> tuple[dict[str, Nanoseconds], tuple[Note, ...]]:
    """Return the times of every topic's messages, all on one clock.

    Header stamps are when something was measured; the time of recording is later by a varying
    delay. So stamps are used, once single wrong ones and jumps of a clock that was set while it
    ran are repaired by the times of recording. A topic stamped by a clock that is not the others'
    is moved onto theirs, as far as the times of recording show.

    Parameters
    ----------
    samples
        Topic -> messages.
    receive_only
        Topics whose stamps are not to be used.
    unhurried
        Topics for which the time of recording is as good as a stamp.
    """
    notes: list[Note] = []
    unset: list[str] = []
    times: dict[str, Nanoseconds] = {}
    offsets: dict[str, int] = {}
    for topic, of in samples.items():
        if of.stamp is None or topic in receive_only or not len(of.stamp):
            continue
        if _unset(of.stamp, of.receive):
            unset.append(topic)
            continue
        stamp, repaired = _repair(topic, of.stamp, of.receive)
        notes.extend(repaired)
        times[topic] = stamp
        offsets[topic] = int(np.median(stamp - of.receive))
    common = int(np.median(list(offsets.values()))) if offsets else 0
    for topic, offset in offsets.items():
        if abs(offset - common) > APART:
            times[topic] = times[topic] - (offset - common)
            off = {"seconds": (offset - common) / SECOND}
            count = len(times[topic])
            notes.append(Note(NoteCode.OTHER_CLOCK, topic=topic, count=count, numbers=off))
    for topic, of in samples.items():
        if topic not in times:
            # Where all stamps count from a start-up, arrivals are moved to count from there too.
            times[topic] = of.receive + (common if abs(common) > SECOND else 0)
            if topic in unset:
                notes.append(Note(NoteCode.STAMPS_UNSET, topic=topic, count=len(of.receive)))
            elif topic not in receive_only:
                kind: Kind = "info" if topic in unhurried else "warning"
                notes.append(Note(NoteCode.NO_HEADER, kind, topic, len(of.receive)))
    return times, tuple(notes)


def _unset(stamp: Nanoseconds, receive: Nanoseconds) -> bool:
    """Return whether stamps do not go on as their arrivals do."""
    passed = np.quantile(receive, 0.9) - np.quantile(receive, 0.1)
    went_on = np.quantile(stamp, 0.9) - np.quantile(stamp, 0.1)
    return bool(passed > SECOND and went_on < passed / 2)


def _repair(topic: str, stamp: Nanoseconds, receive: Nanoseconds) -> tuple[Nanoseconds, list[Note]]:
    """Undo jumps of a stamp that the time of recording did not make."""
    if len(stamp) < 3:
        return stamp, []
    step, arrival = np.diff(stamp), np.diff(receive)
    usual = int(np.median(step))
    extra = step - arrival
    # A recorder that stalls delays arrivals while stamps go on as usual: that is no jump.
    jumped = np.flatnonzero((np.abs(extra) > JUMP) & (np.abs(step - usual) > JUMP))
    if len(jumped) == 0:
        return stamp, []
    fixed = stamp.copy()
    notes = []
    wrong = 0
    steps = []
    i = 0
    while i < len(jumped):
        here = int(jumped[i])
        back = int(jumped[i + 1]) if i + 1 < len(jumped) else -1
        if back - here in (1, 2, 3) and abs(int(extra[here] + extra[back])) < JUMP:
            rows = np.arange(here + 1, back + 1)
            fixed[rows] = receive[rows] + (stamp[here] - receive[here])
            wrong += len(rows)
            i += 2
        elif here == 0 or here == len(step) - 1:
            row = 0 if here == 0 else len(stamp) - 1
            near = 1 if here == 0 else len(stamp) - 2
            fixed[row] = receive[row] + (stamp[near] - receive[near])
            wrong += 1
            i += 1
        else:
            steps.append(here)
            i += 1
    if wrong:
        notes.append(Note(NoteCode.STAMPS_REPLACED, topic=topic, count=wrong))
    if steps:
        bounds = [0, *(at + 1 for at in steps), len(stamp)]
        parts = list(pairwise(bounds))
        level = [int(np.median(fixed[a:b] - receive[a:b])) for a, b in parts]
        longest = max(range(len(parts)), key=lambda k: parts[k][1] - parts[k][0])
        for (a, b), offset in zip(parts, level, strict=True):
            fixed[a:b] -= offset - level[longest]
        largest = max(abs(offset - level[longest]) for offset in level) / SECOND
        jump = {"seconds": largest}
        notes.append(Note(NoteCode.CLOCK_JUMPED, topic=topic, count=len(steps), numbers=jump))
    return fixed, notes
