"""The report of `tune inspect` on recordings: plain values, JSON and tables for a terminal.

A recording that was inspected before is answered from the cache, without numpy.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic_core import to_jsonable_python
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from tuner.core.disk import exists
from tuner.core.errors import InputError, RecordingError
from tuner.recordings.cache import cache_file, digest, load_or_compute
from tuner.recordings.notes import Damage, Note, damage_sentence, note_in_words

if TYPE_CHECKING:
    from tuner.recordings.topics import TopicMap

#: The version of the JSON of `as_json`.
SCHEMA_VERSION = 2
_COLOURS = {"yes": "green", "weakly": "yellow", "no": "red"}


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
        from tuner.recordings.inspector import inspect_recording  # noqa: PLC0415 (numpy and the readers)

        return inspect_recording(path, topics, namespace, keep=cache)

    beside = path / "flight.yaml" if path.is_dir() else path.with_suffix(".yaml")
    if not cache or topics is not None or beside.is_file():
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


def render(
    inspections: Iterable[Inspection], verdicts: Mapping[str, Sequence[str]] | None = None
) -> RenderableType:
    """Return inspections for rich to print.

    Parameters
    ----------
    verdicts
        Path -> lines that say whether and how it can be fitted, printed first.
    """
    verdicts = verdicts or {}
    return Group(
        *(part for each in inspections for part in _tables(each, verdicts.get(each.path, ())))
    )


def _tables(inspection: Inspection, verdict: Sequence[str]) -> list[RenderableType]:
    size = f"{inspection.size / 1e6:.1f} MB"
    about = [inspection.format, size, f"{inspection.duration:.1f} s"]
    about += [inspection.started.replace("+00:00", " UTC")] if inspection.started else []
    about += [f"topic map {inspection.topic_map}"] if inspection.topic_map else []
    parts: list[RenderableType] = [Text(), Text(inspection.path, "bold"), Text(" · ".join(about))]
    colour = "red" if verdict and verdict[0].startswith("cannot") else "green"
    parts += [Text(line, colour if not line.startswith(" ") else "") for line in verdict]
    if inspection.problem and not verdict:
        parts.append(Text(inspection.problem, "red"))
    parts += [Text(f"warning: {damage_sentence(damage)}", "yellow") for damage in inspection.damage]
    parts.append(_topics(inspection))
    if inspection.missions:
        parts.append(_missions(inspection))
    if inspection.clock or inspection.battery:
        parts.append(_clock_and_battery(inspection))
    parts.append(_inlets(inspection))
    if inspection.coefficients:
        parts.append(_coefficients(inspection))
    for note in inspection.notes:
        colour = "yellow" if note.kind == "warning" else "dim"
        topic = f"{note.topic}: " if note.topic else ""
        parts.append(Text(f"{note.kind}: {topic}{note_in_words(note)}", colour))
    return parts


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "" if value is None else format(value * scale, form)


def _table(
    title: str,
    columns: Sequence[str],
    rows: Iterable[tuple[str, Sequence[str | Text]]],
    left: Sequence[str],
) -> Table:
    """Return a table of rows (style, cells); columns not in `left` are right-aligned."""
    table = Table(title=title, title_justify="left", title_style="bold", box=None)
    for name in columns:
        table.add_column(name, justify="left" if name in left else "right", no_wrap=name == "topic")
    for style, cells in rows:
        table.add_row(*cells, style=style)
    return table


def _topics(inspection: Inspection) -> Table:
    names = ("topic", "type", "messages", "Hz", "gap s", "jitter ms", "delay ms", "used for")
    rows = (
        (
            "" if topic.signals else "dim",
            (
                topic.name or "(table)",
                topic.type,
                str(topic.count),
                _number(topic.rate, ".1f"),
                _number(topic.longest_gap, ".3f"),
                _number(topic.jitter, ".2f", 1e3),
                _number(topic.delay, ".2f", 1e3) if topic.delay and abs(topic.delay) < 3600 else "",
                ", ".join(topic.signals),
            ),
        )
        for topic in inspection.topics
    )
    return _table("topics", names, rows, ("topic", "type", "used for"))


def _missions(inspection: Inspection) -> Table:
    numbers = ("laps", "mean m/s", "top m/s", "tilt °", "turn rad/s", "height m", "pose known")
    rows = (
        (
            "",
            (
                f"{mission.start:.2f}",
                f"{mission.duration:.2f}",
                mission.begins_with,
                "" if mission.laps is None else str(mission.laps),
                f"{mission.mean_speed:.2f}",
                f"{mission.top_speed:.2f}",
                f"{mission.largest_tilt:.1f}",
                _number(mission.top_turn_rate, ".2f"),
                f"{mission.height[0]:.2f}–{mission.height[1]:.2f}",
                f"{100 * mission.known:.1f} %",
                _remark(mission),
            ),
        )
        for mission in inspection.missions
    )
    columns = ("start s", "s", "begins with", *numbers, "remark")
    return _table("missions", columns, rows, ("begins with", "remark"))


def _remark(mission: MissionReport) -> str:
    spin = mission.yaw_rate_setpoint
    if spin is None:
        return "" if mission.fitted else "others show more: not fitted"
    return f"yaw spin at {spin:g} rad/s" + (", held level" if mission.level_held else "")


def _clock_and_battery(inspection: Inspection) -> Text:
    remarks = []
    if "spread" in inspection.clock:
        remarks.append(
            f"the reference's stamps are late by up to {1e3 * inspection.clock['spread']:.2f} ms"
        )
    if inspection.clock.get("drift"):
        remarks.append(f"its clock drifts by {1e6 * inspection.clock['drift']:+.0f} ppm")
    offset = inspection.clock.get("pose_offset")
    if offset is not None:
        remarks.append(f"the pose's stamps are {1e3 * offset:+.1f} ms late against the gyro's")
    text = f"clock: {', '.join(remarks)}" if remarks else ""
    if inspection.battery:
        first, last = inspection.battery
        text += f"{'   ' if text else ''}battery: {first:.2f} V to {last:.2f} V"
    return Text(text)


def _inlets(inspection: Inspection) -> Table:
    rows = []
    for inlet in inspection.inlets:
        usable = not inlet.missing and inspection.problem is None
        lacks = f"lacks {', '.join(inlet.missing)}" if inlet.missing else "no mission"
        rows.append(("" if usable else "dim", (inlet.name, "yes" if usable else lacks)))
    columns = ("inlet", "can be fed from this recording")
    return _table("inlets", columns, rows, columns)


def _coefficients(inspection: Inspection) -> Table:
    rows = (
        ("", (found.coefficient, Text(found.how, _COLOURS[found.how]), found.why))
        for found in inspection.coefficients
    )
    columns = ("coefficient", "", "because")
    return _table("could inform", columns, rows, columns)
