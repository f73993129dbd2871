"""The report of `tune inspect` on recordings: plain values, and their JSON.

A recording that was inspected before is answered from the cache, without numpy.
"""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic_core import to_jsonable_python

from tuner.core.disk import exists
from tuner.core.errors import InputError, RecordingError
from tuner.recordings.cache import cache_file, digest, load_or_compute, sidecar_path
from tuner.recordings.notes import Damage, Note

if TYPE_CHECKING:
    from tuner.recordings.topics import TopicMap

#: The version of the JSON of `as_json`.
SCHEMA_VERSION = 2


@dataclass(frozen=True)
class TopicReport:
    """One topic of the file.

    Attributes
    ----------
    rate
        Hz, the median; None where the topic was not read.
    longest_gap
        s between two stamps.
    jitter
        s, the standard deviation of the stamps' steps about a steady rate.
    delay
        s, the median by which messages were recorded after their stamps.
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
        Share of the ticks with a pose.
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
class InletReport:
    """Whether a recording can be fed into the simulated loop at one place.

    Attributes
    ----------
    name
        ``reference``, ``body_rate``, ``actuator``, ``rotor_speed`` or ``attitude``.
    missing
        The signals it lacks; empty if it can.
    """

    name: str
    missing: tuple[str, ...]


@dataclass(frozen=True)
class CoefficientReport:
    """Whether a recording can show a coefficient: ``yes``, ``weakly`` or ``no``, and why."""

    coefficient: str
    how: str
    why: str


@dataclass(frozen=True)
class Inspection:
    """The content of one recording.

    Attributes
    ----------
    path, format, size
        The file, its format, and its bytes.
    started
        UTC, ISO 8601; None where the clock counts from a start-up.
    duration
        s between the first and the last message that was read.
    problem
        Why it holds no flight, in one line; None if it does.
    clock
        Seconds: ``spread`` of the reference's stamps on their ticks, ``drift`` of its clock (s/s),
        ``pose_offset`` of the pose against the gyro; unknown ones are left out.
    battery
        V at the start and at the end, None where it was not recorded.
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
    inlets: tuple[InletReport, ...] = ()
    coefficients: tuple[CoefficientReport, ...] = ()
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
    cache
        Whether to use the user's cache.

    Returns
    -------
    tuple
        The inspections, and an error for each recording that cannot be read.
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

    def found() -> Inspection:
        from tuner.recordings.inspection_rules import inspect_recording  # noqa: PLC0415 (numpy and the readers)

        return inspect_recording(path, topics, namespace, keep=cache)

    if not cache or topics is not None or os.path.lexists(sidecar_path(path)):
        return found()
    before = load_or_compute(Inspection, cache_file("inspection", digest(path), namespace), found)
    return dataclasses.replace(before, path=str(path))


def as_json(
    inspections: Iterable[Inspection],
    errors: Iterable[InputError] = (),
    verdicts: Mapping[str, object] | None = None,
) -> str:
    """Return inspections as JSON; numbers that are not finite become null.

    Parameters
    ----------
    verdicts
        Path -> how `tune` would use the recording, if that was asked.
    """
    content = {
        "schema_version": SCHEMA_VERSION,
        "recordings": [
            dataclasses.asdict(inspection)
            | ({"verdict": verdicts.get(inspection.path)} if verdicts else {})
            for inspection in inspections
        ],
        "errors": [str(error) for error in errors],
    }
    content = to_jsonable_python(content, inf_nan_mode="null")
    return json.dumps(content, indent=2, allow_nan=False)
