"""Recordings that deny themselves are named and left out; those that may fly are not."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Reader
from rosbags.rosbag1 import Writer as BagWriter
from scipy.spatial.transform import Rotation

from tests.tuner.recordings import making, ways
from tuner.cli import main
from tuner.config import TrajectorySettings, resolve_settings
from tuner.core.errors import RecordingError
from tuner.evaluate.closed_loop import simulate
from tuner.findings.findings import Code, one_line
from tuner.options import Options
from tuner.recordings.consistency import contradiction, contradiction_in, correct_frames
from tuner.recordings.flight import Flight, Series
from tuner.recordings.inspection import inspect_recordings
from tuner.recordings.missions import Mission
from tuner.recordings.notes import Note, NoteCode
from tuner.recordings.unit_detection import READINGS, SCALAR_FIRST, SignalReading
from tuner.search.job_flights import load_flights, read_recordings
from tuner.vehicle import ControllerFile, read_vehicle

SHARED = Path(__file__).parents[4] / "shared"
REAL = Path(os.environ.get("TUNE_REAL_FLIGHTS", SHARED / "flights"))
RECORDINGS = [
    *sorted(making.FLIGHTS.glob("*.bag")),
    *sorted((REAL / "nanobench").glob("*.csv")),
    *sorted((REAL / "crazyswarm").glob("log???")),  # log25 falls after 0.7 s in the air
    *sorted((SHARED / "lab_flights").glob("*/*.bag")),
]
TIME = np.arange(0.0, 20.0, 0.01)
ALL = (Mission(0.0, 20.0, "the first command"),)


def backwards(bag: Path, target: Path) -> Path:
    """Write a bag again with all its times mirrored."""
    store, writer = making.store_of(bag, ros2=False), BagWriter(target)
    with Reader(bag) as reader, writer:
        ends = reader.start_time + reader.end_time
        connections = {
            c.id: writer.add_connection(c.topic, c.msgtype, msgdef=c.msgdef.data, md5sum=c.digest)
            for c in reader.connections
        }
        for connection, time, raw in reversed(list(reader.messages())):
            message = store.deserialize_ros1(raw, connection.msgtype)
            if hasattr(message, "header"):
                making.stamped(message, ends - making.stamp_of(message))
            again = store.serialize_ros1(message, connection.msgtype)
            writer.write(connections[connection.id], ends - time, again)
    return target


@pytest.fixture(scope="module")
def reversed_circle(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return backwards(short, tmp_path_factory.mktemp("reversed") / "reversed.bag")


def test_a_recording_that_runs_backwards_is_named_and_left_out(
    short: Path, reversed_circle: Path
) -> None:
    usable, findings = read_recordings(
        resolve_settings(Options([str(short), str(reversed_circle)]))
    )
    assert [recording.flight.name for recording in usable] == ["short"]
    (left_out,) = (finding for finding in findings if finding.code is Code.LEFT_OUT)
    assert (left_out.subject, left_out.level) == ("reversed", "warning")
    assert "attitude and its body_rate contradict each other (agreement -" in one_line(left_out)
    assert "time that runs backwards" in one_line(left_out)


def test_where_nothing_else_flew_the_run_ends_with_one_line(
    reversed_circle: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(RecordingError, match=r"reversed.bag: its attitude and its body_rate"):
        read_recordings(resolve_settings(Options([str(reversed_circle)])))
    assert main(["--flights", str(reversed_circle), "--out", str(tmp_path / "run")]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in said if "contradict each other" in line]) == 1


def test_inspection_says_so_in_one_line(reversed_circle: Path) -> None:
    ((inspection,), _) = inspect_recordings([reversed_circle], cache=False)
    (doubt,) = (note for note in inspection.notes if note.kind == "warning")
    assert doubt == contradiction_in(inspection.notes)
    assert all("attitude" in inlet.missing for inlet in inspection.inlets)
    assert inspection.coefficients == ()


@cache
def flights_of(path: Path) -> list[Flight]:
    """Return what is read of a recording, once for all tests."""
    return load_flights(path, cache=False)


@pytest.mark.parametrize("path", RECORDINGS, ids=lambda path: f"{path.parent.name}-{path.name}")
def test_no_flight_that_flew_is_left_out(path: Path) -> None:
    for flight in flights_of(path):
        assert contradiction_in(flight.notes) is None


def circle(
    turned: float = 0.0,
    wind: float = 0.0,
    *,
    speed: float = 2.0,
    noise: float = 0.0,
    wander: float = 0.0,
) -> dict[str, Series]:
    """Return a circle of 2 m, its attitude turned by some rad about the world's vertical.

    Wind in m/s^2, which tilts a vehicle that does not accelerate; of the position, white noise and
    how far it wanders, in m.
    """
    random, angle = np.random.default_rng(4), speed / 2.0 * TIME
    position = 2.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * TIME])
    velocity = speed * np.column_stack([-np.sin(angle), np.cos(angle), 0.0 * TIME])
    push = -(speed**2) / 2.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    push = push + wind * np.column_stack([np.sin(2.3 * TIME), np.cos(1.7 * TIME)])
    c, s = np.cos(turned), np.sin(turned)
    lean = push @ np.array([[c, s], [-s, c]]) / 9.81
    up = np.column_stack([lean, np.ones(len(TIME))])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    # the shortest turn that takes the vertical there
    attitude = np.column_stack([1.0 + up[:, 2], -up[:, 1], up[:, 0], 0.0 * TIME])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    position += noise * random.normal(size=position.shape)
    position[:, 0] += wander * np.sin(5.0 * TIME)
    signals = {"position": position, "attitude": attitude, "velocity": velocity}
    return {name: Series(TIME, values) for name, values in signals.items()}


@pytest.mark.parametrize("turned", [np.pi / 2, np.pi, -np.pi / 2])
def test_an_attitude_of_another_convention_is_certain(turned: float) -> None:
    note = contradiction(circle(turned), ALL)
    assert note is not None
    assert note.names == ("attitude", "position")
    assert note.numbers["agreement"] == pytest.approx(np.cos(turned), abs=0.05)


def test_a_velocity_that_runs_backwards_is_certain_without_a_gyro() -> None:
    signals = circle()
    signals["velocity"] = Series(TIME, -signals["velocity"].values)
    note = contradiction(signals, ALL)
    assert note is not None
    assert note.names == ("position", "velocity")


@pytest.mark.parametrize(
    "signals",
    [
        pytest.param(circle, id="true"),
        pytest.param(lambda: circle(0.5), id="a frame half turned"),
        pytest.param(lambda: circle(np.pi / 2, speed=0.7), id="slow"),
        pytest.param(lambda: circle(wind=3.0), id="storm"),
        pytest.param(lambda: circle(speed=0.3, wind=3.0, noise=0.5), id="storm without a pose"),
        pytest.param(lambda: circle(speed=0.3, wind=3.0, wander=1.0), id="storm, poor pose"),
    ],
)
def test_what_may_be_true_is_no_certainty(signals: Callable[[], dict[str, Any]]) -> None:
    assert contradiction(signals(), ALL) is None


def test_a_vehicle_that_leans_by_more_than_60_degrees_is_not_doubted() -> None:
    assert correct_frames(circle(speed=6.2), {})[1] == ()
    (doubt,) = correct_frames(circle(np.pi / 2, speed=6.2), {})[1]
    assert doubt.code is NoteCode.ATTITUDE_DOUBTED


def test_markers_off_the_centre_of_a_vehicle_that_spins_doubt_no_attitude() -> None:
    """They are pulled inwards, by 0.36 m/s², whichever way the vehicle leans in its trim."""
    turned = Rotation.from_rotvec(np.outer(TIME, [0.0, 0.0, 3.0]))
    attitude = turned * Rotation.from_rotvec([0.0, 0.01, 0.0])
    markers = attitude.apply([0.04, 0.0, 0.0]) + np.array([0.0, 0.0, 1.0])
    signals = {
        "position": Series(TIME, markers),
        "attitude": Series(TIME, attitude.as_quat(scalar_first=True)),
        "body_rate": Series(TIME, attitude.inv().apply([0.0, 0.0, 3.0])),
    }
    assert correct_frames(signals, {})[1] == ()


@pytest.mark.parametrize("wind", [3.0, 6.0, 12.0])
@pytest.mark.parametrize("axes", ["in body axes", "in NED axes"])
def test_a_velocity_in_other_axes_is_turned_into_the_worlds(axes: str, wind: float) -> None:
    """Body axes of a vehicle that keeps its heading are like the world's, the less it leans."""
    signals = circle(speed=4.0, wind=wind)
    world, attitude = signals["velocity"].values, signals["attitude"].values
    body = Rotation.from_quat(attitude, scalar_first=True).inv().apply(world)
    recorded = {"in body axes": body, "in NED axes": world[:, [1, 0, 2]] * [1.0, 1.0, -1.0]}
    noise = 0.05 * np.random.default_rng(1).normal(size=world.shape)
    signals["velocity"] = Series(TIME, recorded[axes] + noise)
    fixed, (note,) = correct_frames(signals, {})
    assert (note.code, note.names) == (NoteCode.FRAME_TURNED, ("velocity", axes))
    assert np.allclose(fixed["velocity"].values, world, atol=0.3)
    signals["velocity"] = Series(TIME, world + noise)
    assert correct_frames(signals, {})[1] == ()


@cache
def flown_at_random(seed: int) -> Mapping[str, Series]:
    """Return a random flight with drag and noise, and all signals that frames are judged by."""
    random = np.random.default_rng(seed)
    rates, phases = random.uniform(0.5, 2.0, (2, 3, 3)) * [[[1.0]], [[3.0]]]
    sizes = random.uniform(0.5, 1.5, (3, 3)) / rates * [[1.0], [1.0], [0.3]]
    angle = rates * TIME[:, None, None] + phases
    position, velocity, push = (
        (sizes * part).sum(axis=2)
        for part in (np.sin(angle), rates * np.cos(angle), -(rates**2) * np.sin(angle))
    )
    felt = push + np.array([0.0, 0.0, 9.81])
    thrust = felt + 0.4 * velocity  # what is felt is thrust without drag
    up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    shortest = np.column_stack([-up[:, 1], up[:, 0], 0.0 * TIME, 1.0 + up[:, 2]])
    attitude = Rotation.from_quat(shortest) * Rotation.from_rotvec(
        np.outer(np.sin(0.7 * TIME), [0.0, 0.0, 1.0])
    )
    turns = (attitude[:-2].inv() * attitude[2:]).as_rotvec() / 0.02
    turning = np.pad(turns, ((1, 1), (0, 0)), "edge")
    signals = {
        "position": position + 0.001 * random.normal(size=position.shape),
        "attitude": attitude.as_quat(scalar_first=True),
        "body_rate": turning + 0.05 * random.normal(size=turning.shape),
        "velocity": velocity + 0.05 * random.normal(size=velocity.shape),
        "acceleration": attitude.inv().apply(felt) + 0.3 * random.normal(size=felt.shape),
        "rate_setpoint": turning + 0.1 * random.normal(size=turning.shape),
    }
    return MappingProxyType({name: Series(TIME, rows) for name, rows in signals.items()})


RECORDED: dict[str, Callable[[np.ndarray, Rotation], np.ndarray]] = {
    "in FRD axes": lambda values, _: values * [1.0, -1.0, -1.0],
    "in degrees per second": lambda values, _: np.degrees(values),
    "in FRD axes and degrees": lambda values, _: np.degrees(values) * [1.0, -1.0, -1.0],
    "in milliradians per second": lambda values, _: 1e3 * values,
    "in milliradians, not degrees, per second": lambda values, _: 1e3 * np.radians(values),
    "in world axes": lambda values, attitude: attitude.apply(values),
    "in body axes": lambda values, attitude: attitude.inv().apply(values),
    "in NED axes": lambda values, _: values[:, [1, 0, 2]] * [1.0, 1.0, -1.0],
    "in kilometres per hour, not feet per second": lambda values, _: 3.6 * 0.3048 * values,
    "with x and y swapped": lambda values, _: values[:, [1, 0, 2]],
    "in axes turned left about z": lambda values, _: values[:, [1, 0, 2]] * [1.0, -1.0, 1.0],
    "in axes turned right about z": lambda values, _: values[:, [1, 0, 2]] * [-1.0, 1.0, 1.0],
}
"""Reading -> what was recorded, from right values and attitude."""
AS_RECORDED: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "scalar-last": lambda q: q[:, [1, 2, 3, 0]],
    "scalar-first": lambda q: q[:, [3, 0, 1, 2]],
    "world to body": lambda q: q * [1.0, -1.0, -1.0, -1.0],
    "NED and FRD": making.ned_frd,
    "scalar-last, NED and FRD": lambda q: making.ned_frd(q)[:, [1, 2, 3, 0]],
}
"""Reading of an attitude -> what was recorded, from the right quaternions, w first."""


def of_markers(q: np.ndarray, heading: float) -> np.ndarray:
    """Return the attitude of markers of another heading, in degrees, on the same vehicle."""
    turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_euler("z", heading, True)
    return turned.as_quat(scalar_first=True)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("signal", "reading"),
    [(name, row) for name in READINGS if name != "attitude" for row in READINGS[name]],
    ids=lambda value: getattr(value, "name", value),
)
def test_each_reading_of_the_table_is_recognised(
    signal: str, reading: SignalReading, seed: int
) -> None:
    signals = flown_at_random(seed)
    attitude = Rotation.from_quat(signals["attitude"].values, scalar_first=True)
    right = signals[signal].values
    recorded = Series(TIME, RECORDED[reading.name](right, attitude))
    fixed, (note,) = correct_frames({**signals, signal: recorded}, {})
    assert (note.code, note.names) == (NoteCode.FRAME_TURNED, (signal, reading.name))
    np.testing.assert_allclose(fixed[signal].values, right, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "reading", [*READINGS["attitude"], SCALAR_FIRST], ids=lambda reading: reading.name
)
def test_each_reading_of_an_attitude_is_recognised(reading: SignalReading, seed: int) -> None:
    signals = flown_at_random(seed)
    right = signals["attitude"].values
    recorded = Series(TIME, AS_RECORDED[reading.name](right))
    fixed, (note,) = correct_frames({**signals, "attitude": recorded}, {})
    assert (note.code, note.names) == (NoteCode.FRAME_TURNED, ("attitude", reading.name))
    overlap = (fixed["attitude"].values * right).sum(axis=1)
    np.testing.assert_allclose(np.abs(overlap), 1.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(("heading", "said"), [(-20.0, 340), (45.0, 45), (90.0, 90), (180.0, 180)])
def test_markers_of_another_heading_are_turned(heading: float, said: int, seed: int) -> None:
    signals = flown_at_random(seed)
    right = signals["attitude"].values
    recorded = Series(TIME, of_markers(right, heading))
    fixed, (note,) = correct_frames({**signals, "attitude": recorded}, {})
    assert (note.code, note.names[0]) == (NoteCode.FRAME_TURNED, "attitude")
    assert float(note.names[1].split()[-2]) == pytest.approx(said, abs=2.0)
    overlap = np.abs((fixed["attitude"].values * right).sum(axis=1))
    assert np.degrees(2 * np.arccos(overlap.min())) < (2.0 if heading % 90 else 1e-5)


@pytest.mark.parametrize("heading", [90.0, 180.0])
@pytest.mark.parametrize("path", sorted((REAL / "nanobench").glob("*.csv")), ids=lambda p: p.stem)
def test_markers_of_another_heading_show_in_real_flights(path: Path, heading: float) -> None:
    """Their attitude is noisy: its change alone is as much noise as motion."""
    signals = dict(flights_of(path)[0].series)
    right = signals["attitude"]
    turned = Series(right.time, of_markers(right.values, heading))
    fixed, notes = correct_frames({**signals, "attitude": turned}, {})
    overlap = (fixed["attitude"].values * right.values).sum(axis=1)
    np.testing.assert_allclose(np.abs(overlap), 1.0, atol=1e-9)
    assert [note.code for note in notes] == [NoteCode.FRAME_TURNED]


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_the_gyro_of_a_gentle_flight_is_turned(noise: float) -> None:
    shape = TrajectorySettings(name="lemniscate", radius=2.0, omega=0.7, speed_scale=0.7)
    (flown,) = simulate(read_vehicle(ways.VEHICLE), ControllerFile(), shape, duration=20.0)
    random, read = np.random.default_rng(0), {}
    for name, error in (("position", 2e-4), ("attitude", 1e-3), ("body_rate", 0.01)):
        values = flown.signals[name]
        values = values + noise * error * random.normal(size=values.shape)
        read[name] = Series(flown.time, making.frd(values) if name == "body_rate" else values)
    corrected, notes = correct_frames(read, {})
    assert [(note.code, note.names[0]) for note in notes] == [(NoteCode.FRAME_TURNED, "body_rate")]
    again, notes = correct_frames(corrected, {})
    assert notes == ()
    np.testing.assert_array_equal(again["body_rate"].values, corrected["body_rate"].values)


def test_the_weight_alone_tells_the_axes_of_an_accelerometer() -> None:
    still = np.zeros((len(TIME), 3))
    signals = {
        "position": Series(TIME, still + 1.0),
        "attitude": Series(TIME, np.tile([1.0, 0.0, 0.0, 0.0], (len(TIME), 1))),
        "acceleration": Series(TIME, still - [0.0, 0.0, 9.81]),
    }
    fixed, (note,) = correct_frames(signals, {})
    assert note.names == ("acceleration", "in FRD axes")
    assert np.all(fixed["acceleration"].values[:, 2] == 9.81)


@pytest.mark.parametrize("seed", range(20))
def test_a_flight_read_as_declared_raises_no_doubt(seed: int) -> None:
    assert correct_frames(flown_at_random(seed), {})[1] == ()


def test_a_vehicle_that_shakes_raises_no_doubt_of_its_gyro() -> None:
    quick, still = 2.0 * np.pi * 15.0, np.zeros((len(TIME), 3))
    pitch = np.outer(0.014 * np.sin(quick * TIME), [0.0, 1.0, 0.0])
    rate = np.outer(0.014 * quick * np.cos(quick * TIME), [0.0, 1.0, 0.0])
    attitude = Rotation.from_rotvec(pitch).as_quat(scalar_first=True)
    signals = {"position": still, "attitude": attitude, "body_rate": rate}
    assert correct_frames({n: Series(TIME, v) for n, v in signals.items()}, {})[1] == ()


def test_a_moment_is_no_certainty() -> None:
    assert contradiction(circle(np.pi), (Mission(0.0, 4.0, "the first command"),)) is None
    assert contradiction(circle(np.pi), ()) is None
    assert contradiction_in(()) is None
    assert contradiction_in([Note(NoteCode.STALE)]) is None
