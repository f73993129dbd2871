"""Topic maps: what a user may write, and how a wrong one is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tuner.core.errors import ConfigError
from tuner.core.shipped import configs_folder
from tuner.recordings import SIGNALS
from tuner.recordings.topics import load_topic_map, read_sidecar, shipped_maps
from tuner.recordings.units import UNITS, to_enu_flu


def test_every_shipped_map_is_valid_and_named_after_its_file() -> None:
    files = {path.stem for path in (configs_folder() / "topics").glob("*.yaml")}
    assert {topic_map.name for topic_map in shipped_maps()} == files
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
    for topic_map in shipped_maps():
        assert f"`{topic_map.name}`" in guide
    for signal in SIGNALS:
        assert f"`{signal}`" in guide
    for unit in UNITS:
        assert f"`{unit}`" in guide
