"""What `tune inspect` finds in recordings, as plain values that JSON can hold.

Standard library only: a recording that was inspected before is answered from the cache at once.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tuner.core.disk import exists
from tuner.core.errors import InputError, RecordingError
from tuner.recordings.cache import cached, digest, load, store
from tuner.recordings.damage import Cause, Damage
from tuner.recordings.notes import Note

if TYPE_CHECKING:
    from tuner.recordings.topics import TopicMap

#: Of the JSON that `as_json` writes.
SCHEMA_VERSION = 2


@dataclass(frozen=True)
class TopicReport:
    """One topic of the file.

    Attributes
    ----------
    name, type, count
        As recorded.
    rate
        Hz, the median; None where the topic was not read.
    longest_gap
        s between two stamps.
    jitter
        s, the standard deviation of the stamps' steps about a steady rate.
    delay
        s, the median by which messages were recorded after their stamps.
    signals
        What is taken from it.
    """

    name: str
    type: str
    count: int
    rate: float | None
    longest_gap: float | None
    jitter: float | None
    delay: float | None
    signals: tuple[str, ...]


@dataclass(frozen=True)
class SignalReport:
    """One signal, cleaned.

    Attributes
    ----------
    name, topic
        Where it comes from.
    unit
        Of its values.
    samples
        How many are left.
    rate
        Hz, the median.
    columns
        Which columns were measured.
    """

    name: str
    topic: str
    unit: str
    samples: int
    rate: float
    columns: tuple[int, ...]


@dataclass(frozen=True)
class MissionReport:
    """One mission.

    Attributes
    ----------
    start, duration
        s, the start since the first pose.
    begins_with
        What marks its start.
    laps
        Completed laps, None where none are recorded.
    mean_speed, top_speed
        m/s.
    largest_tilt
        Degrees.
    top_turn_rate
        rad/s.
    yaw_rate_setpoint
        rad/s of a yaw spin.
    level_held
        Whether roll, pitch and position were controlled during a yaw spin.
    height
        m, lowest and highest.
    known
        Part of the ticks with a pose.
    fitted
        Whether `tune` fits it.
    """

    start: float
    duration: float
    begins_with: str
    laps: int | None
    mean_speed: float
    top_speed: float
    largest_tilt: float
    top_turn_rate: float | None
    yaw_rate_setpoint: float | None
    level_held: bool
    height: tuple[float, float]
    known: float
    fitted: bool = True


@dataclass(frozen=True)
class Inlet:
    """Whether a recording can be fed into the simulated loop at one place.

    Attributes
    ----------
    name
        ``reference``, ``body_rate``, ``actuator``, ``rotor_speed`` or ``attitude``.
    missing
        What it lacks for that; nothing if it can.
    """

    name: str
    missing: tuple[str, ...]


@dataclass(frozen=True)
class Informed:
    """Whether a recording could inform a coefficient: ``yes``, ``weakly`` or ``no``, and why."""

    coefficient: str
    how: str
    why: str


@dataclass(frozen=True)
class Inspection:
    """What one recording holds.

    Attributes
    ----------
    path, format, size
        The file: its kind, and its bytes.
    started
        UTC, ISO 8601; None where the clock counts from a start-up.
    duration
        s between the first and the last message that was read.
    topic_map
        The map that fits best.
    problem
        Why no flight can be read from it, in one line; None if one can.
    topics, signals, missions, inlets, coefficients
        See there.
    clock
        Seconds: ``spread`` of the reference's stamps on their ticks, ``drift`` of its clock (s/s),
        ``pose_offset`` of the pose against the gyro; what is unknown is left out.
    battery
        V at the start and at the end, None where it was not recorded.
    notes
        What was dropped, repaired or doubted.
    damage
        What the file has lost, with times in s since the first pose.
    """

    path: str
    format: str
    size: int
    started: str | None
    duration: float
    topic_map: str
    problem: str | None
    topics: tuple[TopicReport, ...]
    signals: tuple[SignalReport, ...] = ()
    missions: tuple[MissionReport, ...] = ()
    inlets: tuple[Inlet, ...] = ()
    coefficients: tuple[Informed, ...] = ()
    clock: Mapping[str, float] = field(default_factory=dict)
    battery: tuple[float, float] | None = None
    notes: tuple[Note, ...] = ()
    damage: tuple[Damage, ...] = ()


def inspect_recordings(
    paths: Iterable[str | Path],
    *,
    topics: str | Path | TopicMap | None = None,
    namespace: str = "",
    cache: bool = True,
) -> tuple[tuple[Inspection, ...], tuple[InputError, ...]]:
    """Inspect recordings.

    Parameters
    ----------
    paths
        The recordings.
    topics, namespace
        As of `tuner.recordings.load_flight`.
    cache
        Keep what was found in the user's cache, and take it from there.

    Returns
    -------
    tuple
        What was found in those that can be read, and an error for each that cannot.
    """
    inspections, errors = [], []
    for path in map(Path, paths):
        try:
            inspections.append(_inspect(path, topics, namespace, cache=cache))
        except InputError as err:
            errors.append(err)
    return tuple(inspections), tuple(errors)


def _inspect(
    path: Path, topics: str | Path | TopicMap | None, namespace: str, *, cache: bool
) -> Inspection:
    if not exists(path):
        raise RecordingError(path, "no such file", "check the path")
    beside = path / "flight.yaml" if path.is_dir() else path.with_suffix(".yaml")
    plain = topics is None and not beside.is_file()
    kept = cached("inspection", digest(path), namespace) if cache and plain else None
    if kept is not None and (content := load(kept)) is not None:
        before = from_json(content)
        if before is not None:
            return dataclasses.replace(before, path=str(path))
    from tuner.recordings.examine import examine  # noqa: PLC0415 (loads numpy and the readers)

    result = examine(path, topics, namespace, keep=cache)
    if kept is not None:
        store(kept, json.dumps(dataclasses.asdict(result)).encode())
    return result


def as_json(
    inspections: Iterable[Inspection],
    errors: Iterable[InputError] = (),
    verdicts: Mapping[str, object] | None = None,
) -> str:
    """Return inspections as JSON; numbers that are not finite become null.

    Parameters
    ----------
    inspections, errors
        As of `inspect_recordings`.
    verdicts
        Path -> what `tune` would do with the recording, if that was asked.
    """
    content = {
        "schema_version": SCHEMA_VERSION,
        "recordings": [
            _finite(dataclasses.asdict(inspection))
            | ({"verdict": _finite(verdicts.get(inspection.path))} if verdicts else {})
            for inspection in inspections
        ],
        "errors": [str(error) for error in errors],
    }
    return json.dumps(content, indent=2, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if abs(value) < float("inf") else None
    if isinstance(value, dict):
        return {key: _finite(of) for key, of in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(of) for of in value]
    return value


def from_json(content: bytes) -> Inspection | None:
    """Return an inspection that was kept as JSON; None if it is damaged."""
    try:
        raw = json.loads(content)
        return Inspection(
            **{
                **raw,
                "topics": tuple(
                    TopicReport(**{**t, "signals": tuple(t["signals"])}) for t in raw["topics"]
                ),
                "signals": tuple(
                    SignalReport(**{**s, "columns": tuple(s["columns"])}) for s in raw["signals"]
                ),
                "missions": tuple(
                    MissionReport(**{**m, "height": tuple(m["height"])}) for m in raw["missions"]
                ),
                "inlets": tuple(Inlet(i["name"], tuple(i["missing"])) for i in raw["inlets"]),
                "coefficients": tuple(Informed(**c) for c in raw["coefficients"]),
                "battery": tuple(raw["battery"]) if raw["battery"] else None,
                "notes": tuple(Note.read(note) for note in raw["notes"]),
                "damage": tuple(Damage(**{**d, "cause": Cause(d["cause"])}) for d in raw["damage"]),
            }
        )
    except (ValueError, TypeError, KeyError):
        return None
