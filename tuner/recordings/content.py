"""The content of a recording: its signals, cleaned and on one clock, and its missions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tuner.core.errors import ConfigError, RecordingError
from tuner.core.numerics import Array
from tuner.recordings.cache import sidecar_path
from tuner.recordings.clocks import align_pose, message_times
from tuner.recordings.consistency import DOUBTS, contradiction, correct_frames
from tuner.recordings.defects import clean, is_position_frozen, without_stale_end
from tuner.recordings.flight import SIGNALS, RawSeries, Series
from tuner.recordings.formats import is_tabular, open_recording
from tuner.recordings.missions import Mission, find_missions, split_into_manoeuvres
from tuner.recordings.notes import Damage, Note, NoteCode
from tuner.recordings.recording import Clock, Nanoseconds, ReadResult, Recording, TopicSamples
from tuner.recordings.sources import (
    Place,
    choose_map,
    locate,
    pose_error,
    unread_columns,
    with_columns_by_name,
)
from tuner.recordings.topics import (
    Sidecar,
    TopicMap,
    load_topic_map,
    read_sidecar,
    shipped_maps,
)
from tuner.recordings.unit_detection import (
    MIN_SAMPLES,
    UNITS,
    quaternion_of,
    quicker,
    scales_of,
    to_enu_flu,
    to_si,
    unit_by_range,
    unit_of,
    unit_of_angles,
    units_of_references,
)
from tuner.vehicle.motor_orders import (
    columns_of,
    motor_order_of,
    order_in_words,
    rotor_count_of,
)

PX4_REFERENCES = ("trajectory_setpoint", "vehicle_local_position_setpoint")
"""References of PX4's own position control."""
DRIVING_SIGNALS = (
    "command",
    "rotor_speed",
    "thrust_setpoint",
    "commanded_thrust",
    "reference_position",
)
"""A simulation needs one of these beside a pose."""
PER_MOTOR = ("command", "rotor_speed")
"""Signals with one column per motor."""
SLOW_SIGNALS = {"lap", "battery_voltage"}
"""Signals that change so slowly that their arrival serves as well as a stamp."""


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading a recording, from the user and its side-car.

    Attributes
    ----------
    topic_map
        The topic map of the user, else of the side-car; None takes the shipped map that finds most
        signals.
    namespace
        Prefix of the recorded topics that the map does not have, as ``uav1``.
    rate
        Hz of the uniform clock.
    """

    path: Path
    topic_map: TopicMap | None = None
    sidecar: Sidecar = field(default_factory=Sidecar)
    namespace: str = ""
    rate: float = 100.0

    @classmethod
    def of(
        cls,
        path: Path,
        topics: str | Path | TopicMap | None = None,
        namespace: str = "",
        rate: float = 100.0,
    ) -> ReadOptions:
        """Return the options of a recording.

        Parameters
        ----------
        topics
            Topic map, its file, or the name of a shipped one; None takes the side-car's, if any.

        Raises
        ------
        ConfigError
            The topic map, the side-car or the rate is wrong.
        """
        if not 1.0 <= rate <= 10_000.0:
            raise ConfigError("rate", f"is {rate:g} Hz", "give 1 to 10000 Hz")
        sidecar = read_sidecar(path)
        if topics is None and sidecar.topics is not None:
            topics = load_topic_map(sidecar.topics, base=sidecar_path(path).parent)
        elif isinstance(topics, str | Path):
            topics = load_topic_map(topics)
        return cls(path, topics, sidecar, namespace or sidecar.namespace, rate)


@dataclass(frozen=True)
class RecordedSignals:
    """The cleaned signals of a recording, with or without a pose.

    Attributes
    ----------
    places
        Signal -> its source.
    samples
        Topic -> its messages as recorded.
    topics
        Signal -> topic.
    series
        Signal -> cleaned samples, in seconds since the first pose, or the first sample without one.
    damage
        What the file has lost, with times as in ``series``.
    no_pose
        Why they hold no pose; None if they do.
    """

    recording: Recording
    topic_map: TopicMap
    places: Mapping[str, Place]
    samples: Mapping[str, TopicSamples]
    topics: Mapping[str, str]
    series: Mapping[str, Series]
    notes: tuple[Note, ...]
    damage: tuple[Damage, ...]
    no_pose: RecordingError | None


@dataclass(frozen=True)
class Content(RecordedSignals):
    """A recording: its signals on one clock and in one frame, and its missions."""

    missions: tuple[Mission, ...]


@np.errstate(over="ignore", invalid="ignore")  # of corrupt numbers, which are dropped as such
def read_signals(options: ReadOptions) -> RecordedSignals:
    """Read and clean all signals that a topic map finds in a recording.

    Raises
    ------
    RecordingError
        The file cannot be read.
    """
    path, given, sidecar = options.path, options.topic_map, options.sidecar
    recording = open_recording(path, given.messages if given is not None else ())
    maps = [given] if given is not None else list(shipped_maps(recording.format))
    candidates = [topic_map.under(options.namespace) for topic_map in maps]
    if given is not None and given.format != recording.format:
        raise RecordingError(
            path,
            f"is read as '{recording.format}', the topic map '{given.name}' is for "
            f"'{given.format}'",
            "give a map for this format",
        )
    rotors = rotor_count_of(recording.parameters)
    if rotors is not None and rotors[0] != 4:
        raise RecordingError(
            path,
            f"is of a vehicle of {rotors[0]} rotors, by its {rotors[1]}, and only four are "
            "simulated and read",
            "leave it out, and fit flights of a quadrotor",
        )
    chosen = choose_map(recording, candidates)
    taken: tuple[Note, ...] = ()
    if given is None:
        chosen, taken = with_columns_by_name(recording, chosen)
    places, passed_over = locate(recording, chosen, strict=given is not None)
    no_pose = pose_error(recording, chosen, places, by_user=given is not None)
    raw, contents, noticed = extract(recording, places, chosen.time)
    of_map = None if given is None else given.motor_order
    of_log = motor_order_of(recording.parameters)
    order = sidecar.motor_order or of_map or of_log or chosen.motor_order
    notes = [
        NoteCode.TOPIC_MAP.note(chosen.name, kind="info", count=len(places)),
        *taken,
        *passed_over,
        *unread_columns(recording, chosen, places),
        *_notes_of_places(places),
        *contents.notes,
        *noticed,
    ]
    infers = is_tabular(recording.format) and not any(clock.unit for clock in chosen.time)
    if infers and (in_us := quicker(raw)) is not None:
        raw = in_us
        notes.append(NoteCode.TIME_READ.note(count=len(next(iter(raw.values())).time)))
    if order is not None and set(PER_MOTOR) & set(raw):
        columns = columns_of(order)
        for name in set(PER_MOTOR) & set(raw):
            raw[name] = replace(raw[name], values=raw[name].values[:, columns])
        words = order_in_words([column + 1 for column in columns])
        notes.append(NoteCode.MOTOR_ORDER_GIVEN.note(words, kind="info"))
    topics = {signal: places[signal].topic for signal in raw}
    series, dropped = _clean(raw, topics)
    damage = tuple(part.later(_stamp_delay(raw, topics, contents)) for part in contents.damage)
    notes += dropped
    if no_pose is None and is_position_frozen(series):
        del series["position"]
        what = "its position never changes along x and y, though the vehicle tilts"
        no_pose = RecordingError(path, what, "record where it is")
    for needed in ("position", "attitude"):
        if no_pose is None and needed not in series:
            where = f" in {topics[needed]}" if topics.get(needed) else ""
            no_pose = RecordingError(path, f"no usable {needed}{where}", "inspect the recording")
    return RecordedSignals(
        recording, chosen, places, contents.samples, topics, series, tuple(notes), damage, no_pose
    )


def _notes_of_places(places: Mapping[str, Place]) -> Iterator[Note]:
    """Yield notes on the sources of signals."""
    speed, reference = places.get("rotor_speed"), places.get("reference_position")
    if speed is not None and speed.source.unit is None:  # what they were taken for
        yield NoteCode.SPEED_UNIT_OPEN.note(speed.unit, kind="info", topic=speed.topic)
    if {"position", "attitude"} <= set(places) and not set(DRIVING_SIGNALS) & set(places):
        yield NoteCode.POSE_ALONE.note()
    if reference and reference.topic.rpartition("/")[2].startswith(PX4_REFERENCES):
        yield NoteCode.PX4_REFERENCE.note(kind="info", topic=reference.topic)


def _stamp_delay(
    raw: Mapping[str, RawSeries], topics: Mapping[str, str], contents: ReadResult
) -> float:
    """Return the s from the recorder's clock to that of the series."""
    first = "position" if "position" in raw else min(raw, default=None)
    if first is None:
        return 0.0
    arrival = float(np.median(contents.samples[topics[first]].receive))
    return float(np.median(raw[first].time)) - arrival * 1e-9


def read_content(options: ReadOptions) -> Content:
    """Read a recording up to its missions; see `read_signals` and `content_of`."""
    return content_of(read_signals(options), options.sidecar)


def content_of(signals: RecordedSignals, sidecar: Sidecar) -> Content:
    """Return the signals of a recording on one clock and in one frame, and its missions.

    Raises
    ------
    RecordingError
        They hold no pose.
    ConfigError
        The side-car names missions, or a time, that they do not hold.
    """
    if signals.no_pose is not None:
        raise signals.no_pose
    topics = signals.topics
    series, dead = _without_dead_rotors(signals.series, topics)
    series, shifted = align_pose(series, topics)
    series, turned = correct_frames(series, topics)
    cut, stale = without_stale_end(series)
    missions = _choose_missions(cut, sidecar, signals.recording.path)
    if stale and not missions:  # read for inspection; a fit leaves such a flight out
        missions = _choose_missions(series, sidecar, signals.recording.path)
    else:
        series = cut
    denied = contradiction(series, missions)
    if denied is not None:  # it explains the doubts about frames
        turned = (*(note for note in turned if note.code not in DOUBTS), denied)
    notes = (*signals.notes, *shifted, *turned, *stale, *dead)
    read = vars(signals) | {"series": series, "notes": notes}
    return Content(**read, missions=missions)


def _clean(
    raw: Mapping[str, RawSeries], topics: Mapping[str, str]
) -> tuple[dict[str, Series], list[Note]]:
    series, units = {}, list[Note]()
    notes: dict[tuple[object, ...], Note] = {}
    read = {signal: unit_of(signal, topics[signal], of) for signal, of in scales_of(raw).items()}
    read |= units_of_references(raw, read)
    for signal, data in raw.items():
        seconds, measured = data.time, data.values
        if signal in read:
            unit, read_so = read[signal]
            measured = to_si(measured, unit)
            units += [] if read_so is None else [replace(read_so, count=len(seconds))]
        time, values, dropped = clean(signal, topics[signal], seconds, measured)
        for note in dropped:  # signals of one message lack the same samples
            alike = (note.code, note.topic, note.count, tuple(note.numbers.items()))
            before = notes[alike].names if alike in notes else ()
            notes[alike] = replace(note, names=(*before, *note.names))
        if len(time):
            series[signal] = Series(time, values)
    return series, [*units, *notes.values()]


MIN_COMMAND_RANGE = 0.05
"""A smaller range of commands may be a hover, in whole microseconds of PWM."""


def _without_dead_rotors(
    series: Mapping[str, Series], topics: Mapping[str, str]
) -> tuple[dict[str, Series], tuple[Note, ...]]:
    """Return signals without dead commands and rotor speeds, and notes on those.

    All commands are left out if one rotor's never change while others' do. A rotor speed is dead if
    it is always 0, or never changes while others do.
    """
    others, notes = dict(series), list[Note]()
    commands, speeds = (series.get(name) for name in PER_MOTOR)
    if commands is not None and len(commands.values) >= MIN_SAMPLES:
        change = np.fmax.reduce(commands.values, axis=0) - np.fmin.reduce(commands.values, axis=0)
        if (change == 0.0).any() and (change > MIN_COMMAND_RANGE).any():
            del others["command"]
            rotors = tuple(map(str, np.flatnonzero(change == 0.0) + 1))
            notes.append(
                NoteCode.COMMAND_DEAD.note(*rotors, topic=topics["command"], count=len(rotors))
            )
    if speeds is not None:
        low, high = np.fmin.reduce(speeds.values, axis=0), np.fmax.reduce(speeds.values, axis=0)
        still = (low == high) & (np.isfinite(speeds.values).sum(axis=0) >= MIN_SAMPLES)
        dead = still & ((high == 0.0) | (low < high).any())
        turning = replace(speeds, values=np.where(dead, np.nan, speeds.values))
        others["rotor_speed"] = turning.where(np.asarray(np.isfinite(turning.values).any(axis=1)))
        if not len(others["rotor_speed"].time):
            del others["rotor_speed"]
        missing = np.flatnonzero(np.isnan(turning.values).all(axis=0))
        rotors, topic = tuple(map(str, missing + 1)), topics["rotor_speed"]
        if rotors:
            notes.append(
                NoteCode.NO_TACHOMETER.note(*rotors, kind="info", topic=topic, count=len(rotors))
            )
    return others, tuple(notes)


def _choose_missions(
    series: Mapping[str, Series], sidecar: Sidecar, path: Path
) -> tuple[Mission, ...]:
    missions = split_into_manoeuvres(series, find_missions(series))
    if sidecar.missions is not None:
        numbers = sidecar.missions
        if missions and max(numbers) > len(missions):
            what = f"names mission {max(numbers)}, and {path.name} holds {len(missions)}"
            raise ConfigError(sidecar_path(path), what, "name those that tune inspect lists")
        missions = tuple(
            replace(mission, fitted=number in numbers) for number, mission in enumerate(missions, 1)
        )
    if sidecar.start is None and sidecar.end is None:
        return missions
    pose = series["position"].time
    start = missions[0].start if missions else float(pose[0])
    end = missions[-1].end if missions else float(pose[-1])
    start = start if sidecar.start is None else max(sidecar.start, float(pose[0]))
    end = end if sidecar.end is None else min(sidecar.end, float(pose[-1]))
    if end <= start:
        what = f"leaves nothing of {path.name}, from {start:g} to {end:g} s"
        raise ConfigError(sidecar_path(path), what, f"give 'start' and 'end' up to {pose[-1]:g} s")
    return (Mission(start, end, "the side-car"),)


def extract(
    recording: Recording, places: Mapping[str, Place], clocks: tuple[Clock, ...] = ()
) -> tuple[dict[str, RawSeries], ReadResult, tuple[Note, ...]]:
    """Read every located signal.

    Returns
    -------
    tuple
        Signal -> its samples in SI units and the axes of a `Flight`, in the order of the file, with
        its defects and times since the first position (without one, since the first sample); the
        messages they come from; and notes.
    """
    wanted: dict[str, dict[str, None]] = {}
    for place in places.values():
        wanted.setdefault(place.topic, {}).update(dict.fromkeys(place.read))
    contents = recording.read({topic: tuple(names) for topic, names in wanted.items()}, clocks)
    receive_only = {p.topic for p in places.values() if p.source.stamp == "receive"}
    kinds = {t: {s for s, place in places.items() if place.topic == t} for t in wanted}
    slow_topics = {topic for topic, held in kinds.items() if held <= SLOW_SIGNALS}
    times, notes = message_times(contents.samples, receive_only, slow_topics)
    stamps: dict[str, Nanoseconds] = {}
    read: dict[str, Array] = {}
    inferred: list[Note] = []
    for signal in sorted(
        places, key=lambda name: SIGNALS[name].axes == "attitude"
    ):  # positions may show their unit
        place = places[signal]
        samples = contents.samples.get(place.topic)
        if samples is None or not len(samples.receive):
            continue
        time = times[place.topic]
        recorded = np.column_stack([samples.fields[name] for name in place.fields])
        epoch = int(time[0])
        position = (
            _in_seconds(stamps["position"], read["position"], epoch) if "position" in read else None
        )
        raw = _in_seconds(time, recorded, epoch)
        unit = _recorded_unit(recording, signal, place, raw, position)
        if unit and unit != place.unit:
            phrase, count = UNITS[unit].phrase, len(time)
            inferred.append(NoteCode.UNIT_READ.note(signal, phrase, topic=place.topic, count=count))
        values = _in_flight_axes(samples, signal, place, to_si(recorded, unit or "si"))
        if is_tabular(recording.format):  # a row without the signal is no sample of it
            there = np.isfinite(values).any(axis=1)
            time, values = time[there], values[there]
        if len(time):
            stamps[signal], read[signal] = time, values
    first = [stamps["position"]] if "position" in stamps else list(stamps.values())
    epoch = min((int(time.min()) for time in first), default=0)
    signals = {s: _in_seconds(stamps[s], read[s], epoch) for s in places if s in read}
    return signals, contents, (*notes, *inferred)


def _in_seconds(time: Nanoseconds, values: Array, epoch: int) -> RawSeries:
    """Return samples with their times in s since some ns."""
    return RawSeries(np.asarray((time - epoch) * 1e-9, dtype=np.float64), values)


def _recorded_unit(
    recording: Recording, signal: str, place: Place, recorded: RawSeries, position: RawSeries | None
) -> str:
    """Return the unit of recorded numbers: the map's, else the plausible one, empty if none is."""
    if place.source.unit is not None:
        return place.unit
    if SIGNALS[signal].axes != "attitude" or place.source.quaternion != "rpy":
        return unit_by_range(signal, recorded.values, place.unit)
    required = signal == "attitude" and position is not None  # else no flight is made of it
    return unit_of_angles(recording.path, recorded, position, required=required)


def _in_flight_axes(samples: TopicSamples, signal: str, place: Place, values: Array) -> Array:
    """Return (n, k) values in the columns and axes of a `Flight`."""
    columns, axes = SIGNALS[signal].columns, SIGNALS[signal].axes
    if place.source.quaternion == "rpy" and axes == "attitude":
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
