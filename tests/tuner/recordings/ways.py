"""One simulated flight of 14 s, and the many ways in which people write it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path

import numpy as np

from tuner.config import TrajectorySettings
from tuner.evaluate.closed_loop import simulate
from tuner.vehicle import ControllerFile, read_vehicle

VEHICLE = Path(__file__).parents[3] / "configs/vehicles/hovergames_updated.yaml"
RATE = 100.0
XYZ = ("x", "y", "z")


@cache
def flown() -> Mapping[str, np.ndarray]:
    """Return a lemniscate of some metres per second at 100 Hz, by the columns of `table`."""
    shape = TrajectorySettings(name="lemniscate", radius=2.0, omega=0.7, speed_scale=2.1)
    (flight,) = simulate(read_vehicle(VEHICLE), ControllerFile(), shape, duration=14.0, rate=RATE)
    signals = flight.signals
    columns = {"time": flight.time}
    for name, prefix in (
        ("position", ""), ("velocity", "v"), ("body_rate", "w"), ("acceleration", "a"),
    ):  # fmt: skip
        columns |= {f"{prefix}{axis}": signals[name][:, i] for i, axis in enumerate(XYZ)}
    columns |= {f"q{axis}": signals["attitude"][:, i] for i, axis in enumerate(("w", *XYZ))}
    for name in ("rotor_speed", "command"):
        columns |= {f"{name}_{i + 1}": signals[name][:, i] for i in range(4)}
    return columns


def text(
    columns: Mapping[str, np.ndarray | list[str]],
    *,
    separator: str = ",",
    header: str | None = None,
    digits: int = 9,
) -> str:
    """Return columns as lines of text; those of text as they are."""
    cells = [
        [f"{value:.{digits}f}" for value in column] if isinstance(column, np.ndarray) else column
        for column in columns.values()
    ]
    rows = [separator.join(row) for row in zip(*cells, strict=True)]
    return "\n".join([header or separator.join(columns), *rows]) + "\n"


def with_time(change: object, **columns: np.ndarray) -> str:
    """Return the flight as CSV with its times written by a function of (n,) ns since its start."""
    table = dict(flown()) | columns
    table["time"] = change(np.rint(table["time"] * 1e9).astype(np.int64))  # type: ignore[operator]
    return text(table)


EPOCH = 1_775_139_180_000_000_000
"""ns since 1970: 2026-04-02 14:13:00 UTC."""


def stamps(form: str) -> object:
    """Return a function that writes ns as dates, by a form of `datetime` with `%f` for ns."""

    def write(nanoseconds: np.ndarray) -> list[str]:
        times = (nanoseconds + EPOCH).astype("datetime64[ns]")
        days, clock = zip(*(str(time).split("T") for time in times), strict=True)
        return [form.format(date=d, time=c[:12]) for d, c in zip(days, clock, strict=True)]

    return write


TIMES = {
    "seconds": lambda t: t * 1e-9,
    "milliseconds": lambda t: t * 1e-6,
    "microseconds": lambda t: [str(v // 1000) for v in t],
    "nanoseconds": lambda t: [str(v) for v in t],
    "seconds since 1970": lambda t: [f"{(v + EPOCH) // 10**9}.{v % 10**9:09d}" for v in t],
    "milliseconds since 1970": lambda t: [str((v + EPOCH) // 10**6) for v in t],
    "microseconds since 1970": lambda t: [str((v + EPOCH) // 10**3) for v in t],
    "nanoseconds since 1970": lambda t: [str(v + EPOCH) for v in t],
    "microseconds as np.savetxt writes them": lambda t: [f"{v / 1e3:.18e}" for v in t],
    "2026-04-02T14:13:00.123Z": stamps("{date}T{time}Z"),
    "2026-04-02 14:13:00.123": stamps("{date} {time}"),
    "2026/04/02 14:13:00,123": lambda t: [
        '"' + s.replace("-", "/").replace(".", ",") + '"' for s in stamps("{date} {time}")(t)
    ],
    "14:13:00.123": stamps("{time}"),
}
"""How times are written: (n,) ns since the flight's start -> a column."""


def with_speeds(factor: float, *, commands: bool = True) -> str:
    """Return the flight as CSV with its rotor speeds in another unit than rad/s."""
    table = {
        name: factor * column if name.startswith("rotor") else column
        for name, column in flown().items()
        if commands or not name.startswith("command")
    }
    return text(table)


def changed(changes: Mapping[str, Callable[[np.ndarray], np.ndarray]]) -> str:
    """Return the flight as CSV, the columns that begin with some words changed."""
    table = dict(flown())
    for prefix, change in changes.items():
        table |= {name: change(of) for name, of in table.items() if name.startswith(prefix)}
    return text(table)


def volts(factor: float) -> str:
    """Return the flight as CSV with a battery."""
    table = dict(flown())
    return text(table | {"battery_voltage": factor * (16.4 - 0.02 * table["time"])})


VALUES: Mapping[str, tuple[Callable[[], str], str, str | None]] = {
    "commands 0 to 1": (lambda: changed({}), "command", None),
    "commands in microseconds": (
        lambda: changed({"command": lambda u: 1e3 + 1e3 * u}), "command", "in microseconds of PWM",
    ),
    "commands in percent": (
        lambda: changed({"command": lambda u: 100 * u}), "command", "in percent",
    ),
    "commands of 16 bits": (
        lambda: changed({"command": lambda u: np.rint(65535 * u)}), "command", "of 16 bits",
    ),
    "commands from -1 to 1": (
        lambda: changed({"command": lambda u: 2 * u - 1}), "command", "from -1 to 1",
    ),
    "acceleration in g": (
        lambda: changed({"a": lambda a: a / 9.80665}), "acceleration", "in g",
    ),
    "acceleration in thousandths of g": (
        lambda: changed({"a": lambda a: a / 9.80665e-3}), "acceleration", "in thousandths of g",
    ),
    "a battery in millivolts": (lambda: volts(1000.0), "battery_voltage", "in millivolts"),
    "a battery in volts": (lambda: volts(1.0), "battery_voltage", None),
    "body rate in degrees per second": (
        lambda: changed({"w": np.degrees}), "body_rate", "in degrees per second",
    ),
    "position and velocity in millimetres": (
        lambda: changed({axis: lambda p: 1000 * p for axis in ("x", "y", "z", "v")}),
        "position", "in millimetres",
    ),
    "lengths in feet": (
        lambda: changed({axis: lambda p: p / 0.3048 for axis in (*XYZ, "v")}),
        "position", "in feet",
    ),
    "position in centimetres": (
        lambda: changed({axis: lambda p: 100 * p for axis in XYZ}), "position", "in centimetres",
    ),
}  # fmt: skip
"""Way -> CSV, the signal in another unit, and what is said of it."""


def angles(factor: float = 1.0) -> dict[str, np.ndarray]:
    """Return roll, pitch and yaw of the flight, in radians times a factor."""
    w, x, y, z = (flown()[f"q{axis}"] for axis in ("w", *XYZ))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(2 * (w * y - z * x))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return {"roll": factor * roll, "pitch": factor * pitch, "yaw": factor * yaw}


def gentle(tilt: float, factor: float) -> dict[str, np.ndarray]:
    """Return a pose that rolls by up to `tilt` / 2 rad and drifts as gravity then pushes it."""
    time = np.arange(0.0, 20.0, 1 / RATE)
    roll = 0.5 * tilt * np.sin(2.0 * time)
    across = 9.81 * 0.5 * tilt * np.sin(2.0 * time) / 4.0
    nothing = np.zeros_like(time)
    where = {"time": time, "x": nothing, "y": across, "z": nothing + 1.0}
    return where | {"roll": factor * roll, "pitch": nothing, "yaw": nothing}


POSE = ("time", "x", "y", "z", "qw", "qx", "qy", "qz")
COMMANDS = tuple(f"command_{i}" for i in range(1, 5))


def renamed(names: Mapping[str, str], **form: str) -> str:
    """Return some columns of the flight as CSV, under other names."""
    return text({new: flown()[old] for new, old in names.items()}, **form)


def pose(*names: str, **form: str) -> str:
    """Return the flight's pose as CSV, its columns under other names."""
    return renamed(dict(zip(names, POSE, strict=True)), **form)


def comma(content: str) -> str:
    """Return CSV as spreadsheets write it where numbers have a decimal comma."""
    return content.replace(",", ";").replace(".", ",")


_PLOTJUGGLER = {
    "__time": "time",
    **{f"/optitrack/pose/pose/position/{a}": a for a in XYZ},
    **{f"/optitrack/pose/pose/orientation/{a}": f"q{a}" for a in (*XYZ, "w")},
    **{f"/mavros/imu/data/angular_velocity/{a}": f"w{a}" for a in XYZ},
    **{f"/mavros/imu/data/linear_acceleration/{a}": f"a{a}" for a in XYZ},
    **{f"/mavros/rc/out/channels[{i}]": f"command_{i + 1}" for i in range(4)},
}
_ECHO = {
    "%time": "time",
    **{f"field.pose.position.{a}": a for a in XYZ},
    **{f"field.pose.orientation.{a}": f"q{a}" for a in (*XYZ, "w")},
}


def echoed() -> str:
    """Return a pose as `rostopic echo -p` prints it."""
    lines = renamed(_ECHO).splitlines()
    rows = []
    for row in lines[1:]:
        seconds, _, rest = row.partition(",")
        rows.append(f"{EPOCH + round(float(seconds) * 1e9)},{rest}")
    return "\n".join([lines[0], *rows]) + "\n"


TABLES: Mapping[str, Callable[[], str | bytes]] = {
    "time,x,y,z,qw,...": lambda: pose(*POSE),
    "t,x,y,z,qx,qy,qz,qw": lambda: renamed(
        {"t": "time", **{n: n for n in ("x", "y", "z", "qx", "qy", "qz", "qw")}}
    ),
    "timestamp,X,Y,Z": lambda: pose("timestamp", "X", "Y", "Z", "QW", "QX", "QY", "QZ"),
    "Time (s),X (m)": lambda: pose("Time (s)", "X (m)", "Y (m)", "Z (m)", *POSE[4:]),
    "t,x [m]": lambda: pose("t [s]", "x [m]", "y [m]", "z [m]", *POSE[4:]),
    "pose.position.x": lambda: pose(
        "time",
        *(f"pose.position.{a}" for a in XYZ),
        *(f"pose.orientation.{a}" for a in ("w", *XYZ)),
    ),
    "x_estimate": lambda: pose("t", "x_estimate", "y_estimate", "z_estimate", *POSE[4:]),
    "posX,quatW": lambda: pose("Time", "posX", "posY", "posZ", "quatW", "quatX", "quatY", "quatZ"),
    "p_x,q_w": lambda: pose("t", "p_x", "p_y", "p_z", "q_w", "q_x", "q_y", "q_z"),
    "PlotJuggler": lambda: renamed(_PLOTJUGGLER),
    "rostopic echo -p": echoed,
    "a first line with #": lambda: "# " + pose(*POSE),
    "lines of comments before": lambda: "# lab, 2026\n# with OptiTrack\n" + pose(*POSE),
    "a row of units": lambda: pose(*POSE).replace("\n", "\ns,m,m,m,-,-,-,-\n", 1),
    "a row of other units": lambda: text(
        {n: 1e3 * flown()[n] if n in ("time", *XYZ) else flown()[n] for n in POSE}
    ).replace("\n", "\n[ms],[mm],[mm],[mm],[],[],[],[]\n", 1),
    "semicolons and decimal commas": lambda: comma(pose(*POSE)),
    "a spreadsheet's line on its separator": lambda: "sep=;\n" + comma(pose(*POSE)),
    "tabs": lambda: pose(*POSE, separator="\t"),
    "tabs and decimal commas": lambda: pose(*POSE, separator="\t").replace(".", ","),
    "blanks": lambda: "# " + pose(*POSE, separator="  "),
    "UTF-16": lambda: pose(*POSE).encode("utf-16"),
    "UTF-8 with a mark": lambda: pose(*POSE).encode("utf-8-sig"),
    "blanks around": lambda: pose(*POSE, separator=" , ").replace("\n", "  \n"),
    "a separator at each end": lambda: pose(*POSE).replace("\n", ",\n"),
    "a separator at each row's end": lambda: (
        pose(*POSE).replace("\n", ",\n").replace(",\n", "\n", 1)
    ),
    "quoted names": lambda: '"' + pose(*POSE).replace("\n", '"\n', 1).replace(",", '","', 7),
    "lines of Windows": lambda: pose(*POSE).replace("\n", "\r\n"),
    "an index first": lambda: "\n".join(
        f"{i - 1 if i else ''},{row}" for i, row in enumerate(pose(*POSE).splitlines())
    ),
    "an index without a name, as of R": lambda: "\n".join(
        f"{i},{row}" if i else row for i, row in enumerate(pose(*POSE).splitlines())
    ),
}
"""Way -> the content of a table that holds a pose."""

NOT_READ: Mapping[str, tuple[Callable[[], str], str]] = {
    "no time": (
        lambda: renamed({n: n for n in POSE[1:]}), "no column that is a time among x, y, z",
    ),
    "two cells without a name": (
        lambda: pose(*POSE).replace("\n", ",1,2\n").replace(",1,2\n", "\n", 1),
        "has no row of 8 cells beneath its line of column names",
    ),
    "no rows": (lambda: pose(*POSE).partition("\n")[0] + "\n", "has no row of 8 cells"),
    "a cell without an end": (
        lambda: pose(*POSE).partition("\n")[0] + "\n" + "1" * 200_000, "has no row of 8 cells"
    ),
    "no attitude": (
        lambda: renamed({n: n for n in POSE[:4]}), "by their names are its attitude, among time, x",
    ),
    "other names": (
        lambda: pose("time", "north", "east", "up", *POSE[4:]),
        "by their names are its position, among time, north",
    ),
    "no line of names": (
        lambda: pose(*POSE).partition("\n")[2], "has no line of column names",
    ),
}  # fmt: skip
"""Way -> a table that is not read, and how the line that says why begins."""


def structures() -> dict[str, dict[str, object]]:
    """Return the flight as a lab's structures: the pose in s, the rest at half the rate in ms."""
    f = flown()
    half = slice(None, None, 2)
    return {
        "mocap": {
            "t": f["time"],
            "pos": np.column_stack([f[a] for a in XYZ]),
            "quat": np.column_stack([f[f"q{a}"] for a in ("w", *XYZ)]),
        },
        "px4": {
            "time": 1e3 * f["time"][half],
            "gyro": np.column_stack([f[f"w{a}"] for a in XYZ])[half],
            "motors": np.column_stack([f[c] for c in COMMANDS])[half],
        },
    }
