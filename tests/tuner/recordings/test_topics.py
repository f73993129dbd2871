"""Topic maps and side-cars are checked, and signals are found where they say."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from tests.tuner.recordings import making
from tuner.core.errors import ConfigError, RecordingError
from tuner.core.shipped import configs_folder
from tuner.recordings.content import ReadOptions, read_signals
from tuner.recordings.flight import SIGNALS
from tuner.recordings.formats import READERS
from tuner.recordings.interpolation import body_rate_of
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import NoteCode, note_in_words
from tuner.recordings.sources import sources_by_name
from tuner.recordings.topics import load_topic_map, read_sidecar, shipped_maps
from tuner.recordings.unit_detection import UNITS, to_enu_flu

FORMATS = [reader.format for reader in READERS]


def test_every_shipped_map_is_valid_and_named_after_its_file() -> None:
    files = {path.stem for path in (configs_folder() / "topics").glob("*.yaml")}
    assert {m.name for kind in FORMATS for m in shipped_maps(kind)} == files
    assert all(m.format == kind for kind in FORMATS for m in shipped_maps(kind))
    assert {"thesis_lab", "mavros", "mocap", "gazebo", "px4_ros2", "px4_ulog", "table"} <= files


def test_a_map_in_ten_lines_extends_a_shipped_one(tmp_path: Path) -> None:
    (tmp_path / "lab.yaml").write_text(
        "name: lab\nformat: ros\nextends: mavros\nsignals:\n  position: /vicon/quad/quad\n"
    )
    lab, mavros = load_topic_map(tmp_path / "lab.yaml"), load_topic_map("mavros")
    assert [source.topic for source in lab.signals["position"]] == ["/vicon/quad/quad"]
    assert lab.signals["command"] == mavros.signals["command"]


def test_maps_that_extend_each_other_are_refused(tmp_path: Path) -> None:
    for first, second in (("a", "b"), ("b", "a")):
        text = f"name: {first}\nformat: ros\nextends: {second}.yaml\nsignals: {{}}\n"
        (tmp_path / f"{first}.yaml").write_text(text)
    with pytest.raises(ConfigError, match="in a circle"):
        load_topic_map(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("name: x\nformat: ros\nsignals: {positon: /a}", "did you mean 'position'"),
        ("name: x\nformat: ros\nsignals: {position: {topik: /a}}", "topik"),
        ("name: x\nformat: ros\nsignals: {rotor_speed: {topic: /a, unit: rmp}}", "'rpm'"),
        ("name: x\nformat: ros\nsignals: {position: {topic: /a, fields: [x]}}", "name all 3"),
        ("- a\n- b", "should be a mapping"),
        ("a: [", "line 1"),
        ("name: x\nformat: rosbag\nsignals: {}", "format"),
    ],
)
def test_wrong_map_is_one_line_that_names_the_fault(
    tmp_path: Path, text: str, message: str
) -> None:
    path = tmp_path / "lab.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        load_topic_map(path)
    assert message in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_name_suggests_a_shipped_map() -> None:
    with pytest.raises(ConfigError, match="did you mean 'thesis_lab'"):
        load_topic_map("thesis_lap")


def test_namespace_moves_every_topic() -> None:
    moved = load_topic_map("thesis_lab").under("/uav1/")
    assert moved.signals["position"][0].topic == "/uav1/optitrack/pose"


def test_ned_frd_attitude_becomes_enu_flu() -> None:
    random = np.random.default_rng(0)
    q = Rotation.from_quat(random.normal(size=(20, 4)))
    world = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]])  # NED to ENU
    body = np.diag([1.0, -1.0, -1.0])  # FLU to FRD
    got = to_enu_flu(q.as_quat(scalar_first=True), "attitude")
    matrices = Rotation.from_quat(got, scalar_first=True).as_matrix()
    assert np.allclose(matrices, world @ q.as_matrix() @ body)


def test_what_the_guide_shows_is_valid(tmp_path: Path) -> None:
    guide = (configs_folder() / "topics" / "README.md").read_text()
    topic_map, sidecar = (block.split("```")[0] for block in guide.split("```yaml\n")[1:])
    (tmp_path / "my_lab.yaml").write_text(topic_map)
    lab = load_topic_map(tmp_path / "my_lab.yaml")
    assert lab.signals["rotor_speed"][0].rotor == "motor"
    assert "command" in lab.signals
    (tmp_path / "flight.yaml").write_text(sidecar)
    assert read_sidecar(tmp_path / "flight.bag").start == 12.5
    (tmp_path / "flight.yaml").write_text("mass: 2.2\n")
    with pytest.raises(ConfigError, match=r"'mass' \(it is read as the side-car of flight.bag\)"):
        read_sidecar(tmp_path / "flight.bag")
    for topic_map in (one for kind in FORMATS for one in shipped_maps(kind)):
        assert f"`{topic_map.name}`" in guide
    for signal in SIGNALS:
        assert f"`{signal}`" in guide
    for unit in UNITS:
        assert f"`{unit}`" in guide


LAB = "name: lab\nformat: ros\nsignals:\n  attitude: /optitrack/pose\n"


def own_map(folder: Path, lines: str) -> Path:
    path = folder / "lab.yaml"
    path.write_text(LAB + lines)
    return path


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("  position: /optitrack/pos\n", "similar are /optitrack/pose"),
        (
            "  position: {topic: /optitrack/pose, fields: [pose.position.x, pose.y, pose.z]}\n",
            "/optitrack/pose has no field 'pose.y' for the position",
        ),
        ("  position: /mavros/battery\n", "it is not known where /mavros/battery"),
        ("  velocity: /mavros/local_position/velocity_local\n", "names no topic for position"),
    ],
)
def test_what_a_map_has_wrong_is_named(
    short: Path, tmp_path: Path, lines: str, message: str
) -> None:
    with pytest.raises(RecordingError) as caught:
        load_flight(short, topics=own_map(tmp_path, lines))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_nearest_column_of_a_table_is_named(tmp_path: Path) -> None:
    path = tmp_path / "f.csv"
    rows = [f"{t / 100},0,0,1,1,0,0,0" for t in range(300)]
    path.write_text("\n".join(["time,px,py,pz,qw,qx,qy,qz", *rows]))
    text = "name: own\nformat: table\ntime: time\nsignals:\n  position: [px, py, pzz]\n"
    (tmp_path / "own.yaml").write_text(text + "  attitude: [qw, qx, qy, qz]\n")
    with pytest.raises(RecordingError, match="no column 'pzz' for the position, did you mean 'pz'"):
        load_flight(path, topics=tmp_path / "own.yaml")
    (tmp_path / "own.yaml").write_text(text.replace("pzz", "pz").replace("time: time", "time: t"))
    with pytest.raises(RecordingError, match="finds no time: no column t;"):
        load_flight(path, topics=tmp_path / "own.yaml")


def test_columns_that_the_map_does_not_name_are_said(tmp_path: Path) -> None:
    path = tmp_path / "f.csv"
    spare = [f"pwm_{number}" for number in range(14)]
    rows = [f"{t / 100},0,0,1,1,0,0,0" + ",0.5" * 14 for t in range(300)]
    path.write_text("\n".join([",".join(["time,x,y,z,qw,qx,qy,qz", *spare]), *rows]))
    (note,) = (n for n in load_flight(path).notes if n.code is NoteCode.COLUMNS_UNREAD)
    assert note_in_words(note) == (
        "14 columns are not read, which the topic map does not name: "
        + ", ".join(spare[:12])
        + ", ..."
    )


def test_a_table_as_neurobem_has_it_needs_no_map(tmp_path: Path) -> None:
    time = np.arange(0.0, 20.0, 0.01)
    axes, angle = ("x", "y", "z"), 0.5 * np.sin(time)
    columns = {"t": time}
    columns |= {f"{of} {axis}": 9.0 + 0.0 * time for of in ("ang acc", "vel") for axis in axes}
    columns |= {f"ang vel {axis}": 0.0 * time for axis in axes}
    columns |= {
        f"acc {axis}": np.full(len(time), value)
        for axis, value in zip(axes, (0, 0, 9.81), strict=True)
    }
    columns |= {f"pos {axis}": 0.0 * time for axis in axes}
    columns |= {"quat x": np.sin(angle / 2), "quat y": 0.0 * time, "quat z": 0.0 * time}
    columns |= {"quat w": np.cos(angle / 2), "ang vel x": 0.5 * np.cos(time)}
    columns |= {"pos y": 9.81 * 0.5 * np.sin(time)}
    columns |= {f"mot {i}": 1000.0 + 100.0 * i + np.sin(time) for i in range(1, 5)}
    columns |= {f"dmot {i}": np.cos(time) for i in range(1, 5)}
    pd.DataFrame(columns).to_csv(tmp_path / "flight.csv", index=False)
    signals = read_signals(ReadOptions.of(tmp_path / "flight.csv"))
    assert set(signals.series) == {
        "position", "attitude", "body_rate", "acceleration", "rotor_speed"
    }  # fmt: skip
    # front right, rear left, front left, rear right
    assert np.round(signals.series["rotor_speed"].values.mean(axis=0), -2).tolist() == [
        1200, 1300, 1400, 1100
    ]  # fmt: skip
    turning = body_rate_of(signals.series["attitude"].values)
    assert np.allclose(turning[:, 0], signals.series["body_rate"].values[:, 0], atol=0.02)


def test_what_turns_is_told_from_what_moves_by_the_columns_names() -> None:
    kinds = ("angular_vel", "ang_acc", "lin_vel", "acc")
    _, found = sources_by_name(["t", *(f"{kind}_{axis}" for kind in kinds for axis in "xyz")], {})
    assert {signal: source.fields[0] for signal, source in found.items() if source.fields} == {
        "velocity": "lin_vel_x", "body_rate": "angular_vel_x", "acceleration": "acc_x"
    }  # fmt: skip
    assert sources_by_name(["t", *(f"ang_acc_{axis}" for axis in "xyz")], {})[1] == {}


def test_a_pattern_takes_the_busiest_topic_and_says_so(short: Path, tmp_path: Path) -> None:
    names = {
        "/optitrack/pose": "/vrpn_client_node/quad/pose",
        "/mavros/local_position/pose": "/vrpn_client_node/wand/pose",
    }
    path = making.rewrite(short, tmp_path / "vrpn.bag", rename=lambda name: names.get(name, name))
    got = load_flight(path)
    assert len(got.series["position"].time) > 1100
    note = next(note for note in got.notes if note.code is NoteCode.OTHERS_MATCH)
    assert note.topic == "/vrpn_client_node/quad/pose"
    assert note.names == ("position", "/vrpn_client_node/wand/pose")


def test_a_damaged_definition_costs_its_signals_only(short: Path, tmp_path: Path) -> None:
    raw = short.read_bytes().replace(b"float32 voltage", b"float32 voltag[")
    path = tmp_path / "odd.bag"
    path.write_bytes(raw)
    got = load_flight(path)
    assert not got.has("battery_voltage")
    assert got.has("position")
    (note,) = (note for note in got.notes if note.code is NoteCode.FIELD_MISSING)
    assert (note.topic, note.names[1]) == ("/mavros/battery", "battery_voltage")


def test_definitions_come_from_msg_files_where_the_recording_has_none(
    short: Path, tmp_path: Path
) -> None:
    """As in databases that ROS 2 Humble wrote."""
    import sqlite3  # noqa: PLC0415

    folder = making.to_ros2(short, tmp_path / "humble", making.StoragePlugin.SQLITE3)
    with sqlite3.connect(folder / "humble.db3") as database:
        database.execute("DROP TABLE message_definitions")
    database.close()
    expected = load_flight(short)
    got = load_flight(folder)
    assert got.has("body_rate")  # a type that every ROS 2 has
    assert not got.has("command")
    (tmp_path / "mavros_msgs" / "msg").mkdir(parents=True)
    text = "std_msgs/Header header\nuint16[] channels\n"
    (tmp_path / "mavros_msgs" / "msg" / "RCOut.msg").write_text(text)
    topics = tmp_path / "lab.yaml"
    topics.write_text(
        "name: lab\nformat: ros\nmessages: mavros_msgs/msg\nsignals:\n"
        "  position: /optitrack/pose\n  attitude: /optitrack/pose\n  command: /mavros/rc/out\n"
    )
    got = load_flight(folder, topics=topics)
    assert got.signals["command"][200].tolist() == pytest.approx(
        expected.signals["command"][200 + round(4.0 * 100)].tolist(), abs=0.2
    )
    assert got.has("command")


def test_single_tachometers_of_four_rotors_are_put_in_their_columns(
    short: Path, tmp_path: Path
) -> None:
    def change(topic: str, time: int, message: Any) -> list[tuple[int, Any]]:
        if topic != "/mavros/rpm":
            return [(time, message)]
        message.index = (time // 10_000_000) % 4
        message.frequency += 100 * message.index
        return [(time, message)]

    got = load_flight(making.rewrite(short, tmp_path / "four.bag", change))
    level = [float(v) for v in got.signals["rotor_speed"][50:150].mean(axis=0)]
    steps = [(b - a) * 60 / 6.283185 for a, b in pairwise(level)]
    assert steps == pytest.approx([100, 100, 100], abs=30)
    assert not any(note.code is NoteCode.NO_TACHOMETER for note in got.notes)


def test_a_field_that_names_the_rotor_is_looked_for_and_counts_as_read(tmp_path: Path) -> None:
    rows = [f"{t / 100},0,0,{1 + t / 300},1,0,0,0,6000,{t % 4}" for t in range(600)]
    path = tmp_path / "f.csv"
    path.write_text("\n".join(["t,x,y,z,qw,qx,qy,qz,rpm,motor", *rows]))
    text = "name: own\nformat: table\ntime: t\nsignals:\n  position: [x, y, z]\n"
    text += "  attitude: [qw, qx, qy, qz]\n  rotor_speed: {fields: [rpm], rotor: motr, unit: rpm}\n"
    (tmp_path / "own.yaml").write_text(text)
    with pytest.raises(RecordingError, match="'motr' for the rotor_speed, did you mean 'motor'"):
        load_flight(path, topics=tmp_path / "own.yaml")
    (tmp_path / "own.yaml").write_text(text.replace("motr", "motor"))
    notes = load_flight(path, topics=tmp_path / "own.yaml").notes
    assert not any(note.code is NoteCode.COLUMNS_UNREAD for note in notes)


def test_a_format_without_a_shipped_map_asks_for_one(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr("tuner.recordings.content.shipped_maps", lambda _: ())
    (tmp_path / "a.csv").write_text("t,x\n0,1\n1,2\n")
    with pytest.raises(RecordingError, match="'table', for which no topic map ships; give one"):
        load_flight(tmp_path / "a.csv", cache=False)
