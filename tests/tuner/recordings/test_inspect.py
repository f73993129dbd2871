"""What `tune inspect` reports of a recording, and how soon."""

from __future__ import annotations

import io
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from tests.tuner.recordings import making
from tuner.cli.results import inspections_drawn
from tuner.job.recording_verdict import verdict_of
from tuner.recordings.cache import cache_root
from tuner.recordings.inspection import Inspection, as_json, inspect_recordings
from tuner.recordings.inspection_rules import inlet_reports
from tuner.vehicle import COEFFICIENTS


def inspect_one_recording(path: Path, **settings: str) -> Inspection:
    (inspection,), errors = inspect_recordings([path], **settings)
    assert errors == ()
    return inspection


@pytest.fixture(scope="module")
def circle() -> Inspection:
    (inspection,), _ = inspect_recordings([making.CIRCLE], cache=False)
    return inspection


def test_topics_and_signals(circle: Inspection) -> None:
    topics = {topic.name: topic for topic in circle.topics}
    assert len(topics) == 11
    pose = topics["/optitrack/pose"]
    assert (pose.type, pose.count) == ("geometry_msgs/msg/PoseStamped", 4000)
    assert pose.rate == pytest.approx(100, rel=0.01)
    assert pose.longest_gap == pytest.approx(0.013, abs=0.002)
    assert pose.delay == pytest.approx(0.2e-3, abs=0.1e-3)
    assert pose.signals == ("position", "attitude")
    assert topics["/mavros/local_position/pose"].signals == ()
    speed = next(signal for signal in circle.signals if signal.name == "rotor_speed")
    assert (speed.columns, speed.unit) == ((0,), "rad/s")
    assert circle.topic_map == "thesis_lab"
    assert circle.started == "2022-10-03T12:26:40+00:00"
    assert circle.duration == pytest.approx(40, abs=0.1)


def test_mission_clock_and_battery(circle: Inspection) -> None:
    (mission,) = circle.missions
    assert mission.start == pytest.approx(4.0, abs=0.01)
    assert mission.duration == pytest.approx(36, abs=0.02)
    assert mission.laps == 7
    assert mission.top_speed == pytest.approx(2.85, abs=0.1)
    assert mission.known == 1.0
    assert 15 < mission.largest_tilt < 30
    assert circle.battery == pytest.approx((16.4, 16.4), abs=0.1)
    assert 0 < circle.clock["spread"] < 1e-3
    assert abs(circle.clock["pose_offset"]) < 2e-3


def test_inlets_and_coefficients(circle: Inspection) -> None:
    lacking = {inlet.name: inlet.missing for inlet in circle.inlets}
    assert lacking["reference"] == ()
    assert lacking["body_rate"] == ()
    assert lacking["actuator"] == ()
    assert lacking["rotor_speed"] == ("rotor_speed of rotors 2, 3, 4",)
    informed = {finding.coefficient: finding.how for finding in circle.coefficients}
    assert set(informed) <= set(COEFFICIENTS)
    assert informed["mass"] == "no"
    assert informed["inertia_xx"] == "yes"
    assert informed["inertia_zz"] != "yes"
    spin = inspect_one_recording(making.FLIGHTS / "yaw_spin_3rps.bag")
    turned = {finding.coefficient: finding.how for finding in spin.coefficients}
    assert turned["inertia_zz"] == "yes"
    assert turned["rotor_drag_coefficient"] == "no"
    assert spin.missions[0].yaw_rate_setpoint == 3.0


def test_json_and_table_agree(circle: Inspection) -> None:
    content = json.loads(as_json([circle]))
    assert content["schema_version"] == 2
    (recording,) = content["recordings"]
    assert recording["missions"][0]["laps"] == 7
    stream = io.StringIO()
    Console(file=stream, width=160).print(inspections_drawn([circle]))
    text = stream.getvalue()
    for words in ("/optitrack/pose", "lacks rotor_speed of rotors 2, 3, 4", "2.84", "weigh it"):
        assert words in text


def test_without_a_pose_topics_are_still_listed(short: Path, tmp_path: Path) -> None:
    path = making.rewrite(short, tmp_path / "uav.bag", rename=lambda name: f"/uav1{name}")
    inspection = inspect_one_recording(path)
    assert inspection.problem is not None
    assert inspection.problem.endswith("use --namespace uav1")
    assert len(inspection.topics) == 11
    assert all(inlet.missing for inlet in inspection.inlets)
    assert inspect_one_recording(path, namespace="uav1").problem is None
    Console(file=io.StringIO()).print(inspections_drawn([inspection]))


def test_one_broken_file_does_not_hide_the_others(tmp_path: Path) -> None:
    (tmp_path / "bad.bag").write_bytes(b"nothing")
    os.mkfifo(pipe := tmp_path / "pipe.bag")
    inspections, errors = inspect_recordings(
        [tmp_path / "bad.bag", making.CIRCLE, tmp_path / "none", pipe]
    )
    assert [Path(inspection.path).name for inspection in inspections] == ["circle_3mps.bag"]
    assert [str(error).split(": ")[1].split(";")[0] for error in errors] == [
        "is of no known format",
        "no such file",
        "is neither a file nor a folder",
    ]


def test_second_time_needs_no_numpy() -> None:
    code = (
        "import sys; from tuner.recordings.inspection import inspect_recordings; "
        "found, errors = inspect_recordings(sys.argv[1:]); "
        "print(found[0].missions[0].laps, [m for m in "
        "('numpy', 'jax', 'pandas', 'sim_jax') if m in sys.modules])"
    )
    command = [sys.executable, "-c", code, str(making.CIRCLE)]
    words = [
        subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ).stdout
        for _ in range(2)
    ]
    assert words[0].startswith("7 ")
    assert "'jax'" not in words[0]
    assert "pandas" not in words[0]
    assert words[1] == "7 []\n"


@pytest.mark.parametrize("kind", ["inspection", "verdict"])
def test_damaged_cache_is_found_anew(kind: str, tmp_path: Path) -> None:
    bag = shutil.copy(making.CIRCLE, tmp_path)
    (inspection,), _ = inspect_recordings([bag])
    verdict = verdict_of(inspection)
    for kept in (cache_root() / kind).iterdir():
        kept.write_bytes(kept.read_bytes()[:-20])
    (again,), _ = inspect_recordings([bag])
    assert again == inspection
    assert verdict_of(again) == verdict


def test_commanded_thrust_and_torque_stand_for_the_motor_commands() -> None:
    wrench = {"commanded_thrust": (0,), "commanded_torque": (0, 1, 2)}
    pose = {"position": (0, 1, 2), "attitude": (0, 1, 2, 3)}
    fed = {
        inlet.name for inlet in inlet_reports(pose | wrench, trajectory=False) if not inlet.missing
    }
    assert fed == {"actuator", "attitude"}
    (actuator,) = (i for i in inlet_reports(pose, trajectory=False) if i.name == "actuator")
    assert actuator.missing == ("command",)
