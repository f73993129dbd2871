"""A topic map to begin with: the best guess for every column of a table, its unit, and why."""

from __future__ import annotations

import contextlib
from pathlib import Path

import yaml

from tuner.core.errors import RecordingError
from tuner.recordings.columns import recognised
from tuner.recordings.content import ReadOptions, read_content
from tuner.recordings.flight import SIGNALS
from tuner.recordings.formats import is_tabular, open_recording
from tuner.recordings.notes import NoteCode
from tuner.recordings.sources import choose_map, locate, source_of
from tuner.recordings.topics import Source, shipped_maps

LACKING = "position", "attitude", "command", "rotor_speed", "body_rate"
"""Signals that are asked for where no column seems to hold them."""


def suggested_map(path: Path) -> str:
    """Return the text of a topic map for a recording, to be checked and completed.

    Raises
    ------
    RecordingError
        It cannot be read.
    """
    recording = open_recording(path)
    if not is_tabular(recording.format):
        maps = [topic_map for topic_map in shipped_maps() if topic_map.format == recording.format]
        chosen = choose_map(recording, maps)
        places, _ = locate(recording, chosen)
        if not places:
            listed = ", ".join(topic.name for topic in recording.topics[:12])
            raise RecordingError(path, f"has no topic that a map knows, but {listed}", "map them")
        found = {name: place.source.replace(topic=place.topic) for name, place in places.items()}
        why = dict.fromkeys(found, f"as in the shipped map {chosen.name}")
        lines = [f"format: {recording.format}", f"extends: {chosen.name}"]
        return _text(path, lines, found, why, [])
    columns = recording.fields("")
    known = recognised(columns, recording.units)
    lines = ["# time: {field: ..., unit: ms}      # no column seems to hold it"]
    if "time" in known:
        unit = known["time"].unit
        about = "unit" if unit else "its unit is told by its step"
        field = {"field": known["time"].fields[0], **({"unit": unit} if unit else {})}
        lines = [f"time: {_inline(field)}      # by its name; {about}"]
    found, why, inferred = {}, {}, _inferred(path)
    for name, columns_of in known.items():
        if name != "time":
            signal = "attitude" if name == "angles" else name
            found[signal] = source_of(name, columns_of)
            why[signal] = "by the names" + _of_unit(columns_of.unit, inferred.get(signal), name)
    taken = {field for columns_of in known.values() for field in columns_of.fields}
    lines.insert(0, f"format: {recording.format}")
    return _text(path, lines, found, why, [c for c in columns if c not in taken])


def _inferred(path: Path) -> dict[str, str]:
    """Return in which units signals are by their numbers: signal -> words."""
    with contextlib.suppress(RecordingError):
        notes = read_content(ReadOptions(path)).notes
        codes = (NoteCode.UNIT_READ, NoteCode.FRAME_TURNED)
        return {note.names[0]: note.names[1] for note in notes if note.code in codes}
    return {}


def _of_unit(unit: str | None, inferred: str | None, name: str) -> str:
    if inferred:
        return f"; by the numbers {inferred}"
    if unit or name == "attitude":
        return ""
    return "; no unit among them: SI as it seems, add it if that is wrong"


def _text(
    path: Path,
    lines: list[str],
    found: dict[str, Source],
    why: dict[str, str],
    unused: list[str],
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
        text.append(f"  {signal}: {_inline(about)}      # {why[signal]}")
    lacking = [signal for signal in LACKING if signal not in found]
    text += [f"  # {signal}: {_example(signal)}      # no column seems so" for signal in lacking]
    if unused:
        text.append(f"# not used: {', '.join(ascii(column)[1:-1] for column in unused)}")
    return "\n".join(text) + "\n"


def _example(signal: str) -> str:
    return f"{{fields: [{', '.join(['...'] * SIGNALS[signal][0])}], unit: si}}"


def _inline(value: object) -> str:
    return yaml.safe_dump(value, default_flow_style=True, width=10_000, allow_unicode=True).strip()
