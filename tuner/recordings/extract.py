"""Recorded fields into signals: their stamps, their unit and their axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tuner.recordings.flight import SIGNALS, Array
from tuner.recordings.formats import is_tabular
from tuner.recordings.locate import Place
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.ranges import NAMES, unit_by_range, unit_of_angles
from tuner.recordings.recording import Clock, Contents, Nanoseconds, Recording, Request, Samples
from tuner.recordings.stamps import believe
from tuner.recordings.units import ATTITUDES, quaternion_of, to_enu_flu, to_si
from tuner.recordings.yardstick import Stamped

#: Signals for which the time of recording is as good as a stamp.
UNHURRIED = {"lap", "battery_voltage"}


@dataclass(frozen=True)
class Raw:
    """One signal as recorded, in SI units and the axes of a `Flight`.

    Attributes
    ----------
    topic
        Where it comes from.
    time
        (n,) ns; in the order of the file, with its defects.
    values
        (n, k) in the columns of `SIGNALS`; NaN where not measured.
    """

    topic: str
    time: Nanoseconds
    values: Array


def extract(
    recording: Recording, places: Mapping[str, Place], clocks: tuple[Clock, ...] = ()
) -> tuple[dict[str, Raw], Contents, tuple[Note, ...]]:
    """Read every located signal.

    Returns
    -------
    tuple
        Signal -> its raw values, the messages they come from, and what was noticed.
    """
    wanted: dict[str, list[str]] = {}
    for place in places.values():
        fields = wanted.setdefault(place.topic, [])
        extra = [place.source.rotor] if place.source.rotor else []
        fields.extend(name for name in (*place.fields, *extra) if name not in fields)
    contents = recording.read(
        {topic: Request(tuple(names), clocks) for topic, names in wanted.items()}
    )
    receive_only = {p.topic for p in places.values() if p.source.stamp == "receive"}
    kinds = {t: {s for s, place in places.items() if place.topic == t} for t in wanted}
    unhurried = {topic for topic, held in kinds.items() if held <= UNHURRIED}
    times, notes = believe(contents.samples, receive_only, unhurried)
    signals: dict[str, Raw] = {}
    told: list[Note] = []
    for signal in sorted(places, key=lambda name: name in ATTITUDES):  # which positions may tell
        place = places[signal]
        samples = contents.samples.get(place.topic)
        if samples is None or not len(samples.receive):
            continue
        time, values = times[place.topic], _columns(samples, signal, place)
        raw = Raw(place.topic, time, values)
        unit = _unit(recording, signal, place, raw, signals.get("position"))
        if unit != place.unit:
            count, names = len(time), (signal, NAMES[unit])
            told.append(Note(NoteCode.UNIT_READ, "warning", place.topic, count, names=names))
        values = _values(samples, signal, place, to_si(values, unit))
        if is_tabular(recording.format):  # a row without the signal is no sample of it
            there = np.isfinite(values).any(axis=1)
            time, values = time[there], values[there]
        if len(time):
            signals[signal] = Raw(place.topic, time, values)
    ordered = {signal: signals[signal] for signal in places if signal in signals}
    return ordered, contents, (*notes, *told)


def _columns(samples: Samples, signal: str, place: Place) -> Array:
    """Return (n, k) numbers as recorded, in the order of the signal's columns."""
    fields: Sequence[str] = place.fields
    if place.source.quaternion == "xyzw" and signal in ATTITUDES:
        fields = (fields[3], *fields[:3])
    return np.column_stack([samples.fields[name] for name in fields])


def _unit(
    recording: Recording, signal: str, place: Place, recorded: Raw, position: Raw | None
) -> str:
    """Return the unit of recorded numbers: the map's, or else the one in which they make sense."""
    if place.source.unit is not None:
        return place.unit
    if signal not in ATTITUDES or place.source.quaternion != "rpy":
        return unit_by_range(signal, recorded.values, place.unit)
    epoch = int(recorded.time[0])

    def stamped(raw: Raw) -> Stamped:
        return Stamped(np.asarray((raw.time - epoch) * 1e-9, dtype=np.float64), raw.values)

    where = None if position is None else stamped(position)
    return unit_of_angles(recording.path, stamped(recorded), where, must=signal == "attitude")


def _values(samples: Samples, signal: str, place: Place, values: Array) -> Array:
    """Return (n, k) values in the columns and axes of a `Flight`."""
    columns, _, _ = SIGNALS[signal]
    if place.source.quaternion == "rpy" and signal in ATTITUDES:
        values = quaternion_of(values)
    if place.source.rotor is not None:
        rotor = samples.fields[place.source.rotor]
        spread = np.full((len(values), columns), np.nan)
        for column in range(columns):
            of_this = rotor == column
            spread[of_this, column] = values[of_this, 0]
        return spread
    if place.frame == "ned_frd":
        values = to_enu_flu(values, signal)
    return np.asarray(values, dtype=np.float64)
