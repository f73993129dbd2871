"""What becomes of one flight in each of the ways in which people write it."""

from __future__ import annotations

import io
import struct
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import signal
from scipy.io import savemat

from tests.tuner.recordings import making, ways
from tuner.config import resolve_settings
from tuner.core.errors import ConfigError, RecordingError
from tuner.findings.findings import one_line
from tuner.objective.rotor_signals import levers, order_findings
from tuner.options import Options
from tuner.recordings.consistency import _axis_doubts
from tuner.recordings.content import ReadOptions, read_content
from tuner.recordings.flight import Flight, Series
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.inspection_rules import suggested_map
from tuner.recordings.interpolation import rotate
from tuner.recordings.loader import load_flight, read_inertial
from tuner.recordings.matlab import MAGIC
from tuner.recordings.notes import NoteCode, note_in_words
from tuner.search.job_flights import inlet_for, read_recordings
from tuner.vehicle import read_vehicle, with_values

COLUMNS = {
    "position": ("x", "y", "z"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "body_rate": ("wx", "wy", "wz"),
    "acceleration": ("ax", "ay", "az"),
    "rotor_speed": tuple(f"rotor_speed_{i}" for i in range(1, 5)),
    "command": tuple(f"command_{i}" for i in range(1, 5)),
}


def assert_same(
    flight: Flight, signals: tuple[str, ...] = tuple(COLUMNS), share: float = 2e-3
) -> None:
    """Check that a flight holds what was flown, to the digits that were written."""
    truth = ways.flown()
    assert flight.duration == pytest.approx(14.0, abs=0.05)
    for name in signals:
        expected = np.column_stack([truth[column] for column in COLUMNS[name]])
        got = flight.series[name]
        again = np.column_stack(
            [np.interp(truth["time"], got.time, column) for column in got.values.T]
        )
        size = np.abs(expected).max()
        inside = slice(5, -5)
        assert np.abs(again - expected)[inside].max() < share * size, name


def read(folder: Path, content: str) -> Flight:
    path = folder / "flight.csv"
    path.write_text(content)
    return load_flight(path)


@pytest.mark.parametrize("way", ways.TIMES)
def test_time_in(way: str, tmp_path: Path) -> None:
    flight = read(tmp_path, ways.with_time(ways.TIMES[way]))
    assert_same(flight)
    said = [note_in_words(n) for n in flight.notes if n.code is NoteCode.UNIT_READ]
    unit = way.split(" ", maxsplit=1)[0]
    told = unit in ("milliseconds", "microseconds", "nanoseconds")
    assert said == ([f"time is in {unit}, which the topic map does not say: read so"] * told)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: [f"{(v + ways.EPOCH) * 1e-9:.6e}" for v in t], "has too few digits"),
        (lambda t: [f"{(v + ways.EPOCH) * 1e-9:.0f}" for v in t], "has too few digits"),
        (lambda t: [f"day {v}" for v in t], "neither a number nor a date"),
        (lambda t: t * 1e3, "no step of a flight"),
    ],
)
def test_time_that_cannot_be_told_is_named(change, message: str, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=message) as caught:
        read(tmp_path, ways.with_time(change))
    assert "\n" not in str(caught.value)


def test_rows_in_the_opposite_order_are_read_by_their_times(tmp_path: Path) -> None:
    names, *rows = ways.with_time(ways.TIMES["milliseconds"]).splitlines()
    flight = read(tmp_path, "\n".join([names, *reversed(rows)]))
    assert_same(flight)
    assert NoteCode.UNIT_READ in {note.code for note in flight.notes}


def test_quick_microseconds_are_no_slow_milliseconds(tmp_path: Path) -> None:
    """At 4 kHz their step is that of milliseconds at 4 Hz; gravity knows better."""
    truth = ways.flown()
    fine = np.arange(0.0, 14.0, 1 / 4000)
    names = (*COLUMNS["position"], *COLUMNS["attitude"])
    columns = {name: np.interp(fine, truth["time"], truth[name]) for name in names}
    table = {"time": np.rint(1e6 * fine), **columns}
    flight = read(tmp_path, ways.text(table, digits=6))
    assert_same(flight, ("position", "attitude"))
    assert NoteCode.TIME_READ in {note.code for note in flight.notes}


def as_fitted(path: Path, **values: float) -> Flight:
    """Return a recording as a fit takes it, of a vehicle with some other coefficients."""
    vehicle = with_values(read_vehicle(ways.VEHICLE), values)
    (recording,) = read_recordings(resolve_settings(Options([str(path)], vehicle=vehicle)))[0]
    return recording.flight


@pytest.mark.parametrize("commands", [True, False], ids=["commands", "no commands"])
@pytest.mark.parametrize(
    ("factor", "name"), [(1.0, None), (30 / np.pi, "a minute"), (0.5 / np.pi, "a second")]
)
def test_rotor_speeds_in(factor: float, name: str | None, commands: bool, tmp_path: Path) -> None:
    """Also from a vehicle file whose motor constant is twice and a half times too small."""
    path = tmp_path / "flight.csv"
    path.write_text(ways.with_speeds(factor, commands=commands))
    for values in ({}, {"motor_constant": 0.4 * 1.386e-5}):
        flight = as_fitted(path, **values)
        assert_same(flight, ("rotor_speed",))
        assert flight.initial.rotor_speed == pytest.approx(
            [ways.flown()[f"rotor_speed_{i}"][0] for i in range(1, 5)], rel=0.1
        )
        said = [note_in_words(n) for n in flight.notes if n.code is NoteCode.UNIT_READ]
        assert said == [
            f"rotor_speed is in revolutions {name}, which the topic map does not say: read so"
        ] * (name is not None)


def test_rotor_speeds_that_carry_the_vehicle_in_no_unit_are_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(ways.with_speeds(3.0, commands=False))
    with pytest.raises(
        RecordingError, match=r"9\.\d times the weight in rad/s.*unit \(si, rpm"
    ) as e:
        as_fitted(path)
    assert "\n" not in str(e.value)
    (tmp_path / "own.yaml").write_text(
        "name: own\nformat: table\nextends: table\nsignals:\n  rotor_speed: {fields: "
        "[rotor_speed_1, rotor_speed_2, rotor_speed_3, rotor_speed_4], unit: si}\n"
    )
    path.with_suffix(".yaml").write_text("topics: own.yaml\n")
    assert as_fitted(path).has("rotor_speed")


@pytest.mark.parametrize("way", ways.VALUES)
def test_values_of(way: str, tmp_path: Path) -> None:
    content, signal, unit = ways.VALUES[way]
    flight = read(tmp_path, content())
    assert_same(flight)
    codes = (NoteCode.UNIT_READ, NoteCode.FRAME_TURNED)
    said = [n.names[1] for n in flight.notes if n.code in codes and n.names[0] == signal]
    assert said == [unit] * (unit is not None)
    if signal == "battery_voltage":
        assert flight.series[signal].values[0] == pytest.approx(16.4)


@pytest.mark.parametrize("late", [-0.1, 0.0, 0.3])
def test_a_pose_that_is_late_in_its_table_is_moved_and_nothing_else(
    late: float, tmp_path: Path
) -> None:
    table = dict(ways.flown())
    time = table["time"]
    for name in (*ways.POSE[1:], "vx", "vy", "vz"):
        table[name] = np.interp(time - late, time, table[name])
    flight = read(tmp_path, ways.text(table))
    moved = [n.numbers["seconds"] for n in flight.notes if n.code is NoteCode.POSE_MOVED]
    assert moved == ([pytest.approx(late, abs=2e-3)] if late else [])
    middle = flight.time[len(flight.time) // 4 : -len(flight.time) // 4]
    for name, prefix, allowed in (("position", "", 0.01), ("velocity", "v", 0.05)):
        series = flight.series[name]
        flown = ways.flown()[f"{prefix}x"]
        there = np.interp(middle, series.time, series.values[:, 0])
        begin = flight.series["command"].time[0]
        assert there == pytest.approx(np.interp(middle - begin, time, flown), abs=allowed)


@pytest.mark.parametrize("unit", [1.0, 0.3048, 0.01])
def test_a_reference_is_read_in_the_unit_of_the_position(unit: float, tmp_path: Path) -> None:
    """Where it was written in the same unit; a planner's may be in metres beside it."""
    metres = ways.flown() | {f"ref_{axis}": ways.flown()[axis] for axis in ways.XYZ}
    for own in (1.0, unit):
        lengths = {axis: ways.flown()[axis] / unit for axis in ways.XYZ}
        wanted = {f"ref_{axis}": ways.flown()[axis] / own for axis in ways.XYZ}
        flight = read(tmp_path, ways.text(metres | lengths | wanted))
        position, reference = (
            flight.series[name].values for name in ("position", "reference_position")
        )
        assert reference == pytest.approx(position, abs=1e-6)


@pytest.mark.parametrize("change", [lambda u: 47 + 1500 * u, lambda u: 10 * u, lambda u: 1e4 * u])
def test_commands_in_no_certain_unit_are_dropped_with_a_warning(change, tmp_path: Path) -> None:
    flight = read(tmp_path, ways.changed({"command": change}))
    assert not flight.has("command")
    (note,) = [n for n in flight.notes if n.code is NoteCode.UNIT_UNKNOWN]
    assert note.kind == "warning"
    assert note_in_words(note).endswith("give command its 'unit' in the topic map")


@pytest.mark.parametrize("standing", [0.0, 0.7])
def test_commands_of_a_log_in_steps_are_not_read_as_pulses(
    standing: float, tmp_path: Path, short: Path
) -> None:
    """Nor where they are zero for most of the time, of motors that stand before they idle."""
    columns = making.px4_messages(short)
    pulses = columns["actuator_outputs"]
    steps = 48 + 1999 * (pulses.values / 1000 - 1)
    columns["actuator_outputs"] = making.Column(pulses.time, steps)
    first = int(standing * len(steps))
    steps[:first], steps[first : first + len(steps) // 20] = 0, 158
    boot = int(pulses.time[0]) - 5_000_000_000
    path = making.to_ulog(columns, tmp_path / "log.ulg", boot=boot)
    flight = load_flight(path)
    assert not flight.has("command")
    (note,) = [n for n in flight.notes if n.code is NoteCode.UNIT_UNKNOWN]
    assert (note.kind, note.names[0]) == ("warning", "command")
    (tmp_path / "own.yaml").write_text(
        "name: own\nformat: ulog\nextends: px4_ulog\nsignals:\n"
        "  command: {topic: actuator_outputs, unit: dshot}\n"
    )
    told = read_content(ReadOptions.of(path, tmp_path / "own.yaml")).series["command"].values
    assert np.median(told[-100:], axis=0) == pytest.approx(
        np.median(pulses.values[-100:], axis=0) / 1000 - 1
    )


@pytest.mark.parametrize("unit", ["deg", "si"])
@pytest.mark.parametrize("slow", [1.0, 0.05])
def test_angles(unit: str, slow: float, tmp_path: Path) -> None:
    """Slow flights tilt by a degree, or a radian: gravity knows which."""
    path, truth = tmp_path / "flight.csv", ways.flown()
    table = {name: truth[name] for name in ("time", "x", "y", "z")}
    table |= ways.angles(1.0 if unit == "si" else np.degrees(1.0))
    if slow < 1:
        table = ways.gentle(slow, np.degrees(1.0) if unit == "deg" else 1.0)
    path.write_text(ways.text(table))
    (tmp_path / "own.yaml").write_text(
        "name: own\nformat: table\ntime: time\nsignals:\n  position: [x, y, z]\n"
        "  attitude: {fields: [roll, pitch, yaw], quaternion: rpy}\n"
    )
    flight = load_flight(path, topics=tmp_path / "own.yaml")
    tilt = np.abs(flight.series["attitude"].values[:, 1:3]).max()
    assert tilt == pytest.approx(0.49 if slow == 1.0 else slow / 4, rel=0.2)
    said = [n.names[1] for n in flight.notes if n.code is NoteCode.UNIT_READ]
    assert said == ["in degrees"] * (unit == "deg")


@pytest.mark.parametrize("way", ways.TABLES)
def test_table_with(way: str, tmp_path: Path) -> None:
    content, path = ways.TABLES[way](), tmp_path / "flight.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    flight = load_flight(path)
    assert_same(flight, ("position", "attitude"))
    if way == "PlotJuggler":
        assert_same(flight, ("body_rate", "acceleration", "command"))
    assert not [n for n in flight.notes if n.code in ("outliers", "not_a_number")]
    assert not flight.damage


@pytest.mark.parametrize("way", ways.NOT_READ)
def test_what_stands_in_the_way_is_named(way: str, tmp_path: Path) -> None:
    content, message = ways.NOT_READ[way]
    with pytest.raises(RecordingError) as caught:
        read(tmp_path, content())
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("way", ["PlotJuggler", "posX,quatW", "a row of other units"])
def test_a_suggested_map_reads_the_table_alike(way: str, tmp_path: Path) -> None:
    content, path = ways.TABLES[way](), tmp_path / "flight one.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    suggestion = suggested_map(path)
    (tmp_path / "own.yaml").write_text(suggestion)
    assert_same(load_flight(path, topics=tmp_path / "own.yaml"), ("position", "attitude"))
    assert "# rotor_speed: {fields: [..., ..., ..., ...], unit: si}" in suggestion


def test_a_suggestion_says_units_by_numbers_and_what_is_not_used(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(
        ways.changed(
            {"x": lambda p: 1e3 * p, "y": lambda p: 1e3 * p, "z": lambda p: 1e3 * p}
        ).replace("wz", 'odd""#', 1)
    )
    suggestion = suggested_map(path)
    assert "by the numbers in millimetres" in suggestion
    assert "# not used: " in suggestion


MATRIX = ("time", *COLUMNS["position"], *COLUMNS["attitude"])


def test_matlab_structures_each_with_a_time_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "flight.mat"
    savemat(path, ways.structures(), do_compression=True)
    assert_same(load_flight(path), ("position", "attitude", "body_rate", "command"), 0.03)


def test_matlab_structure_of_simulink(tmp_path: Path) -> None:
    table = ways.flown()
    signals = [{"values": table[name], "label": name} for name in MATRIX[1:]]
    savemat(tmp_path / "flight.mat", {"out": {"time": table["time"], "signals": signals}})
    assert_same(load_flight(tmp_path / "flight.mat"), ("position", "attitude"))


@pytest.mark.parametrize("transposed", [False, True])
def test_matlab_matrix_needs_names(transposed: bool, tmp_path: Path) -> None:
    matrix, path = np.column_stack([ways.flown()[n] for n in MATRIX]), tmp_path / "flight.mat"
    savemat(path, {"data": matrix.T if transposed else matrix})
    with pytest.raises(RecordingError, match="bare matrix 'data' of 8 columns") as caught:
        load_flight(path)
    assert "\n" not in str(caught.value)
    (tmp_path / "own.yaml").write_text(
        "name: own\nformat: table\ntime: 'data[0]'\nsignals:\n"
        "  position: ['data[1]', 'data[2]', 'data[3]']\n"
        "  attitude: ['data[4]', 'data[5]', 'data[6]', 'data[7]']\n"
    )
    assert_same(load_flight(path, topics=tmp_path / "own.yaml"), ("position", "attitude"))


def test_matlab_arrays_beside_each_other(tmp_path: Path) -> None:
    savemat(tmp_path / "flight.mat", {name: ways.flown()[name] for name in MATRIX})
    assert_same(load_flight(tmp_path / "flight.mat"), ("position", "attitude"))


def _hdf5(h5py: object, path: Path) -> None:
    with h5py.File(path, "w", userblock_size=512) as file:  # type: ignore[attr-defined]
        for name, fields in ways.structures().items():
            group = file.create_group(name)
            for field, values in fields.items():
                group[field] = np.atleast_2d(np.asarray(values).T)
        group["else"] = h5py.ExternalLink("/etc/passwd", "x")  # type: ignore[attr-defined]
    with path.open("r+b") as stream:
        stream.write(b"MATLAB 7.3 MAT-file".ljust(512, b" "))


def test_matlab_of_version_7_3(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    _hdf5(h5py, tmp_path / "flight.mat")
    flight = load_flight(tmp_path / "flight.mat")
    assert_same(flight, ("position", "attitude", "body_rate", "command"), 0.03)


def test_matlab_of_version_7_3_without_h5py(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    (tmp_path / "flight.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512, b" "))
    with pytest.raises(RecordingError, match=r"install multirotor-tune\[matlab\], or save"):
        load_flight(tmp_path / "flight.mat")


def _nested(depth: int) -> bytes:
    """Return a MATLAB file of cells inside cells."""
    header = struct.pack("<IIIIIIiiII", 6, 8, 1, 0, 5, 8, 1, 1, 1, 0)
    size, parts = 0, []
    for _ in range(depth):
        size += len(header)
        parts.append(struct.pack("<II", 14, size) + header)
        size += 8
    return MAGIC.ljust(124) + b"\0\1IM" + b"".join(reversed(parts))


def _of_type(kind: int) -> bytes:
    """Return a MATLAB file whose numbers say that they are of a type."""
    written = io.BytesIO()
    savemat(written, {"t": np.arange(50.0)})
    return written.getvalue().replace(struct.pack("<II", 9, 400), struct.pack("<II", kind, 400))


@pytest.mark.parametrize("content", [
    _nested(30_000),
    _of_type(8),
    _of_type(14),
    _of_type(20),
    MAGIC.ljust(124) + b"\0\1IM" + struct.pack("<II", 15, 40) + b"x" * 40,
    MAGIC.ljust(124) + b"\0\1IM",
    MAGIC,
])  # fmt: skip
def test_hostile_matlab_files_are_refused_in_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "flight.mat").write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        load_flight(tmp_path / "flight.mat")
    assert "\n" not in str(caught.value)


ORDERS = {"betaflight": (4, 1, 2, 3), "crazyflie": (1, 4, 2, 3), "[3, 1, 4, 2]": (2, 4, 1, 3)}
"""How a motor order is written -> the rotor, in PX4's order, that each recorded motor drives."""


def in_order(folder: Path, rotors: tuple[int, ...]) -> Path:
    table = dict(ways.flown())
    for name in ("command", "rotor_speed"):
        held = [ways.flown()[f"{name}_{rotor}"] for rotor in rotors]
        table |= {f"{name}_{i + 1}": column for i, column in enumerate(held)}
    path = folder / "flight.csv"
    path.write_text(ways.text(table))
    return path


@pytest.mark.parametrize("order", ORDERS)
def test_motor_order(order: str, tmp_path: Path) -> None:
    path, vehicle = in_order(tmp_path, ORDERS[order]), read_vehicle(ways.VEHICLE)
    (tmp_path / "own.yaml").write_text(
        f"name: own\nformat: table\nextends: table\nmotor_order: {order}\nsignals: {{}}\n"
    )
    read_so = load_flight(path, topics=tmp_path / "own.yaml")
    assert_same(read_so)
    ordered = vehicle.replace(motor_order=yaml.safe_load(order))
    (recording,) = read_recordings(resolve_settings(Options([str(path)], vehicle=ordered)))[0]
    assert_same(recording.flight)
    path.with_suffix(".yaml").write_text(f"motor_order: {order}\n")
    assert_same(load_flight(path))


@pytest.mark.parametrize("order", ORDERS)
def test_the_line_on_a_wrong_motor_order_says_which_fits(order: str) -> None:
    vehicle, step = read_vehicle(ways.VEHICLE), 1 / 200
    time = np.arange(0.0, 14.0, step)
    noise = np.random.default_rng(4).normal(0.0, 0.6, (len(time), 4))
    command = 0.6 + signal.lfilter([step / 0.1], [1, step / 0.1 - 1], noise, axis=0)
    turning = np.square(100 + 950 * command) @ levers(vehicle) * [4e-4, 4e-4, 2e-3]
    rate = np.cumsum(turning - turning.mean(axis=0), axis=0) * step
    rate -= signal.lfilter([step], [1, step - 1], rate, axis=0)
    recorded = command[:, [rotor - 1 for rotor in ORDERS[order]]]
    series = {"body_rate": Series(time, rate), "command": Series(time, recorded)}
    (wrong,) = order_findings("flight", series, vehicle, (0.0, 14.0))
    assert f"Write motor_order: {order} into the topic map" in one_line(wrong)
    for name, signal_of in series.items():  # a column that was never measured
        values = np.array(signal_of.values)
        values[:, 2] = np.nan
        dead = {**series, name: Series(time, values)}
        assert order_findings("flight", dead, vehicle, (0.0, 14.0)) == ()


def test_a_motor_order_that_is_none_is_refused(tmp_path: Path) -> None:
    path = in_order(tmp_path, (1, 2, 3, 4))
    for order in ("[1, 1, 2, 3]", "betaflite"):
        path.with_suffix(".yaml").write_text(f"motor_order: {order}\n")
        with pytest.raises(ConfigError, match="motor_order") as caught:
            load_flight(path)
        assert "\n" not in str(caught.value)


def test_a_pose_alone_is_said_to_be_that(tmp_path: Path) -> None:
    flight = read(tmp_path, ways.pose(*ways.POSE))
    (note,) = [n for n in flight.notes if n.code is NoteCode.POSE_ALONE]
    assert note.kind == "warning"
    with pytest.raises(RecordingError, match="holds a pose alone, and neither a reference"):
        as_fitted(tmp_path / "flight.csv")


@pytest.mark.parametrize(("factor", "outcome"), [(1.0, "si"), (20.0, "ask"), (500.0, "deg/s")])
def test_the_unit_of_a_gyro_without_a_pose(factor: float, outcome: str, tmp_path: Path) -> None:
    time = np.arange(0.0, 10.0, 1 / 200)
    turning = {f"w{a}": factor * 0.3 * np.sin(3 * time + i) for i, a in enumerate(ways.XYZ)}
    force = {f"a{a}": 9.81 * (a == "z") + 0.0 * time for a in ways.XYZ}
    table = {"time": time, **turning, **force, **dict.fromkeys(ways.COMMANDS, 0.5 + 0.0 * time)}
    path = tmp_path / "flight.csv"
    path.write_text(ways.text(table))
    if outcome == "ask":
        with pytest.raises(RecordingError, match=r"may be in rad/s or deg/s.*si or deg/s"):
            read_inertial(path)
        return
    flight = read_inertial(path)
    assert flight is not None
    scale = 1.0 if outcome == "si" else np.radians(1.0)
    expected = scale * factor * 0.3
    assert np.abs(flight.series["body_rate"].values).max() == pytest.approx(expected, rel=0.01)


def _turned(degrees: float) -> str:
    """Return the flight as CSV, of a marker body that was defined with another heading."""
    half = np.radians(degrees) / 2
    w, x, y, z = (ways.flown()[f"q{axis}"] for axis in "wxyz")
    turned = {
        "qw": w * np.cos(half) - z * np.sin(half),
        "qx": x * np.cos(half) + y * np.sin(half),
        "qy": y * np.cos(half) - x * np.sin(half),
        "qz": z * np.cos(half) + w * np.sin(half),
    }
    return ways.text(dict(ways.flown()) | turned)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (lambda: ways.changed({}), set()),
        (lambda: ways.changed({"q": lambda q: 0.99 * q}), set()),
        (lambda: ways.changed({"wy": lambda w: -w}), {("body_rate", "y", -1.0)}),
        (lambda: ways.changed({"wx": lambda w: 1.1 * w}), {("body_rate", "x", 1.1)}),
        (
            lambda: ways.changed({"time": lambda t: 1.1 * t}),
            {("body_rate", axis, 1.1) for axis in "xyz"},
        ),
        (
            lambda: ways.changed({"vx": lambda v: 0.5 * v, "vy": lambda v: 0.5 * v}),
            {("velocity", axis, 0.5) for axis in "xy"},
        ),
        (
            lambda: ways.changed({"z": lambda z: -z, "vz": lambda v: -v}),
            {("acceleration", "z", -1.0)},
        ),
        (lambda: ways.changed({"ay": lambda a: -a}), {("acceleration", "y", -0.7)}),
    ],
)
def test_single_axes_that_deny_the_pose_are_named(content, said: set, tmp_path: Path) -> None:
    notes = [n for n in read(tmp_path, content()).notes if n.code is NoteCode.AXIS_DOUBTED]
    assert {(*n.names[:2], round(n.numbers["times"], 1)) for n in notes} == said
    assert all(note.kind == "warning" for note in notes)


def _late(prefix: str, seconds: float) -> str:
    """Return the flight with the columns of some names late."""
    table = dict(ways.flown())
    late = {f"{prefix}{a}": table[f"{prefix}{a}"] for a in ways.XYZ}
    late = {n: np.interp(table["time"] - seconds, table["time"], v) for n, v in late.items()}
    return ways.text(table | late)


@pytest.mark.parametrize(("prefix", "seconds", "late"), [("", 0.2, 0.2), ("v", 0.15, -0.15)])
def test_a_position_that_is_late_by_itself_is_named(
    prefix: str, seconds: float, late: float, tmp_path: Path
) -> None:
    flight = read(tmp_path, _late(prefix, seconds))
    notes = [n for n in flight.notes if n.code is NoteCode.SIGNAL_LATE]
    assert ("velocity", "position") in {note.names for note in notes}
    assert [n.numbers["seconds"] for n in notes] == [pytest.approx(late, abs=0.03)] * len(notes)
    assert not [n for n in read(tmp_path, _late("v", 0.05)).notes if n.kind == "warning"]


@pytest.mark.parametrize("times", [0.5, 2.0])
def test_a_clock_of_another_rate_is_named_once(times: float, tmp_path: Path) -> None:
    notes = read(tmp_path, ways.changed({"time": lambda t: times * t})).notes
    (note,) = [n for n in notes if n.code is NoteCode.CLOCK_DOUBTED]
    assert note.numbers["times"] == pytest.approx(times, abs=0.05)
    assert NoteCode.AXIS_DOUBTED not in {n.code for n in notes}


def test_speeds_in_kilometres_per_hour_are_read(tmp_path: Path) -> None:
    flight = read(tmp_path, ways.changed({"v": lambda v: 3.6 * v}))
    assert flight.series["velocity"].values[:, 0] == pytest.approx(ways.flown()["vx"], abs=1e-3)
    (note,) = [n for n in flight.notes if n.code is NoteCode.FRAME_TURNED]
    assert note.names == ("velocity", "in kilometres per hour, not feet per second")


@pytest.mark.parametrize(("share", "said"), [(1.0, False), (0.6, True)])
def test_a_gyro_that_saturates_is_named(share: float, said: bool, tmp_path: Path) -> None:
    limit = share * np.abs(ways.flown()["wx"]).max()
    flight = read(tmp_path, ways.changed({"w": lambda w: np.clip(w, -limit, limit)}))
    notes = [n for n in flight.notes if n.code is NoteCode.GYRO_SATURATED]
    assert [n.numbers["limit"] for n in notes] == [pytest.approx(limit)] * said
    assert all(n.kind == "warning" and n.count > 12 for n in notes)


@pytest.mark.parametrize(("wobble", "doubted"), [(0.1, ""), (1.0, "y")])
def test_a_spin_seen_by_tilted_markers_is_not_another_size(wobble: float, doubted: str) -> None:
    """Of a fast spin, two degrees of tilt show a part about y as large as a small wobble."""
    time = np.arange(0.0, 20.0, 0.01)
    spin = 2.0 * np.sin(time)
    turning = np.column_stack([0.0 * time, wobble * np.sin(time), spin])
    gyro = turning + np.column_stack([0.0 * time, 0.1 * wobble * np.sin(time), 0.0 * time])
    notes = _axis_doubts(turning, gyro, ("body_rate", "attitude"))
    assert "".join(note.names[1] for note in notes) == doubted


@pytest.mark.parametrize("degrees", [0.0, 10.0, 45.0])
def test_a_marker_body_of_another_heading_is_turned(degrees: float, tmp_path: Path) -> None:
    flight = read(tmp_path, _turned(degrees))
    assert_same(flight, share=0.02)
    notes = [n for n in flight.notes if n.code is NoteCode.FRAME_TURNED]
    assert [n.names for n in notes] == (
        [("attitude", f"of markers turned left by {degrees:.0f} degrees")] if degrees else []
    )


@pytest.mark.parametrize("value", [0.0, 500.0])
def test_a_rotor_speed_that_never_changes_is_none(value: float, tmp_path: Path) -> None:
    flight = read(tmp_path, ways.changed({"rotor_speed_3": lambda n: 0 * n + value}))
    assert np.isnan(flight.series["rotor_speed"].values[:, 2]).all()
    (note,) = [n for n in flight.notes if n.code is NoteCode.NO_TACHOMETER]
    assert note.names == ("3",)
    if not value:
        assert not read(tmp_path, ways.changed({"rotor_speed": lambda n: 0 * n})).has("rotor_speed")


@pytest.mark.parametrize("step", [-3600.0, 3600.0])
def test_a_clock_that_is_set_in_flight_parts_it(step: float, tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(ways.changed({"time": lambda t: np.where(t > 7.0, t + step, t)}))
    recordings, _ = read_recordings(
        resolve_settings(Options([str(path)], vehicle=str(ways.VEHICLE)))
    )
    assert [recording.flight.duration for recording in recordings] == [
        pytest.approx(7.0, abs=0.1)
    ] * 2


def test_commands_of_a_rotor_that_never_change_are_not_believed(tmp_path: Path) -> None:
    flight = read(tmp_path, ways.changed({"command_3": lambda u: 0 * u}))
    assert not flight.has("command")
    (note,) = [n for n in flight.notes if n.code is NoteCode.COMMAND_DEAD]
    assert (note.kind, note.names) == ("warning", ("3",))
    with pytest.raises(RecordingError, match="inlet: the commands of rotors 3 never change"):
        inlet_for(flight, "actuator")
    hover = read(tmp_path, ways.changed({"command": lambda u: 0 * u + 0.5}))
    assert hover.has("command")


def _held(*columns: str, rows: int) -> str:
    """Return the flight as a table that repeats some columns until their next sample."""
    table = dict(ways.flown())
    at = np.arange(len(table["time"])) // rows * rows
    return ways.text(table | {name: table[name][at] for name in columns})


@pytest.mark.parametrize("rows", [2, 4])
@pytest.mark.parametrize("signal_", ["position", "body_rate", "rotor_speed"])
def test_a_slower_signal_of_a_joined_table_is_read_at_its_rate(
    signal_: str, rows: int, tmp_path: Path
) -> None:
    columns = {
        "position": ways.XYZ,
        "body_rate": ("wx", "wy", "wz"),
        "rotor_speed": tuple(f"rotor_speed_{i}" for i in range(1, 5)),
    }[signal_]
    flight = read(tmp_path, _held(*columns, rows=rows))
    assert np.median(np.diff(flight.series[signal_].time)) == pytest.approx(rows / ways.RATE)
    (note,) = (n for n in flight.notes if n.code is NoteCode.HELD)
    assert note.names == (signal_,)
    assert note.numbers["rate"] == pytest.approx(ways.RATE / rows)
    assert not {NoteCode.POSE_MOVED, NoteCode.AWAY_FOR_GOOD} & {n.code for n in flight.notes}


def test_a_body_rate_in_world_axes_is_turned(tmp_path: Path) -> None:
    table = dict(ways.flown())
    q = np.column_stack([table[f"q{axis}"] for axis in ("w", *ways.XYZ)])
    w = np.column_stack([table[f"w{axis}"] for axis in ways.XYZ])
    turned = dict(zip(("wx", "wy", "wz"), rotate(q, w).T, strict=True))
    flight = read(tmp_path, ways.text(table | turned))
    assert np.abs(flight.series["body_rate"].values - w).max() < 1e-6
    notes = [n.names for n in flight.notes if n.code is NoteCode.FRAME_TURNED]
    assert notes == [("body_rate", "in world axes")]


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"v": lambda v: 0.0 * v}, NoteCode.VELOCITY_DOUBTED),
        ({"az": lambda a: a - 9.80665}, NoteCode.WEIGHT_NOT_FELT),
    ],
)
def test_signals_without_size_or_weight_are_doubted(changes, code, tmp_path: Path) -> None:
    doubts = [n.code for n in read(tmp_path, ways.changed(changes)).notes if n.kind == "warning"]
    assert code in doubts
    assert NoteCode.ATTITUDE_DOUBTED not in doubts


def _both(change: float, names: bool) -> str:
    """Return two flights in one table: one after the other, or row by row with their names."""
    lines = ways.text(dict(ways.flown())).splitlines()
    second = ways.changed({"time": lambda t: t + change}).splitlines()[1:]
    if not names:
        return "\n".join([*lines, *second])
    rows = [
        f"{row},cf{i + 1}"
        for pair in zip(lines[1:], second, strict=True)
        for i, row in enumerate(pair)
    ]
    return "\n".join([f"{lines[0]},drone", *rows])


def _in_ned_from_the_ground() -> str:
    """Return the flight after 3 s with motors off and 1 s of climb, its position in NED axes."""
    off, climb, still = 300, 100, {"z", "ax", "ay", "vx", "vy", "vz", "wx", "wy", "wz"}
    table = {}
    for name, column in ways.flown().items():
        rests = name in still or name.startswith(("command", "rotor"))
        table[name] = np.concatenate([np.full(off, 0.0 if rests else column[0]),
                                      np.full(climb, column[0]), column])  # fmt: skip
    table["z"][off : off + climb] *= np.linspace(0.0, 1.0, climb)
    table["time"] = np.arange(len(table["time"])) / ways.RATE
    for axes in (ways.XYZ, ("vx", "vy", "vz")):
        turned = making.ned(np.column_stack([table[axis] for axis in axes]))
        table |= dict(zip(axes, turned.T, strict=True))
    return ways.text(table)


def test_an_inspection_says_what_to_do_where_nothing_flies(tmp_path: Path) -> None:
    path = tmp_path / "flight.csv"
    path.write_text(_in_ned_from_the_ground())
    ((seen,), errors) = inspect_recordings([path], cache=False)
    assert not errors
    assert seen.problem.startswith("flies only if z of its position points down")
    assert seen.problem.endswith("frame: ned_frd in a topic map (--topics FILE)")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (_in_ned_from_the_ground, "flies only if z of its position points down, as in NED axes"),
        (lambda: _both(0.003, names=False), "at row 1402 and starts again there"),
        (lambda: _both(0.0, names=True), "2 vehicles in turn, by its 'drone': cf1, cf2"),
        (
            lambda: ways.text(
                dict(ways.flown()) | {"x": [f"{x:.4f} m" for x in ways.flown()["x"]]}
            ),
            "its 'x' holds '2.0000 m', which is no number",
        ),
        (lambda: ways.changed({}).replace("-", "\u2212"), "which is no number"),
    ],
)
def test_tables_that_would_be_read_otherwise_are_refused(content, message, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=message):
        read(tmp_path, content())
