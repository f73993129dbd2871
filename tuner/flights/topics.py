"""The topic map: which recorded field becomes which signal, read from ``configs/topics``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError, model_validator

from tuner.errors import ConfigError, did_you_mean
from tuner.flights.flight import SIGNALS
from tuner.flights.recording import Clock
from tuner.flights.units import UNITS

#: The maps that ship with the project.
SHIPPED = Path(__file__).resolve().parents[2] / "configs" / "topics"


class Source(BaseModel):
    """Where one signal is recorded.

    Attributes
    ----------
    topic
        Name of the topic, in which ``*`` stands for anything; empty in a table, which has one set
        of columns only.
    fields
        Paths into the message (``pose.position.x``, ``channels[0]``) or column names, in the
        order of the signal's columns; None takes those that the message type usually has.
    rotor
        Field that tells which rotor, from 0, a message speaks of; `fields` then names one field.
    unit
        Unit of the recorded numbers, a key of `UNITS`; None is the usual one of the message type.
    frame
        Axes of the recorded numbers: ``enu_flu`` as ROS has them, ``ned_frd`` as PX4 has them;
        None is the usual one of the message type.
    quaternion
        Order of the recorded quaternion, as `fields` lists it.
    stamp
        ``header`` prefers the time in the message, ``receive`` the time of recording.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    topic: str = ""
    fields: tuple[str, ...] | None = None
    rotor: str | None = None
    unit: str | None = None
    frame: Literal["enu_flu", "ned_frd"] | None = None
    quaternion: Literal["wxyz", "xyzw"] = "wxyz"
    stamp: Literal["header", "receive"] = "header"

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: object) -> object:
        return {"topic": value} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _known_unit(self) -> Source:
        if self.unit is not None and self.unit not in UNITS:
            raise ValueError(f"unknown unit '{self.unit}', {did_you_mean(self.unit, UNITS)}")
        if self.rotor is not None and (self.fields is None or len(self.fields) != 1):
            raise ValueError("a source with 'rotor' needs exactly one entry in 'fields'")
        return self


def _as_list(value: object) -> object:
    return value if isinstance(value, list | tuple) else [value]


class _ClockField(BaseModel):
    """A field that tells the time; a bare name means seconds."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    field: str
    unit: Literal["s", "ms", "us", "ns"] = "s"

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: object) -> object:
        return {"field": value} if isinstance(value, str) else value


class TopicMap(BaseModel):
    """Signals and the sources that may hold them, the preferred one first.

    Attributes
    ----------
    name
        What reports call the map.
    format
        Kind of recording that it applies to.
    extends
        Another map, by name or file, for all that this one does not say.
    priority
        Among maps that find equally many signals in a recording, the highest is taken.
    time
        Fields that tell the time, the preferred one first; none means the message's header.
    messages
        ``.msg`` files, or folders of them, for ROS types that a recording does not define.
    signals
        Signal of `SIGNALS` to its sources. In a table, a list of columns says it all.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    name: str
    format: Literal["ros", "ulog", "table"]
    extends: str | None = None
    priority: int = 0
    time: Annotated[tuple[_ClockField, ...], BeforeValidator(_as_list)] = ()
    messages: Annotated[tuple[Path, ...], BeforeValidator(_as_list)] = ()
    signals: Mapping[str, Annotated[tuple[Source, ...], BeforeValidator(_as_list)]]

    @model_validator(mode="before")
    @classmethod
    def _columns(cls, value: object) -> object:
        """Let a table's signal be a list of columns, or one column."""
        if not (isinstance(value, dict) and value.get("format") == "table"):
            return value
        signals = value.get("signals")
        if not isinstance(signals, dict):
            return value

        def as_source(columns: object) -> object:
            if isinstance(columns, str):
                return {"fields": [columns]}
            if isinstance(columns, list) and all(isinstance(name, str) for name in columns):
                return {"fields": columns}
            return columns

        return {**value, "signals": {name: as_source(of) for name, of in signals.items()}}

    @model_validator(mode="after")
    def _known_signals(self) -> TopicMap:
        for name, sources in self.signals.items():
            if name not in SIGNALS:
                raise ValueError(f"unknown signal '{name}', {did_you_mean(name, SIGNALS)}")
            columns = SIGNALS[name][0]
            for source in sources:
                count = columns if source.fields is None else len(source.fields)
                if source.rotor is None and count != columns:
                    raise ValueError(f"signal '{name}' has {columns} columns, {count} fields given")
        return self

    @property
    def clocks(self) -> tuple[Clock, ...]:
        """The fields that tell the time."""
        return tuple(Clock(clock.field, clock.unit) for clock in self.time)

    def under(self, namespace: str) -> TopicMap:
        """Return the map with every topic moved under a namespace, as ``uav1`` or ``/uav1``."""
        prefix = namespace.strip("/")
        if not prefix:
            return self
        signals = {
            name: tuple(
                source.model_copy(update={"topic": f"/{prefix}/{source.topic.lstrip('/')}"})
                for source in sources
            )
            for name, sources in self.signals.items()
        }
        return self.model_copy(update={"signals": signals})


def load_topic_map(path: str | Path, *, depth: int = 0) -> TopicMap:
    """Read a topic map from a file, or a shipped one by its name.

    Raises
    ------
    ConfigError
        The file is missing, no YAML, or says something that no map can say.
    """
    path = Path(path)
    if path.suffix not in {".yaml", ".yml"} and not path.exists():
        names = {file.stem: file for file in SHIPPED.glob("*.yaml")}
        if str(path) not in names:
            raise ConfigError(path, "no such topic map", did_you_mean(str(path), names))
        path = names[str(path)]
    try:
        content = yaml.load(path.read_text(encoding="utf-8"), Loader=_LOADER)
        if not isinstance(content, dict):
            raise ConfigError(path, "is no topic map", "see configs/topics for examples")
        found = TopicMap.model_validate(content)
    except OSError as err:
        raise ConfigError(path, f"cannot be read ({err.strerror})", "check the path") from None
    except (yaml.YAMLError, UnicodeDecodeError) as err:
        first = re.sub(r"\s+", " ", str(err))[:200]
        raise ConfigError(path, f"is no valid YAML ({first})", "correct it") from None
    except ValidationError as err:
        detail = err.errors(include_url=False)[0]
        where = ".".join(str(part) for part in detail["loc"])
        said = detail["msg"].removeprefix("Value error, ")
        what = f"{where}: {said}" if where else said
        raise ConfigError(path, what, "see configs/topics for examples") from None
    messages = tuple(path.parent / file for file in found.messages)
    found = found.model_copy(update={"messages": messages})
    return found if found.extends is None else _extended(found, path, depth)


def _extended(found: TopicMap, path: Path, depth: int) -> TopicMap:
    """Fill a map from the one that it extends."""
    name = str(found.extends)
    if depth > 3:
        raise ConfigError(path, f"extends '{name}', which extends it in turn", "break the circle")
    beside = path.parent / name
    base = load_topic_map(beside if beside.is_file() else name, depth=depth + 1)
    if base.format != found.format:
        raise ConfigError(path, f"extends '{name}' of another format", "extend one of its own")
    return found.model_copy(
        update={
            "signals": {**base.signals, **found.signals},
            "time": found.time or base.time,
            "messages": (*found.messages, *base.messages),
        }
    )


@cache
def shipped_maps() -> tuple[TopicMap, ...]:
    """Return every map in ``configs/topics``, by file name."""
    return tuple(load_topic_map(file) for file in sorted(SHIPPED.glob("*.yaml")))


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
