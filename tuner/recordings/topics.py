"""Topic maps (``configs/topics``) and side-cars of recordings.

A topic map assigns recorded fields to signals; a side-car is a lab's YAML file about one recording,
of the same name beside it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from annotated_types import Ge, Len
from pydantic import BeforeValidator, model_validator

from tuner.core.errors import ConfigError, did_you_mean
from tuner.core.shipped import configs_folder, find_config
from tuner.core.yaml_section import Number, Section, Whole, read_model, refuse
from tuner.recordings import formats as recording_formats
from tuner.recordings.cache import sidecar_path
from tuner.recordings.flight import SIGNALS
from tuner.recordings.formats import is_tabular
from tuner.recordings.recording import Clock
from tuner.recordings.unit_detection import UNITS
from tuner.vehicle.motor_orders import MotorOrder

#: Maps may extend maps to this depth.
MAX_EXTENSIONS = 3


def _as_list(value: object) -> object:
    return value if isinstance(value, list | tuple) else [value]


class Source(Section):
    """The source of one signal.

    Attributes
    ----------
    topic
        Name of the topic, in which ``*`` stands for anything; empty in a table.
    fields
        Paths into the message (``pose.position.x``, ``channels[0]``) or column names, in the
        order of the signal's columns; None takes the usual ones of the message type.
    rotor
        Field that names the rotor, from 0, of a message; `fields` then names one field.
    unit
        Unit of the recorded numbers, a key of `UNITS`; None is the usual one of the message type.
    frame
        Axes of the recorded numbers: ``enu_flu`` as ROS has them, ``ned_frd`` as PX4 has them;
        None is the usual one of the message type.
    quaternion
        Order of the recorded quaternion, as `fields` lists it; ``rpy`` for an attitude that was
        recorded as roll, pitch and yaw, turned about z first, then y, then x.
    stamp
        ``header`` prefers the time in the message, ``receive`` the time of recording.
    """

    topic: str = ""
    fields: tuple[str, ...] | None = None
    rotor: str | None = None
    unit: str | None = None
    frame: Literal["enu_flu", "ned_frd"] | None = None
    quaternion: Literal["wxyz", "xyzw", "rpy"] = "wxyz"
    stamp: Literal["header", "receive"] = "header"

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return {"topic": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _makes_sense(self) -> Self:
        if self.unit is not None and self.unit not in UNITS:
            raise refuse(f"unknown unit '{self.unit}'", did_you_mean(self.unit, UNITS))
        if self.rotor is not None and (self.fields is None or len(self.fields) != 1):
            raise refuse("a source with 'rotor' has one number a message", "name one in 'fields'")
        return self


class TopicMap(Section):
    """Signals and their possible sources, the preferred one first.

    Attributes
    ----------
    name
        Its name in reports.
    format
        Format of its recordings.
    extends
        Another map, by name or file, for all that this one lacks.
    priority
        Of maps that find equally many signals, the one of highest priority is taken.
    time
        Fields that hold the time, the preferred one first; none means the message's header.
    messages
        ``.msg`` files, or folders of them, for ROS types that a recording does not define.
    motor_order
        The order of the columns of ``command`` and ``rotor_speed``: of `MOTOR_ORDERS` or four
        numbers; None for that of the format.
    signals
        Signal of `SIGNALS` -> its sources; in a table, a list of columns will do.
    """

    name: str
    format: str
    extends: str | None = None
    priority: Whole = 0
    time: Annotated[tuple[Clock, ...], BeforeValidator(_as_list)] = ()
    messages: Annotated[tuple[Path, ...], BeforeValidator(_as_list)] = ()
    motor_order: MotorOrder | None = None
    signals: Mapping[str, Annotated[tuple[Source, ...], BeforeValidator(_as_list)]]

    @model_validator(mode="before")
    @classmethod
    def _columns(cls, value: Any) -> Any:
        """Accept a list of columns, or one column, as a table's signal."""
        if not (isinstance(value, Mapping) and is_tabular(value.get("format"))):
            return value
        signals = value.get("signals")
        if not isinstance(signals, Mapping):
            return value

        def as_source(columns: object) -> object:
            if isinstance(columns, str):
                return {"fields": [columns]}
            if columns and isinstance(columns, list) and all(isinstance(n, str) for n in columns):
                return {"fields": columns}
            return columns

        return {**value, "signals": {name: as_source(of) for name, of in signals.items()}}

    @model_validator(mode="after")
    def _know_format_and_signals(self) -> Self:
        formats = [reader.format for reader in recording_formats.READERS]
        if self.format not in formats:
            raise refuse(f"unknown format '{self.format}'", did_you_mean(self.format, formats))
        for name, sources in self.signals.items():
            if name not in SIGNALS:
                raise refuse(f"unknown signal '{name}'", did_you_mean(name, SIGNALS))
            known = SIGNALS[name]
            for source in sources:
                angles = source.quaternion == "rpy" and known.axes == "attitude"
                wanted = 3 if angles else known.columns
                count = wanted if source.fields is None else len(source.fields)
                if source.rotor is None and count != wanted:
                    raise refuse(f"signal '{name}' has {count} fields", f"name all {wanted}")
        return self

    def under(self, namespace: str) -> TopicMap:
        """Return the map with every topic moved under a namespace, as ``uav1`` or ``/uav1``."""
        prefix = namespace.strip("/")
        if not prefix:
            return self
        signals = {
            name: tuple(
                source.replace(topic=f"/{prefix}/{source.topic.lstrip('/')}") for source in sources
            )
            for name, sources in self.signals.items()
        }
        return self.replace(signals=signals)


def load_topic_map(reference: str | Path, *, base: Path | None = None, depth: int = 0) -> TopicMap:
    """Read a topic map from a file, or a shipped one by its name.

    Parameters
    ----------
    reference
        A path, or the bare name of a shipped map.
    base
        Folder from which relative paths count; None is the working folder.
    depth
        The number of maps that extend this one.

    Raises
    ------
    ConfigError
        The file is missing, no YAML or no valid map.
    """
    path = find_config("topics", str(reference), base or Path())
    ships = path.parent == configs_folder() / "topics"
    topic_map = _shipped(path) if ships else read_model(TopicMap, path)
    if topic_map.messages:
        messages = tuple(path.parent / file for file in topic_map.messages)
        topic_map = topic_map.model_copy(update={"messages": messages})
    if topic_map.extends is None:
        return topic_map
    if depth >= MAX_EXTENSIONS:
        raise ConfigError(path, f"extends '{topic_map.extends}' in a circle", "break it")
    under = load_topic_map(topic_map.extends, base=path.parent, depth=depth + 1)
    if under.format != topic_map.format:
        raise ConfigError(
            path, f"extends '{under.name}' of another format", "extend one of its own"
        )
    merged = {
        "signals": {**under.signals, **topic_map.signals},
        "time": topic_map.time or under.time,
        "motor_order": topic_map.motor_order or under.motor_order,
        "messages": (*topic_map.messages, *under.messages),
    }
    return topic_map.model_copy(update=merged)  # of parts that were validated


@cache
def _shipped(path: Path) -> TopicMap:
    """Return a shipped map, read once."""
    return read_model(TopicMap, path)


@cache
def shipped_maps(kind: str) -> tuple[TopicMap, ...]:
    """Return the maps in ``configs/topics`` for recordings of a format, by file name."""
    files = sorted((configs_folder() / "topics").glob("*.yaml"))
    own = [f for f in files if f"format: {kind}" in f.read_text(encoding="utf-8").splitlines()]
    return tuple(map(load_topic_map, own))


class Sidecar(Section):
    """A lab's remarks about one recording, in the file beside it.

    Attributes
    ----------
    trajectory
        The flown trajectory, for recordings without the reference: name and numbers as in a
        `TrajectorySettings`, which validates them.
    start, end
        Seconds since the first pose of the mission's start and end, instead of those found.
    missions
        Numbers, from 1, of the missions to fit; None for all, or for those with most motion in a
        long recording.
    topics
        The topic map of this recording: a file beside it, or a shipped map's name.
    namespace
        Prefix of its topics.
    motor_order
        The order of its motors, as in a topic map.
    """

    trajectory: Mapping[str, str | Number] | None = None
    start: Number | None = None
    end: Number | None = None
    missions: Annotated[tuple[Annotated[Whole, Ge(1)], ...], Len(min_length=1)] | None = None
    topics: str | None = None
    namespace: str = ""
    motor_order: MotorOrder | None = None

    @model_validator(mode="after")
    def _starts_before_it_ends(self) -> Self:
        if self.start is not None and self.end is not None and self.start >= self.end:
            raise refuse(f"start {self.start:g} is not before end {self.end:g}", "swap them")
        return self


def read_sidecar(recording: Path) -> Sidecar:
    """Read the side-car of a recording; an empty one where there is none.

    Raises
    ------
    ConfigError
        It is no valid side-car.
    """
    path = sidecar_path(recording)
    try:
        return read_model(Sidecar, path) if os.path.lexists(path) else Sidecar()
    except ConfigError as error:
        what = f"{error.what} (it is read as the side-car of {recording.name})"
        raise ConfigError(error.where, what, error.remedy) from None
