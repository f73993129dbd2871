"""Inspections as tables for a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from tuner.recordings.inspection import Inspection, MissionReport
from tuner.wording.notes import damage_sentence, note_in_words

_COLOURS = {"yes": "green", "weakly": "yellow", "no": "red"}


def render(
    inspections: Iterable[Inspection], verdicts: Mapping[str, Sequence[str]] | None = None
) -> RenderableType:
    """Return what was found in recordings, for rich to print.

    Parameters
    ----------
    inspections
        Of them.
    verdicts
        Path -> lines that say first whether and how it can be fitted.
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


def _titled(title: str) -> Table:
    return Table(title=title, title_justify="left", title_style="bold", box=None)


def _topics(inspection: Inspection) -> Table:
    table = _titled("topics")
    for name in ("topic", "type", "messages", "Hz", "gap s", "jitter ms", "delay ms", "used for"):
        right = name not in ("topic", "type", "used for")
        table.add_column(name, justify="right" if right else "left", no_wrap=name == "topic")
    for topic in inspection.topics:
        table.add_row(
            topic.name or "(table)",
            topic.type,
            str(topic.count),
            _number(topic.rate, ".1f"),
            _number(topic.longest_gap, ".3f"),
            _number(topic.jitter, ".2f", 1e3),
            _number(topic.delay, ".2f", 1e3) if topic.delay and abs(topic.delay) < 3600 else "",
            ", ".join(topic.signals),
            style="" if topic.signals else "dim",
        )
    return table


def _missions(inspection: Inspection) -> Table:
    table = _titled("missions")
    numbers = ("laps", "mean m/s", "top m/s", "tilt °", "turn rad/s", "height m", "pose known")
    for name in ("start s", "s", "begins with", *numbers, "remark"):
        table.add_column(name, justify="left" if name in ("begins with", "remark") else "right")
    for mission in inspection.missions:
        table.add_row(
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
        )
    return table


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
    table = _titled("inlets")
    table.add_column("inlet")
    table.add_column("can be fed from this recording")
    for inlet in inspection.inlets:
        usable = not inlet.missing and inspection.problem is None
        lacks = f"lacks {', '.join(inlet.missing)}" if inlet.missing else "no mission"
        table.add_row(inlet.name, "yes" if usable else lacks, style="" if usable else "dim")
    return table


def _coefficients(inspection: Inspection) -> Table:
    table = _titled("could inform")
    for name in ("coefficient", "", "because"):
        table.add_column(name)
    for finding in inspection.coefficients:
        how = Text(finding.how, _COLOURS[finding.how])
        table.add_row(finding.coefficient, how, finding.why)
    return table
