"""The inspection of a recording, whether or not it holds a flight, and a topic map for it.

The inlets it can be fed into and the coefficients it can show follow from rules of thumb on its
signals and their excitation; the report of a fit has the identified ones. A suggested topic map has
the best guess for every column, and why.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import yaml

from tuner.core.disk import readable
from tuner.core.errors import RecordingError
from tuner.core.numerics import Array, finite_rows
from tuner.recordings.clocks import clock_of, pose_offset
from tuner.recordings.consistency import contradiction_in
from tuner.recordings.content import (
    Content,
    ReadOptions,
    RecordedSignals,
    content_of,
    read_content,
    read_signals,
)
from tuner.recordings.defects import has_stale_attitude
from tuner.recordings.flight import SIGNALS, Series
from tuner.recordings.formats import is_tabular, open_recording
from tuner.recordings.inspection import (
    CoefficientReport,
    InletReport,
    Inspection,
    MissionReport,
    SignalReport,
    TopicReport,
)
from tuner.recordings.interpolation import RATE_HZ, derivative, resample, smooth, upward
from tuner.recordings.loader import flights_of, flying_stretches, inertial_error, is_inertial
from tuner.recordings.missions import mission_error, yaw_spin
from tuner.recordings.notes import NoteCode
from tuner.recordings.recording import Topic, TopicSamples
from tuner.recordings.sources import choose_map, locate, sources_by_name
from tuner.recordings.topics import Sidecar, Source, TopicMap, shipped_maps
from tuner.vehicle import COEFFICIENTS

EARLIEST_DATE_NS = 631_152_000_000_000_000
"""Stamps before 1990 count from a start-up."""
MAX_INSPECTED_S = 3600.0
"""The part of a mission whose speeds are reported."""
CLEAR_ROLL_PITCH_RATE = 0.2
CLEAR_YAW_RATE = 0.4
CLEAR_SPEED = 1.5
CLEAR_VERTICAL_SPEED = 3.0
CLEAR_COMMAND_SPREAD = 0.03
"""Less motion shows a coefficient weakly, less than a third of it not at all."""
MIN_LAG_RATE_HZ = 80.0
"""A slower signal does not show a rotor's lag."""
_POSE = ("position", "attitude")
_WRENCH = ("commanded_thrust", "commanded_torque")
"""Without motor commands, a vehicle file's arms and curve make them of these."""
_ROTOR_INPUTS = ("rotor_speed", "command", "thrust_setpoint")
"""The attitude inlet needs one of these."""


def inspect_recording(
    path: Path, topics: str | Path | TopicMap | None, namespace: str, *, keep: bool = False
) -> Inspection:
    """Inspect a recording.

    Parameters
    ----------
    keep
        Whether to keep its flights in the user's cache, for a fit.

    Raises
    ------
    RecordingError
        Nothing of it can be read.
    ConfigError
        The topic map or the side-car is wrong.
    """
    options = ReadOptions.of(path, topics, namespace)
    with readable(path):
        try:
            signals = read_signals(options)
            if is_inertial(signals):
                return _without_pose(signals)
            content = content_of(signals, options.sidecar)
        except RecordingError as err:
            # Its topics are listed nevertheless, for a topic map.
            messages = options.topic_map.messages if options.topic_map else ()
            recording = open_recording(path, messages)
            return Inspection(
                path=str(path),
                format=recording.format,
                size=_size(path),
                started=None,
                duration=0.0,
                topic_map="",
                problem=_in_words(err),
                topics=tuple(_topic(topic, None, ()) for topic in recording.topics),
                inlets=inlet_reports({}, trajectory=False),
            )
    if keep:
        with contextlib.suppress(RecordingError):
            flights_of(content, options, keep=True)
    return _with_flight(content, options.sidecar)


def _without_pose(signals: RecordedSignals) -> Inspection:
    """Return the inspection of a recording of gyro, accelerometer and motor commands alone."""
    flown = flying_stretches(signals)
    error = inertial_error(signals, flown)
    seconds = float(sum(end - begin for begin, end in flown))
    fitted = () if error else (NoteCode.WITHOUT_POSE.note(kind="info", seconds=seconds),)
    return replace(
        _with_signals(signals),
        problem=_in_words(error),
        inlets=inlet_reports(_measured_columns(signals.series), trajectory=False),
        notes=(*fitted, *signals.notes),
    )


def _with_flight(content: Content, sidecar: Sidecar) -> Inspection:
    missions = tuple(_mission(content, i) for i in range(len(content.missions)))
    measured = _measured_columns(content.series)
    unusable = has_stale_attitude(content.series, content.notes) or contradiction_in(content.notes)
    if unusable:  # a fit leaves it out
        del measured["attitude"]
    error = None if missions else mission_error(content.recording.path, content.series)
    return replace(
        _with_signals(content),
        problem=_in_words(error),
        missions=missions,
        inlets=inlet_reports(measured, trajectory=sidecar.trajectory is not None),
        coefficients=() if unusable else coefficient_reports(content.series, measured, missions),
        clock=_clock(content),
        notes=content.notes,
    )


def _in_words(error: RecordingError | None) -> str | None:
    return None if error is None else f"{error.what}; {error.remedy}"


def _with_signals(read: RecordedSignals) -> Inspection:
    """Return the inspection of a recording's topics and signals alone."""
    recording, samples = read.recording, read.samples
    times = [s.receive for s in samples.values() if len(s.receive)]
    first, last = min(int(t.min()) for t in times), max(int(t.max()) for t in times)
    measured, battery = _measured_columns(read.series), read.series.get("battery_voltage")
    voltage = None if battery is None else battery.values
    return Inspection(
        path=str(recording.path),
        format=recording.format,
        size=_size(recording.path),
        started=_date(first),
        duration=(last - first) * 1e-9,
        topic_map=read.topic_map.name,
        problem=None,
        topics=tuple(
            _topic(
                topic,
                samples.get(topic.name),
                tuple(s for s, place in read.places.items() if place.topic == topic.name),
            )
            for topic in recording.topics
        ),
        signals=tuple(
            SignalReport(
                name,
                read.places[name].topic,
                SIGNALS[name].unit,
                len(samples.time),
                samples.rate,
                measured[name],
            )
            for name, samples in read.series.items()
        ),
        battery=None if voltage is None else (float(voltage[0, 0]), float(voltage[-1, 0])),
        damage=read.damage,
    )


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())


def _date(nanoseconds: int) -> str | None:
    if not EARLIEST_DATE_NS < nanoseconds < 8 * EARLIEST_DATE_NS:
        return None
    return datetime.fromtimestamp(nanoseconds * 1e-9, UTC).isoformat(timespec="seconds")


def _measured_columns(series: Mapping[str, Series]) -> dict[str, tuple[int, ...]]:
    """Return signal -> its columns that were measured."""
    return {
        name: tuple(int(i) for i in np.flatnonzero(np.isfinite(samples.values).any(axis=0)))
        for name, samples in series.items()
    }


def _topic(topic: Topic, samples: TopicSamples | None, signals: tuple[str, ...]) -> TopicReport:
    if samples is None or len(samples.receive) < 2:
        return TopicReport(topic.name, topic.type, topic.count, None, None, None, None, signals)
    stamps = samples.receive if samples.stamp is None else samples.stamp
    steps = np.diff(np.sort(np.asarray((stamps - stamps[0]) * 1e-9, dtype=np.float64)))
    usual = float(np.median(steps))
    delay = None
    if samples.stamp is not None and samples.stamp is not samples.receive:
        delay = float(np.median(samples.receive - samples.stamp)) * 1e-9
    near = steps[(steps > 0) & (steps < 3 * usual)]
    return TopicReport(
        name=topic.name,
        type=topic.type,
        count=len(samples.receive),
        rate=1 / usual if usual > 0 else None,
        longest_gap=float(steps.max()),
        jitter=float(near.std()) if len(near) else None,
        delay=delay,
        signals=signals,
    )


def _clock(content: Content) -> Mapping[str, float]:
    grid, offset = clock_of(content.series, 100.0), pose_offset(content.series)
    clock = {} if grid is None else {"spread": grid.spread, "drift": grid.drift}
    return clock if offset is None else {**clock, "pose_offset": offset}


def _mission(content: Content, index: int) -> MissionReport:
    mission = content.missions[index]
    clock = np.arange(mission.start, min(mission.end, mission.start + MAX_INSPECTED_S), 1 / RATE_HZ)
    position = resample("position", content.series["position"], clock)
    attitude = resample("attitude", content.series["attitude"], clock)
    speed = np.linalg.norm(derivative(smooth(position)), axis=1)
    up = upward(attitude)[:, 2]
    rates, lap = content.series.get("body_rate"), content.series.get("lap")
    turning = None
    if rates is not None:
        turn_rates = np.linalg.norm(resample("body_rate", rates, clock), axis=1)
        turning = float(np.nanmax(turn_rates)) if np.isfinite(turn_rates).any() else None
    yaw_rate, level_held = yaw_spin(content.series.get("rate_setpoint"), mission.start, mission.end)
    known = finite_rows(position) & finite_rows(attitude)
    return MissionReport(
        start=mission.start,
        duration=mission.end - mission.start,
        begins_with=mission.begins_with,
        laps=None if lap is None else len(lap.between(mission.start, mission.end).time),
        mean_speed=_reduced(np.nanmean, speed),
        top_speed=_reduced(np.nanmax, speed),
        largest_tilt=float(np.degrees(np.arccos(np.clip(_reduced(np.nanmin, up), -1, 1)))),
        top_turn_rate=turning,
        yaw_rate_setpoint=yaw_rate,
        level_held=level_held,
        height=(_reduced(np.nanmin, position[:, 2]), _reduced(np.nanmax, position[:, 2])),
        known=float(known.mean()),
        fitted=mission.fitted,
    )


def _reduced(reduce: object, values: Array) -> float:
    return float(reduce(values)) if np.isfinite(values).any() else float("nan")  # type: ignore[operator]


_SIGNALS_OF_INLETS: Mapping[str, Sequence[str]] = {
    "reference": (*_POSE, "reference_position"),
    "body_rate": (*_POSE, "rate_setpoint", "thrust_setpoint"),
    "actuator": (*_POSE, "command"),
    "rotor_speed": (*_POSE, "rotor_speed"),
    "attitude": _POSE,
}


def inlet_reports(
    measured: Mapping[str, tuple[int, ...]], *, trajectory: bool
) -> tuple[InletReport, ...]:
    """Return the signals that each inlet lacks.

    Parameters
    ----------
    measured
        Signal -> columns that were measured.
    trajectory
        Whether a side-car names the trajectory, in place of a recorded reference.
    """
    if all(name in measured for name in _WRENCH):
        measured = {"command": (0, 1, 2, 3), **measured}
    available = []
    for name, needs in _SIGNALS_OF_INLETS.items():
        known = {*measured, "reference_position"} if trajectory else {*measured}
        missing = [need for need in needs if need not in known]
        for need in ("command", "rotor_speed"):
            columns = measured.get(need)
            if need in needs and columns is not None and len(columns) < 4:
                lacking = [str(i + 1) for i in range(4) if i not in columns]
                missing.append(f"{need} of rotors {', '.join(lacking)}")
        if name == "attitude" and not any(
            len(measured.get(d, ())) in (1, 4) for d in _ROTOR_INPUTS
        ):
            missing.append(" or ".join(_ROTOR_INPUTS))
        available.append(InletReport(name, tuple(missing)))
    return tuple(available)


def coefficient_reports(
    series: Mapping[str, Series],
    measured: Mapping[str, tuple[int, ...]],
    missions: Sequence[MissionReport],
) -> tuple[CoefficientReport, ...]:
    """Return how well a recording can show each coefficient, by the rule in its row.

    Parameters
    ----------
    series
        Signal -> cleaned samples.
    measured
        Signal -> columns that were measured.
    """
    if not missions:
        return ()
    has = set(measured)
    rates = _spread(series, "body_rate", missions)
    command = float(np.max(_spread(series, "command", missions), initial=0.0))
    speed = max(mission.top_speed for mission in missions)
    vertical = (
        _values_during(series["velocity"], missions)[:, 2] if "velocity" in series else np.zeros(1)
    )
    climb = float(np.nanmax(np.abs(vertical))) if len(vertical) else 0.0
    driven = bool(has & {"command", "rotor_speed", "rate_setpoint", "reference_position"})
    tachometer, commands = "rotor_speed" in has, "command" in has

    def turning(axis: int, limit: float, name: str) -> tuple[str, str]:
        if "body_rate" not in has:
            return "weakly", "no gyro: only through the attitude"
        if not driven:
            return "no", "nothing recorded drives the simulation"
        return _grade(float(rates[axis]), limit, f"{name} rate varies by {rates[axis]:.2f} rad/s")

    def either(holds: bool, yes: str, otherwise: str, how: str = "weakly") -> tuple[str, str]:
        return ("yes", yes) if holds else (how, otherwise)

    rules = {
        "weighing": ("no", "weigh it: forces and inertias scale with it"),
        "nothing": ("no", "such flights do not show it"),
        "roll": turning(0, CLEAR_ROLL_PITCH_RATE, "roll"),
        "pitch": turning(1, CLEAR_ROLL_PITCH_RATE, "pitch"),
        "yaw": turning(2, CLEAR_YAW_RATE, "yaw"),
        "thrust curve": either(
            tachometer and commands and command > CLEAR_COMMAND_SPREAD,
            "commands and rotor speed show the curve",
            "only together with the motor constant",
        ),
        "rotor lag": either(
            tachometer and series["rotor_speed"].rate >= MIN_LAG_RATE_HZ,
            "rotor speed recorded quickly enough",
            "through the body rates only" if driven else "no rotor speed",
        ),
        "thrust": either(
            tachometer, "rotor speed against the weight", "only together with the RPM curve"
        ),
        "speed": _grade(speed, CLEAR_SPEED, f"flown at up to {speed:.1f} m/s"),
        "climb": _grade(climb, CLEAR_VERTICAL_SPEED, f"climbs at {climb:.1f} m/s"),
        "closed loop": either(
            {"reference_position", "rate_setpoint"} <= has,
            "reference and set-points close the loop",
            "the loop's reference or set-points are missing",
            "no",
        ),
        "commands and rotor speed": either(
            tachometer and commands,
            "commands and rotor speed recorded",
            "no commands beside rotor speeds",
        ),
    }
    return tuple(
        CoefficientReport(name, *rules[coefficient.informed_by])
        for name, coefficient in COEFFICIENTS.items()
        if coefficient.informed_by is not None
    )


def _grade(value: float, limit: float, why: str) -> tuple[str, str]:
    how = "yes" if value >= limit else "weakly" if value >= limit / 3 else "no"
    return how, why


def _values_during(series: Series, missions: Sequence[MissionReport]) -> Array:
    inside = np.zeros(len(series.time), dtype=np.bool_)
    for mission in missions:
        inside |= (series.time >= mission.start) & (series.time <= mission.start + mission.duration)
    return series.values[inside]


def _spread(series: Mapping[str, Series], name: str, missions: Sequence[MissionReport]) -> Array:
    """Return the variation of each column during the missions; zeros without samples.

    It is the standard deviation or, if larger, a quarter of the largest value, for single steps.
    """
    if name not in series:
        return np.zeros(4)
    values = _values_during(series[name], missions)
    if len(values) == 0:
        return np.zeros(values.shape[1])
    largest = np.nanmax(np.abs(values), axis=0)
    return np.asarray(np.maximum(np.nanstd(values, axis=0), 0.25 * largest))


SUGGESTED_SIGNALS = "position", "attitude", "command", "rotor_speed", "body_rate"
"""Signals for which a suggested map leaves a line to fill in."""


def suggested_map(path: Path) -> str:
    """Return the text of a topic map for a recording, for the user to check and complete.

    Raises
    ------
    RecordingError
        It cannot be read.
    """
    recording = open_recording(path)
    if not is_tabular(recording.format):
        chosen = choose_map(recording, shipped_maps(recording.format))
        places, _ = locate(recording, chosen)
        if not places:
            listed = ", ".join(topic.name for topic in recording.topics[:12])
            raise RecordingError(path, f"has no topic that a map knows, but {listed}", "map them")
        found = {name: place.source.replace(topic=place.topic) for name, place in places.items()}
        why = dict.fromkeys(found, f"as in the shipped map {chosen.name}")
        lines = [f"format: {recording.format}", f"extends: {chosen.name}"]
        return _map_text(path, lines, found, why, [])
    columns = recording.fields("")
    time, found = sources_by_name(columns, recording.units)
    lines = ["# time: {field: ..., unit: ms}      # no column seems to hold it"]
    if time is not None:
        about = "unit" if time.unit else "its unit is told by its step"
        lines = [
            f"time: {_inline_yaml(time.model_dump(exclude_none=True))}      # by its name; {about}"
        ]
    inferred = _inferred_units(path)
    why = {
        signal: "by the names" + _unit_comment(source, inferred.get(signal), signal)
        for signal, source in found.items()
    }
    taken = {field for source in found.values() for field in source.fields or ()}
    taken |= set() if time is None else {time.field}
    lines.insert(0, f"format: {recording.format}")
    return _map_text(path, lines, found, why, [c for c in columns if c not in taken])


def _inferred_units(path: Path) -> dict[str, str]:
    """Return signal -> its unit or frame in words, as inferred from its numbers."""
    with contextlib.suppress(RecordingError):
        notes = read_content(ReadOptions(path)).notes
        codes = (NoteCode.UNIT_READ, NoteCode.FRAME_TURNED)
        return {note.names[0]: note.names[1] for note in notes if note.code in codes}
    return {}


def _unit_comment(source: Source, inferred: str | None, name: str) -> str:
    if inferred:
        return f"; by the numbers {inferred}"
    if source.unit or (name == "attitude" and source.quaternion != "rpy"):
        return ""
    return "; no unit among them: SI as it seems, add it if that is wrong"


def _map_text(
    path: Path, lines: list[str], found: dict[str, Source], why: dict[str, str], unused: list[str]
) -> str:
    name = "".join(letter if letter.isalnum() else "_" for letter in path.stem)[:40]
    text = [
        f"# A suggestion for {path.name!r}: check it, and read with --topics FILE.",
        f"name: {name or 'suggested'}",
        *lines,
        "signals:" if found else "signals: {}",
    ]
    for signal, source in found.items():
        about = source.model_dump(exclude_defaults=True, exclude_none=True)
        about = {key: list(of) if isinstance(of, tuple) else of for key, of in about.items()}
        text.append(f"  {signal}: {_inline_yaml(about)}      # {why[signal]}")
    lacking = [signal for signal in SUGGESTED_SIGNALS if signal not in found]
    for signal in lacking:
        dots = ", ".join(["..."] * SIGNALS[signal].columns)
        text.append(f"  # {signal}: {{fields: [{dots}], unit: si}}      # no column seems so")
    if unused:
        text.append(f"# not used: {', '.join(ascii(column)[1:-1] for column in unused)}")
    return "\n".join(text) + "\n"


def _inline_yaml(value: object) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True).strip()
