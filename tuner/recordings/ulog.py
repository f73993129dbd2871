"""PX4's ULog files and messages, in its own frames, NED and FRD, which a topic map turns.

pyulog reads header and messages. In between, this module checks the formats and counts messages:
pyulog expands nested formats, 77 bytes of which kept it busy for over 25 s and are refused here in
0.14 s; nor does it report the bytes after the last whole message of a cut log. The fields of
signals hold for PX4's messages in ROS 2 too. Source of logging profiles and default rates: PX4's
``logged_topics.cpp``.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tuner.core.disk import readable
from tuner.core.errors import RecordingError, short_reason
from tuner.recordings.notes import Cause, Damage
from tuner.recordings.recording import (
    NS_PER_UNIT,
    Clock,
    FieldLayout,
    ReadResult,
    Recording,
    Topic,
    TopicSamples,
)

#: No ULog message is longer; a format that claims so is damaged.
MAX_MESSAGE_BYTES = 65_535
#: The first bytes of a log.
MAGIC = b"ULog\x01\x12\x35"
#: Bytes before its first message.
HEADER_BYTES = 16
#: Logs are read into memory; PX4 writes some 10 MB a minute.
MAX_LOG_BYTES = 4 << 30
#: Messages are counted in blocks of so many bytes.
BLOCK_BYTES = 1 << 22

#: Message -> its fields: type, number, name.
Formats = dict[str, list[tuple[str, int, str]]]


class ULogRecording(Recording):
    """A PX4 log.

    A further instance of a message is the topic ``name[1]``.

    Attributes
    ----------
    parameters
        Name -> value at the log's beginning.

    Raises
    ------
    RecordingError
        The file is no readable log.
    """

    format = "ulog"

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.stat().st_size > MAX_LOG_BYTES:
            raise RecordingError(path, "is larger than any log of a flight", "cut it")
        self._formats, self.parameters = _definitions(path)
        counts, ids, self._cut_bytes = _count_messages(path)
        self.topics = tuple(
            sorted(
                (Topic(name, ids[number], count) for number, (name, count) in counts.items()),
                key=lambda topic: topic.name,
            )
        )

    def field_layout(self, topic: str, signal: str) -> FieldLayout | None:
        """Return the fields of a message that hold a signal."""
        return FIELD_LAYOUTS.get(topic.partition("[")[0], {}).get(signal)

    def fields(self, topic: str) -> list[str]:
        """Return the names of a message's fields."""
        return [name for _, _, name in self._formats.get(topic.partition("[")[0], [])]

    def missing_fields(self, topic: str, fields: tuple[str, ...]) -> tuple[str, ...]:
        """Return the fields that a message does not have."""
        kind = topic.partition("[")[0]
        return tuple(path for path in fields if not _has(self._formats, kind, path.split(".")))

    def read(
        self, wanted: Mapping[str, tuple[str, ...]], clocks: tuple[Clock, ...] = ()
    ) -> ReadResult:
        """Read the wanted fields of some messages."""
        names = sorted({topic.partition("[")[0] for topic in wanted})
        log, complaint = _parse(self.path, names)
        samples = {}
        for data in log.data_list:
            topic = data.name if data.multi_id == 0 else f"{data.name}[{data.multi_id}]"
            if topic in wanted:
                samples[topic] = self._samples(topic, data.data, wanted[topic], clocks)
        damage = []
        if log.dropouts:
            starts = [dropout.timestamp * 1e-6 for dropout in log.dropouts]
            end = starts[-1] + log.dropouts[-1].duration * 1e-3
            damage.append(
                Damage(
                    Cause.LOGGER_DROPOUTS,
                    occurrences=len(starts),
                    seconds_lost=1e-3 * sum(dropout.duration for dropout in log.dropouts),
                    start=starts[0],
                    end=end,
                )
            )
        if log.file_corruption or complaint:
            damage.append(Damage(Cause.LOG_DAMAGED))
        if self._cut_bytes:
            last = log.last_timestamp * 1e-6
            damage.append(Damage(Cause.END_MISSING, bytes_lost=self._cut_bytes, start=last))
        return ReadResult(samples, damage=tuple(damage))

    def _samples(
        self, topic: str, data: Mapping[str, Any], fields: Sequence[str], clocks: Sequence[Clock]
    ) -> TopicSamples:
        if "timestamp" not in data:
            raise RecordingError(self.path, f"{topic} has no timestamp", "leave it out of the map")
        receive = data["timestamp"].astype(np.int64) * NS_PER_UNIT["us"]
        stamp = receive
        for clock in (*clocks, Clock(field="timestamp_sample", unit="us")):
            if clock.field in data:
                sampled = data[clock.field].astype(np.int64) * clock.nanoseconds
                stamp = np.where(sampled > 0, sampled, receive)
                break
        missing = [name for name in fields if name not in data]
        if missing:
            raise RecordingError(
                self.path,
                f"{topic} has no field '{missing[0]}', it has {', '.join(list(data)[:12])}",
                "correct the topic map",
            )
        return TopicSamples(
            receive, stamp, {name: data[name].astype(np.float64) for name in fields}
        )


def _blocks(path: Path) -> Iterator[tuple[bytes, list[int]]]:
    """Yield blocks of a log with the positions of their whole messages, and the last one's end."""
    with path.open("rb") as stream:
        stream.seek(HEADER_BYTES)
        rest = b""
        while block := stream.read(BLOCK_BYTES):
            buffer, places, here = rest + block, [0], 0
            last, keep = len(buffer) - 3, places.append
            while here <= last:
                here += 3 + (buffer[here] | buffer[here + 1] << 8)
                keep(here)
            if places[-1] > len(buffer):
                places.pop()
            rest = buffer[places[-1] :]
            if len(places) > 1:
                yield buffer, places


def _definitions(path: Path) -> tuple[Formats, dict[str, float]]:
    """Return the checked formats and the parameters of a log."""
    with path.open("rb") as stream:
        if len(start := stream.read(HEADER_BYTES)) < HEADER_BYTES or not start.startswith(MAGIC):
            raise RecordingError(path, "is no PX4 log", "give the .ulg file itself")
    log, _ = _parse(path, [], header_only=True)
    formats: Formats = {
        name: [(what, max(count, 1), field) for what, count, field in known.fields]
        for name, known in log.message_formats.items()
    }
    for name in formats:
        if _count_numbers(formats, name, 0) > MAX_MESSAGE_BYTES:
            raise RecordingError(path, f"the format of {name} is absurd", "record it again")
    values = log.initial_parameters.items()
    return formats, {name: float(of) for name, of in values if isinstance(of, int | float)}


def parameters_of(path: Path) -> dict[str, float]:
    """Return the parameters at the beginning of a PX4 log; empty for any other file."""
    with contextlib.suppress(RecordingError), readable(path):
        return _definitions(path)[1]
    return {}


def parameters_in_flight(path: Path) -> tuple[dict[str, float], set[str]]:
    """Return a PX4 log's parameters when its vehicle is armed, and those that change afterwards.

    A log that does not hold ``actuator_armed`` gives the parameters that it begins with. Both are
    empty for any other file.
    """
    values = parameters_of(path)
    later: set[str] = set()
    heads = (buffer[at + 2] for buffer, places in _blocks(path) for at in places[:-1])
    if not values or sum(kind == ord("P") for kind in heads) <= len(values):
        return values, later
    with contextlib.suppress(RecordingError):  # which its reader names
        log, _ = _parse(path, ["actuator_armed"])
        armed = [of.data["timestamp"][of.data["armed"] != 0] for of in log.data_list
                 if {"timestamp", "armed"} <= of.data.keys()]  # fmt: skip
        start = min((int(times[0]) for times in armed if len(times)), default=0)
        for time, name, value in log.changed_parameters:
            if isinstance(value, int | float) and values.get(name) != value:
                if time < start:
                    values[name] = float(value)
                else:
                    later.add(name)
    return values, later


def _has(formats: Formats, kind: str, path: list[str]) -> bool:
    """Return whether a format has a field such as ``esc[0].esc_rpm``, given in its parts."""
    name, _, index = path[0].partition("[")
    for what, count, field in formats.get(kind, []):
        if field == name:
            number = int(index[:-1]) if index[:-1].isdecimal() else 0
            inside = number < count and bool(index) == (count > 1)
            return inside and (len(path) == 1 or _has(formats, what, path[1:]))
    return False


def _count_numbers(formats: Formats, name: str, depth: int) -> int:
    """Return the count of numbers in a format, capped just above that of any message."""
    if depth > 8:
        return MAX_MESSAGE_BYTES + 1
    total = 0
    for what, count, _ in formats[name]:
        inner = _count_numbers(formats, what, depth + 1) if what in formats else 1
        total += max(1, inner) * count
        if total > MAX_MESSAGE_BYTES:
            break
    return total


def _count_messages(path: Path) -> tuple[dict[int, tuple[str, int]], dict[int, str], int]:
    """Count the messages of each subscription, and the bytes after the last whole one."""
    names: dict[int, str] = {}
    kinds: dict[int, str] = {}
    counts: Counter[int] = Counter()
    reached = HEADER_BYTES
    for buffer, places in _blocks(path):
        content = np.frombuffer(buffer, dtype=np.uint8)
        at = np.array(places[:-1], dtype=np.int64)
        kind, size = content[at + 2], np.diff(places) - 3
        data = at[(kind == ord("D")) & (size >= 2)]
        numbers = content[data + 3] | content[data + 4].astype(np.int64) << 8
        counts.update(
            dict(zip(*(x.tolist() for x in np.unique(numbers, return_counts=True)), strict=True))
        )
        for first in at[(kind == ord("A")) & (size >= 4)].tolist():
            length = buffer[first] | buffer[first + 1] << 8
            instance, number = struct.unpack_from("<BH", buffer, first + 3)
            kinds[number] = buffer[first + 6 : first + 3 + length].decode(errors="replace")
            names[number] = kinds[number] if instance == 0 else f"{kinds[number]}[{instance}]"
        reached += places[-1]
    counted = {number: (name, counts[number]) for number, name in names.items()}
    return counted, kinds, path.stat().st_size - reached


class _Definitions(io.BufferedReader):
    """A log that is read up to its data: pyulog goes round for ever where it has none."""

    def read(self, size: int | None = -1, /) -> bytes:
        found = super().read(size)
        if size is not None and 0 < len(found) < size:
            raise EOFError("it ends before its data")
        return found


def _parse(path: Path, names: list[str], *, header_only: bool = False) -> tuple[Any, str]:
    """Parse a log with pyulog, which prints what it finds wrong."""
    from pyulog import ULog  # noqa: PLC0415 (slow to import)

    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed), _Definitions(io.FileIO(path)) as definitions:
            source = definitions if header_only else str(path)
            log = ULog(source, names, parse_header_only=header_only)
        return log, printed.getvalue()
    except Exception as err:  # pyulog's own and whatever a hostile log makes of it
        what = f"is no readable PX4 log ({short_reason(err)})"
        raise RecordingError(path, what, "record it again") from None


SYSTEM_IDENTIFICATION, HIGH_RATE = 8, 16
"""Bits of ``SDLOG_PROFILE``."""
DEFAULT_PROFILE = 1
MIN_RATE_SHARE = 0.8
"""A smaller share of the needed rate is too slow."""


_ned = partial(FieldLayout.of, frame="ned_frd")
_LOCAL_POSITION = {"position": _ned("{x,y,z}"), "velocity": _ned("{vx,vy,vz}")}
_ATTITUDE = {"attitude": _ned("q[{0,1,2,3}]")}
_ODOMETRY = {
    "position": _ned("position[{0,1,2}]"),
    "attitude": _ned("q[{0,1,2,3}]"),
    "velocity": _ned("velocity[{0,1,2}]"),
    "body_rate": _ned("angular_velocity[{0,1,2}]"),
}

FIELD_LAYOUTS: Mapping[str, Mapping[str, FieldLayout]] = {
    "vehicle_local_position": _LOCAL_POSITION,
    "vehicle_local_position_groundtruth": _LOCAL_POSITION,
    "vehicle_attitude": _ATTITUDE,
    "vehicle_attitude_groundtruth": _ATTITUDE,
    "vehicle_odometry": _ODOMETRY,
    "vehicle_visual_odometry": _ODOMETRY,
    "vehicle_mocap_odometry": _ODOMETRY,
    "vehicle_angular_velocity": {"body_rate": _ned("xyz[{0,1,2}]")},
    "vehicle_acceleration": {"acceleration": _ned("xyz[{0,1,2}]")},
    "sensor_combined": {
        "body_rate": _ned("gyro_rad[{0,1,2}]"),
        "acceleration": _ned("accelerometer_m_s2[{0,1,2}]"),
    },
    "actuator_motors": {"command": _ned("control[{0,1,2,3}]")},
    "actuator_outputs": {"command": _ned("output[{0,1,2,3}]", unit="pwm_us")},
    "esc_status": {"rotor_speed": _ned("esc[{0,1,2,3}].esc_rpm", unit="rpm")},
    "vehicle_rates_setpoint": {
        "rate_setpoint": _ned("{roll,pitch,yaw}"),
        "thrust_setpoint": _ned("thrust_body[2]"),
    },
    "vehicle_attitude_setpoint": {
        "attitude_setpoint": _ned("q_d[{0,1,2,3}]"),
        "thrust_setpoint": _ned("thrust_body[2]"),
    },
    "trajectory_setpoint": {
        "reference_position": _ned("position[{0,1,2}]"),
        "reference_velocity": _ned("velocity[{0,1,2}]"),
        "reference_acceleration": _ned("acceleration[{0,1,2}]"),
    },
    "vehicle_local_position_setpoint": {
        "reference_position": _ned("{x,y,z}"),
        "reference_velocity": _ned("{vx,vy,vz}"),
        "reference_acceleration": _ned("acceleration[{0,1,2}]"),
    },
    "battery_status": {"battery_voltage": _ned("voltage_v")},
}
"""Message, named as in a log -> signal -> its fields."""


@dataclass(frozen=True)
class LogNeed:
    """A message that a fit needs, and its rate.

    Attributes
    ----------
    messages
        Its name, and those of substitutes.
    rate
        Hz that suffice.
    profiles
        Bits of ``SDLOG_PROFILE``, each of which logs it at full rate.
    """

    messages: tuple[str, ...]
    rate: float
    shows: str
    profiles: tuple[int, ...] = ()


LOG_NEEDS = (
    LogNeed(
        ("vehicle_angular_velocity", "sensor_combined"),
        200.0,
        "how it turns: inertia and the rotors' lag",
        (SYSTEM_IDENTIFICATION, HIGH_RATE),
    ),
    LogNeed(
        ("actuator_motors", "actuator_outputs"),
        200.0,
        "what the motors were asked for: inertia and the rotors' lag",
        (SYSTEM_IDENTIFICATION, HIGH_RATE),
    ),
    LogNeed(
        ("vehicle_acceleration", "sensor_combined"),
        200.0,
        "thrust and drag",
        (SYSTEM_IDENTIFICATION,),
    ),
    LogNeed(("vehicle_rates_setpoint",), 100.0, "what the rate loop was asked for", (HIGH_RATE,)),
    LogNeed(("vehicle_attitude",), 100.0, "the attitude that is compared", (HIGH_RATE,)),
    LogNeed(
        ("vehicle_local_position", "vehicle_mocap_odometry", "vehicle_visual_odometry"),
        50.0,
        "position and speed: drag and mass",
    ),
    LogNeed(("esc_status",), 100.0, "rotor speeds: the motor constant by itself", (HIGH_RATE,)),
)


@dataclass(frozen=True)
class LoggingAdvice:
    """A message to log, or to log faster.

    Attributes
    ----------
    logged, wanted
        Hz; 0 of one that is not there.
    """

    message: str
    logged: float
    wanted: float
    shows: str


def logging_advice(rates: Mapping[str, float]) -> tuple[LoggingAdvice, ...]:
    """Return the messages that are missing or too slow.

    Parameters
    ----------
    rates
        Message -> its logged rate in Hz.
    """
    found = []
    for wanted in LOG_NEEDS:
        fastest = max(wanted.messages, key=lambda name: rates.get(name, 0.0))
        logged = rates.get(fastest, 0.0)
        if logged < MIN_RATE_SHARE * wanted.rate:
            found.append(LoggingAdvice(wanted.messages[0], logged, wanted.rate, wanted.shows))
    return tuple(found)


def logger_settings(advice: tuple[LoggingAdvice, ...], parameters: Mapping[str, float]) -> str:
    """Return the logger settings that follow some advice, in words; empty without advice."""
    if not advice:
        return ""
    profile = round(parameters.get("SDLOG_PROFILE", DEFAULT_PROFILE))
    of_message = {wanted.messages[0]: wanted for wanted in LOG_NEEDS}
    bits, lines = 0, []
    for each in advice:
        wanted = of_message[each.message]
        fresh = [bit for bit in wanted.profiles if not profile & bit]
        if fresh and not bits & sum(fresh):
            bits |= fresh[-1]
        elif not fresh:
            lines.append(f"{each.message} {1000 / each.wanted:.0f}")
    parts = [f"SDLOG_PROFILE {profile | bits} instead of {profile}"] if bits else []
    if lines:
        listed = ", ".join(f"'{line}'" for line in lines)
        parts.append(f"lines {listed} in etc/logging/logger_topics.txt on the SD card")
    return " and ".join(parts)
