"""`tune bench` from the file to the result folder."""

import datetime
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from tuner.cli import main
from tuner.config import TrajectorySettings
from tuner.exporters.effective import refly
from tuner.exporters.export import export
from tuner.job.bench import bench
from tuner.options import ExportOptions
from tuner.report import render
from tuner.result import read_run
from tuner.vehicle import ControllerFile, read_vehicle, values_of

EXAMPLE = Path(__file__).resolve().parents[3] / "examples" / "bench"


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    out = tmp_path_factory.mktemp("bench") / "run"
    assert main(["bench", str(EXAMPLE / "bench.yaml"), "--out", str(out), "--quiet"]) == 0
    return read_run(out)


def test_the_example_gives_the_truth_within_its_errors(example):
    truth = yaml.safe_load((EXAMPLE / "truth.yaml").read_text())
    for name, value in truth.items():
        coefficient = example.result.coefficients[name]
        assert coefficient.fitted
        assert abs(coefficient.best - value) < 3 * coefficient.std_error, name
        assert values_of(example.vehicle)[name] == coefficient.best
    assert example.vehicle.mass == 2.243  # what hung
    assert example.result.findings == ()


def test_a_term_that_the_start_leaves_out_begins_where_it_does_not_act(example):
    exponent = example.result.coefficients["battery_exponent"]
    assert exponent.initial == 0.0 < exponent.best


def test_the_page_shows_which_samples_were_used(example):
    page = (example.folder / "report.html").read_text()
    assert "Ground measurements" in page
    assert "The experiments agree" in page
    assert "left out" in page
    for name in ("bench_1_1", "bench_4_2", "bench_7_1"):
        assert f'data-chart="{name}"' in page
    assert render(example.folder) == example.folder / "report.html"


def test_the_result_is_exported_like_a_fit_s(example, tmp_path):
    path = tmp_path / "quad.yaml"
    export(example, ExportOptions("yaml", out=path), refly=refly, today=datetime.date(2026, 1, 1))
    assert values_of(read_vehicle(path)) == values_of(example.vehicle)


def test_the_terminal_gets_each_experiment_and_the_agreement(tmp_path, capsys):
    plan = {"experiments": [HOVER]}
    left = tmp_path / "out" / "sensitivity.json"  # of an earlier run
    left.parent.mkdir()
    left.write_text("{}")
    (left.parent / "about.json").write_text('{"schema_version": 1}')
    assert run(tmp_path, plan, "--out", str(tmp_path / "out")) == 0
    assert not left.exists()
    out = capsys.readouterr().out
    assert "hover_weights: motor_constant 1.4" in out
    assert "nothing checks the experiments" in out


HOVER = {"kind": "hover_weights", "points": [{"mass": 2.243, "rotor_speed": 616}]}
SPIN = {"kind": "yaw_spin", "points": [{"yaw_rate": 2, "rotor_speed_slow": 599}]}
PENDULUM = {"kind": "bifilar", "axis": "x", "mass": 2.243, "wire_distance": 0.34,
            "wire_length": 1.14, "recording": "bifilar_x.csv"}  # fmt: skip
STEP = {"kind": "step_response", "recording": "step.csv"}
THRUST = {"kind": "thrust_stand", "recording": "thrust.csv", "rotors": 4, "lever_ratio": 1.4231}
TORQUE = {"kind": "torque_stand", "recording": "torque.csv", "rotors": 2, "lever_arm": 0.37}
CURVE = {"kind": "rpm_curve", "recording": "steps.csv"}


def run(folder, plan, *options):
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(plan))
    return main(["bench", str(path), *options])


def edited(folder, name, change):
    """Write a changed recording of the example into a folder: columns by name."""
    table = np.genfromtxt(EXAMPLE / name, delimiter=",", names=True)
    columns = change({field: table[field] for field in table.dtype.names})
    rows = np.column_stack(list(columns.values()))
    np.savetxt(folder / name, rows, delimiter=",", header=",".join(columns), comments="")


def renamed(**names):
    return lambda columns: {names.get(name, name): values for name, values in columns.items()}


def scaled(**factors):
    return lambda columns: {n: factors.get(n, 1.0) * values for n, values in columns.items()}


def delayed(columns):
    """Return the rotor speed as it would be stamped by a clock that is 0.08 s late."""
    late = round(0.08 / np.median(np.diff(columns["time"])))
    return columns | {"rpm": np.concatenate([columns["rpm"][:late], columns["rpm"][:-late]])}


def first(count):
    return lambda columns: {name: values[:count] for name, values in columns.items()}


def hurried(columns):
    """Return the first 0.12 s of each step alone, too few for a lag of 0.05 s."""
    short = np.arange(len(columns["time"])) % 300 < 60
    cut = {name: values[short] for name, values in columns.items()}
    return cut | {"time": 0.002 * np.arange(short.sum())}


@pytest.mark.parametrize(
    ("experiments", "name", "change", "expected"),
    [
        ([PENDULUM], "bifilar_x.csv", renamed(angle_deg="angle"), "name the column angle_deg"),
        ([PENDULUM], "bifilar_x.csv", renamed(angle_deg="alpha"), "has no column angle"),
        ([PENDULUM], "bifilar_x.csv", renamed(time="clock"), "has no column time"),
        ([PENDULUM], "bifilar_x.csv", first(100), "oscillations, fewer than 5"),
        ([PENDULUM], "bifilar_x.csv", first(5), "holds 5 samples"),
        ([PENDULUM | {"wire_distance": 34}], "bifilar_x.csv", first(1500), "wire_distance is 34"),
        ([PENDULUM | {"wire_distance": 3.4}], "bifilar_x.csv", first(1500), "radius of gyration"),
        ([THRUST], "thrust.csv", renamed(rpm="rotor_speed"), "name the column rpm"),
        ([THRUST], "thrust.csv", scaled(rpm=0.105), "on an arm of 0.25 m; name the column rotor_s"),
        ([CURVE], "steps.csv", scaled(rpm=0.105), "on an arm of 0.25 m; name the column rotor_s"),
        ([THRUST], "thrust.csv", first(200), "steady levels of rotor speed"),
        ([THRUST | {"lever_ratio": 1423.1}], "thrust.csv", first(900), "the lever ratio"),
        ([STEP], "step.csv", hurried, "too short for a time constant"),
        ([STEP], "step.csv", first(500), "steps up of the command"),
        ([STEP], "step.csv", lambda c: c | {"command": 1000 + 1000 * c["command"]}, "scale it"),
        ([STEP], "step.csv", scaled(time=1e3), "time constants of 10 s up"),
        ([STEP], "step.csv", delayed, "shows each command 0.085 s late, motors up to 0.04 s"),
        ([TORQUE], "torque.csv", scaled(force=1e3), "check the force (N) and the lever arm"),
        ([CURVE], "steps.csv", scaled(voltage=1e3), "column voltage goes from 1.5"),
        ([CURVE], "steps.csv", scaled(voltage=-1.0), "column voltage goes from -16.4"),
        ([CURVE | {"reference_voltage": 50}], "steps.csv", first(600), "far from 50 V"),
        ([STEP], "other.csv", None, "cannot be read"),
        ([HOVER | {"points": [{"mass": 2.2, "rotor_speed": 5900}]}], "", None, "rotor_speed is"),
        ([HOVER | {"points": []}], "", None, "points is"),
        ([HOVER, SPIN | {"points": [{"yaw_rate": 2, "rotor_speed_slow": 650}]}], "", None, "fast"),
        ([{"kind": "wind_tunnel"}], "", None, "wind_tunnel"),
        ([PENDULUM | {"wire_distance": 0.55}], "bifilar_x.csv", first(1500), "which axis hung"),
    ],
)
def test_bad_input_is_one_line(tmp_path, capsys, *, experiments, name, change, expected):
    if change is not None:
        edited(tmp_path, name, change)
    for recording in EXAMPLE.glob("*.csv"):
        if not (tmp_path / recording.name).exists():
            shutil.copy(recording, tmp_path)
    for experiment in experiments:
        if name == "other.csv":
            experiment["recording"] = name
    assert run(tmp_path, {"experiments": experiments}, "--out", str(tmp_path / "out")) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert expected in err
    assert not (tmp_path / "out").exists()


def test_a_pose_of_another_axis_is_refused_and_the_right_one_read(tmp_path, capsys):
    table = np.genfromtxt(EXAMPLE / "bifilar_x.csv", delimiter=",", names=True)
    half = 0.5 * np.radians(table["angle_deg"])
    # body x points up: a quarter turn about y, then the swing about the vertical
    tilt = -np.pi / 4
    w, y = np.cos(tilt), np.sin(tilt)
    quaternion = (np.cos(half) * w, -np.sin(half) * y, np.cos(half) * y, np.sin(half) * w)
    rows = np.column_stack([table["time"], *quaternion])
    header = "time,qw,qx,qy,qz"
    np.savetxt(tmp_path / "pose.csv", rows, delimiter=",", header=header, comments="")
    pendulum = PENDULUM | {"recording": "pose.csv"}
    assert run(tmp_path, {"experiments": [pendulum | {"axis": "y"}]}) == 2
    assert "hangs by its body axis x" in capsys.readouterr().err
    assert run(tmp_path, {"experiments": [pendulum]}, "--out", str(tmp_path / "out")) == 0
    inertia = read_run(tmp_path / "out").result.coefficients["inertia_xx"].best
    assert inertia == pytest.approx(0.0272, rel=0.01)


def test_a_spin_is_linearised_where_the_other_experiments_lead(tmp_path):
    # the shipped vehicle's motor constant is 8.55e-6, far from that of the hovers
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump({"experiments": [SPIN, HOVER]}))
    result = bench(path, out=tmp_path / "out")
    names = [experiment.name for experiment in result.record.experiments]
    assert names == ["yaw_spin", "hover_weights"]
    best = {name: row.best for name, row in result.result.coefficients.items()}
    ratio = best["rotor_drag_coefficient"] / (best["moment_constant"] * best["motor_constant"])
    assert ratio * 0.033 * 1.45e-5 == pytest.approx(1.263e-4, rel=0.02)


def test_a_conflict_is_named_in_the_result(tmp_path, capsys):
    for recording in EXAMPLE.glob("*.csv"):
        shutil.copy(recording, tmp_path)
    wrong = THRUST | {"lever_ratio": 1.0}
    assert run(tmp_path, {"experiments": [wrong, HOVER]}, "--out", str(tmp_path / "out")) == 0
    assert "It contradicts the other experiments" in capsys.readouterr().out
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert {f["subject"] for f in written["findings"]} == {"thrust_stand", "hover_weights"}


def flown(path, speeds, yaw_rate, seconds=20.0):
    """Write a flight as a table: a start, a steady part, a landing."""
    random = np.random.default_rng(0)
    time = np.arange(0, seconds, 0.02)
    throttle = np.clip(np.minimum(time, seconds - time) / 2.0, 0.1, 1.0)
    columns = {"time": time, "x": 0 * time, "y": 0 * time, "z": 1 + 0 * time}
    half = 0.5 * yaw_rate * time
    columns |= {"qw": np.cos(half), "qx": 0 * time, "qy": 0 * time, "qz": np.sin(half)}
    columns |= {"wx": 0 * time, "wy": 0 * time, "wz": yaw_rate + 0 * time}
    for rotor, speed in enumerate(speeds):
        series = speed * throttle + random.normal(0, 2.0, len(time))
        columns[f"rotor_speed_{rotor + 1}"] = series
    rows = np.column_stack(list(columns.values()))
    np.savetxt(path, rows, delimiter=",", header=",".join(columns), comments="")


def test_hovers_and_spins_are_taken_from_recordings(tmp_path):
    flown(tmp_path / "hover.csv", (616, 616, 616, 616), 0.0)
    flown(tmp_path / "spin.csv", (599, 599, 632, 632), 2.0)
    hover = HOVER | {"points": [{"mass": 2.243, "recording": "hover.csv"}]}
    spin = SPIN | {"points": [{"recording": "spin.csv"}]}
    assert run(tmp_path, {"experiments": [hover, spin]}, "--out", str(tmp_path / "out")) == 0
    best = {n: c.best for n, c in read_run(tmp_path / "out").result.coefficients.items()}
    assert best["motor_constant"] == pytest.approx(1.45e-5, rel=0.005)
    ratio = best["rotor_drag_coefficient"] / (best["moment_constant"] * best["motor_constant"])
    assert ratio == pytest.approx(33.0 / (2.0 * 0.0625), rel=0.02)
    assert "Steady part of hover.csv" in (tmp_path / "out" / "report.html").read_text()


def test_hovers_and_spins_are_taken_from_bags(tmp_path, updated):
    from tuner.evaluate.closed_loop import simulate  # noqa: PLC0415 (jax)
    from tuner.evaluate.simulation_files import write_flights  # noqa: PLC0415

    for name in ("hover", "yaw_spin"):
        shape = TrajectorySettings(name=name, yaw_rate=2.0)
        flights = simulate(updated, ControllerFile(), shape, duration=12.0)
        write_flights(flights, tmp_path / f"{name}.bag")
    hover = HOVER | {"points": [{"mass": updated.mass, "recording": "hover.bag"}]}
    spin = SPIN | {"points": [{"recording": "yaw_spin.bag"}]}
    assert run(tmp_path, {"experiments": [hover, spin]}, "--out", str(tmp_path / "out")) == 0
    best = {n: c.best for n, c in read_run(tmp_path / "out").result.coefficients.items()}
    truth = updated.aerodynamics
    assert best["motor_constant"] == pytest.approx(truth.motor_constant, rel=0.002)
    ratio = best["rotor_drag_coefficient"] / (best["moment_constant"] * best["motor_constant"])
    expected = truth.rotor_drag_coefficient / (truth.moment_constant * truth.motor_constant)
    assert ratio == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        ([{"mass": 2.2}], "either rotor_speed or recording"),
        ([{"mass": 2.2, "recording": "gone.csv"}], "does not exist"),
        ([{"mass": 2.2, "recording": "short.csv"}], "is nowhere steady for 3 s"),
    ],
)
def test_a_hover_that_is_none_is_one_line(tmp_path, capsys, points, expected):
    flown(tmp_path / "short.csv", (616, 616, 616, 616), 0.0, seconds=5.0)
    assert run(tmp_path, {"experiments": [HOVER | {"points": points}]}) == 2
    assert expected in capsys.readouterr().err
