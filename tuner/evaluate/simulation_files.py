"""Simulated flights as CSV tables and ROS 1 bags."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tuner.core.disk import check_file, whole_file
from tuner.core.errors import InputError
from tuner.core.numerics import Array
from tuner.evaluate.closed_loop import COMPONENTS, Simulation

#: Time of the first sample since 1970; fixed, so that the same flight gives the same file.
EPOCH_NS = 1_577_836_800_000_000_000
RPM_PER_RAD_S = 60.0 / (2.0 * np.pi)
#: µs of PWM at command 0, and from there to command 1.
PWM_LOW, PWM_SPAN = 1000, 1000
#: Hover at the first point before the set-points begin, as labs record it.
HOVER_LEAD_S = 2.0
BATTERY = "/mavros/battery"
ONLY_IN_FLIGHT = ("/mavros/setpoint_raw/attitude", "/mavros/rc/out")
#: Ignores jerk and snap of a reference.
REFERENCE_MASK = 2
#: Ignores the attitude of a set-point.
BODY_RATE_MASK = 128

#: Message types of MAVROS and of the controllers, which ROS lacks.
DEFINITIONS = {
    "mavros_msgs/msg/RCOut": "std_msgs/Header header\nuint16[] channels\n",
    "mavros_msgs/msg/RPM": "std_msgs/Header header\nuint8 index\nfloat32 frequency\n",
    "mavros_msgs/msg/AttitudeTarget": (
        "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Quaternion orientation\n"
        "geometry_msgs/Vector3 body_rate\nfloat32 thrust\n"
    ),
    "controller_msgs/msg/FlatTarget": (
        "std_msgs/Header header\nuint8 type_mask\ngeometry_msgs/Vector3 position\n"
        "geometry_msgs/Vector3 velocity\ngeometry_msgs/Vector3 acceleration\n"
        "geometry_msgs/Vector3 jerk\ngeometry_msgs/Vector3 snap\n"
    ),
}

TOPICS = {
    "/optitrack/pose": "geometry_msgs/msg/PoseStamped",
    "/mavros/local_position/pose": "geometry_msgs/msg/PoseStamped",
    "/mavros/local_position/velocity_local": "geometry_msgs/msg/TwistStamped",
    "/mavros/imu/data": "sensor_msgs/msg/Imu",
    "/mavros/rpm": "mavros_msgs/msg/RPM",
    "/mavros/rc/out": "mavros_msgs/msg/RCOut",
    "/mavros/setpoint_raw/attitude": "mavros_msgs/msg/AttitudeTarget",
    "/reference/flatsetpoint": "controller_msgs/msg/FlatTarget",
    "/trajectory_publisher/lap_completed": "std_msgs/msg/Int32",
    BATTERY: "sensor_msgs/msg/BatteryState",
}


def write_bag(simulation: Simulation, path: Path) -> None:
    """Write a flight as recorded from MAVROS, motion capture and the trajectory publisher.

    Samples before time zero are hover, without set-points and commands; without such samples two
    seconds of hover at the first point are added. Stamps are exact, and no noise is added. Commands
    are PWM in whole µs, as from autopilots. The file is written atomically.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with whole_file(path) as unfinished:
        unfinished.unlink()  # the writer refuses a file that exists
        _write(simulation, unfinished)


def _write(simulation: Simulation, path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    for name, definition in DEFINITIONS.items():
        store.register(get_types_from_msg(definition, name))
    messages = _Messages(store.types)
    with Writer(path) as writer:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=store)
            for topic, kind in TOPICS.items()
            if topic != BATTERY or "battery_voltage" in simulation.signals
        }
        for topic, nanoseconds, message in _timed_messages(simulation, messages):
            raw = store.serialize_ros1(message, TOPICS[topic])
            writer.write(connections[topic], nanoseconds, raw)


def _timed_messages(simulation: Simulation, messages: _Messages) -> Iterator[tuple[str, int, Any]]:
    """Yield topic, time in ns and message of the hover before the flight, then of the flight."""
    flown, step = simulation.time >= 0.0, float(simulation.time[1] - simulation.time[0])
    mission, hover = _samples_at(simulation, flown), _samples_at(simulation, ~flown)
    if not len(hover.time):
        hover = _samples_at(simulation, np.zeros(round(HOVER_LEAD_S / step), int))
    for number in range(len(hover.time)):
        nanoseconds = EPOCH_NS + round(number * step * 1e9)
        for topic, message in messages.at(hover, number, nanoseconds):
            if topic not in ONLY_IN_FLIGHT:
                yield topic, nanoseconds, message
    for index, seconds in enumerate(mission.time):
        nanoseconds = EPOCH_NS + round((len(hover.time) * step + float(seconds)) * 1e9)
        for topic, message in messages.at(mission, index, nanoseconds):
            yield topic, nanoseconds, message


def _samples_at(simulation: Simulation, rows: NDArray[Any]) -> Simulation:
    signals = {name: values[rows] for name, values in simulation.signals.items()}
    return replace(simulation, time=simulation.time[rows], signals=signals)


class _Messages:
    """Makes the messages of one sample."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self._types = types
        self._still = self._make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)

    def at(self, flight: Simulation, index: int, nanoseconds: int) -> Iterator[tuple[str, Any]]:
        """Yield topic and message of every topic with one at a sample."""
        now = {name: values[index].tolist() for name, values in flight.signals.items()}
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(nanoseconds, 1_000_000_000))
        world = self._make("std_msgs/msg/Header", index, stamp, "map")
        body = self._make("std_msgs/msg/Header", index, stamp, "base_link")
        w, x, y, z = now["attitude"]
        attitude = self._make("geometry_msgs/msg/Quaternion", x, y, z, w)
        place = self._make("geometry_msgs/msg/Point", *now["position"])
        pose = self._make("geometry_msgs/msg/Pose", place, attitude)
        yield self._on("/optitrack/pose", world, pose)
        yield self._on("/mavros/local_position/pose", world, pose)
        velocity, body_rate = self._vector(now["velocity"]), self._vector(now["body_rate"])
        twist = self._make("geometry_msgs/msg/Twist", velocity, body_rate)
        yield self._on("/mavros/local_position/velocity_local", world, twist)
        force, unknown = self._vector(now["acceleration"]), np.zeros(9)
        imu = (attitude, unknown, body_rate, unknown, force, unknown)
        yield self._on("/mavros/imu/data", body, *imu)
        for rotor, speed in enumerate(now["rotor_speed"]):
            yield self._on("/mavros/rpm", body, rotor, speed * RPM_PER_RAD_S)
        pwm = np.array([PWM_LOW + round(PWM_SPAN * u) for u in now["command"]], dtype=np.uint16)
        yield self._on("/mavros/rc/out", body, pwm)
        level = self._make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        setpoint = (level, self._vector(now["rate_setpoint"]), now["thrust_setpoint"][0])
        yield self._on("/mavros/setpoint_raw/attitude", body, BODY_RATE_MASK, *setpoint)
        names = ("reference_position", "reference_velocity", "reference_acceleration")
        parts = (*(self._vector(now[name]) for name in names), self._still, self._still)
        yield self._on("/reference/flatsetpoint", world, REFERENCE_MASK, *parts)
        if "battery_voltage" in now and np.isfinite(volts := now["battery_voltage"][0]):
            unknown_amounts = (float("nan"),) * 6  # temperature, current, charge, capacities, share
            state = (0, 0, 0, True)  # power supply unknown, battery present
            none = np.zeros(0, np.float32)
            yield self._on(BATTERY, world, volts, *unknown_amounts, *state, none, none, "", "")
        laps = flight.signals["lap"][:, 0]
        if index and laps[index] != laps[index - 1]:
            yield self._on("/trajectory_publisher/lap_completed", int(laps[index]))

    def _on(self, topic: str, *fields: object) -> tuple[str, Any]:
        return topic, self._make(TOPICS[topic], *fields)

    def _vector(self, values: Sequence[float]) -> Any:
        return self._make("geometry_msgs/msg/Vector3", *values)

    def _make(self, kind: str, *fields: object) -> Any:
        return self._types[kind](*fields)


Append = Callable[[Mapping[str, float], Sequence[str], Sequence[Array]], None]

_XYZ = ("x", "y", "z")
#: Signal -> its columns, in the order of the file.
COLUMNS: dict[str, tuple[str, ...]] = {
    "position": _XYZ,
    "velocity": ("vx", "vy", "vz"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "roll_pitch_yaw": ("roll", "pitch", "yaw"),
    "body_rate": ("wx", "wy", "wz"),
    "rotor_speed": tuple(f"rotor_speed_{rotor}" for rotor in range(1, 5)),
    "command": tuple(f"command_{rotor}" for rotor in range(1, 5)),
    "thrust_setpoint": ("thrust_setpoint",),
    "reference_position": tuple(f"ref_{axis}" for axis in _XYZ),
    "reference_velocity": tuple(f"ref_v{axis}" for axis in _XYZ),
    "reference_acceleration": tuple(f"ref_a{axis}" for axis in _XYZ),
}


def write_csv(simulations: Iterable[Simulation], path: Path) -> None:
    """Write flights below each other in one table.

    Units: s, m, m/s (world), degrees for roll, pitch, yaw, rad/s (body), rad/s, commands and thrust
    set-point 0..1; the quaternion is body to world.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    names = [name for columns in COLUMNS.values() for name in columns]
    with flight_table(path) as append:
        for simulation in simulations:
            signals = {
                **simulation.signals,
                "roll_pitch_yaw": roll_pitch_yaw(simulation.signals["attitude"]),
            }
            columns = (simulation.time, *(signals[name] for name in COLUMNS))
            append(simulation.coefficients, names, columns)


def write_forces(simulation: Simulation, append: Append) -> None:
    """Append a flight's forces, one column per term and component, as ``thrust_fz``."""
    if simulation.forces is not None:
        time, of_term = simulation.forces.time, simulation.forces.of_term
        names = [f"{term}_{component}" for term in of_term for component in COMPONENTS]
        append(simulation.coefficients, names, (time, *of_term.values()))


@contextmanager
def flight_table(path: Path) -> Iterator[Append]:
    """Yield a function that appends a flight to a CSV file, which is written atomically.

    Its arguments are the flight's varied coefficients, which are the first columns, the names of
    the columns after ``time``, and time and columns.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    with whole_file(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        begun = False

        def append(
            varied: Mapping[str, float], names: Sequence[str], columns: Sequence[Array]
        ) -> None:
            nonlocal begun
            if not begun:
                writer.writerow([*varied, "time", *names])
                begun = True
            rows = np.column_stack(columns).tolist()
            writer.writerows([*varied.values(), *row] for row in rows)

        yield append


def roll_pitch_yaw(attitude: Array) -> Array:
    """Return (N, 3) degrees of (N, 4) quaternions w, x, y, z; rotation order yaw, pitch, roll."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 (slow to import)

    turns = Rotation.from_quat(attitude, scalar_first=True)
    angles: Array = turns.as_euler("ZYX", degrees=True)[:, ::-1]
    return angles


@dataclass(frozen=True)
class Summary:
    """Summary of one simulated flight.

    Attributes
    ----------
    crash_time
        s; None for a flight that did not crash.
    top_speed
        m/s.
    tracking_rmse
        (x, y, z) m between the vehicle and its reference.
    """

    coefficients: Mapping[str, float]
    crash_time: float | None
    top_speed: float
    tracking_rmse: tuple[float, float, float]


def write_flights(
    simulations: Iterable[Simulation], path: Path, *, forces: Path | None = None
) -> tuple[Summary, ...]:
    """Write flights as a ``.csv``, or a single one as a ROS 1 ``.bag``.

    Parameters
    ----------
    simulations
        The flights, with their forces where ``forces`` is given.
    forces
        A ``.csv`` for force and moment of each term (`tuner.evaluate.closed_loop`).

    Raises
    ------
    InputError
        A file's suffix is another, a bag would hold several flights, or a file cannot be written.
    """
    writers: dict[str, Callable[[Iterator[Simulation], Path], None]] = {
        ".csv": write_csv,
        ".bag": _write_one_bag,
    }
    if path.suffix not in writers:
        raise InputError(path, f"no flight is written as '{path.suffix}'", "name a .csv or a .bag")
    check_file(path)
    if forces is not None:
        if forces.suffix != ".csv" or forces == path:
            raise InputError(forces, "forces are written as a .csv of their own", "name one")
        check_file(forces)
    summaries: list[Summary] = []
    with nullcontext() if forces is None else flight_table(forces) as append:

        def summarised() -> Iterator[Simulation]:
            for simulation in simulations:
                summaries.append(summary_of(simulation))
                if append is not None:
                    write_forces(simulation, append)
                yield simulation

        writers[path.suffix](summarised(), path)
    return tuple(summaries)


def summary_of(simulation: Simulation) -> Summary:
    """Return the summary of a flight."""
    signals = simulation.signals
    error = signals["position"] - signals["reference_position"]
    x, y, z = np.sqrt(np.mean(error**2, axis=0)).tolist()
    speed = np.linalg.norm(signals["velocity"], axis=1)
    return Summary(simulation.coefficients, simulation.crash_time, float(speed.max()), (x, y, z))


def _write_one_bag(simulations: Iterator[Simulation], path: Path) -> None:
    first = next(simulations)
    if next(simulations, None) is not None:
        raise InputError(path, "a bag holds one flight", "write a grid as .csv")
    write_bag(first, path)
