from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tuner.core.errors import InputError
from tuner.evaluate.closed_loop import fly, grid_of
from tuner.evaluate.simulation_files import roll_pitch_yaw, summary_of, write_csv, write_flights
from tuner.options import SimulationOptions
from tuner.recordings.loader import load_flight

COLUMNS = [
    *("time", "x", "y", "z", "vx", "vy", "vz", "qw", "qx", "qy", "qz", "roll", "pitch", "yaw"),
    *("wx", "wy", "wz", "rotor_speed_1", "rotor_speed_2", "rotor_speed_3", "rotor_speed_4"),
    *("command_1", "command_2", "command_3", "command_4", "thrust_setpoint"),
    *("ref_x", "ref_y", "ref_z", "ref_vx", "ref_vy", "ref_vz", "ref_ax", "ref_ay", "ref_az"),
]


def test_csv_has_the_promised_columns_and_every_digit(circle, tmp_path):
    write_flights([circle], tmp_path / "c.csv")
    table = pd.read_csv(tmp_path / "c.csv", float_precision="round_trip")
    assert list(table.columns) == COLUMNS
    np.testing.assert_array_equal(table["time"], circle.time)
    np.testing.assert_array_equal(table[["x", "y", "z"]], circle.signals["position"])
    np.testing.assert_array_equal(table[["qw", "qx", "qy", "qz"]], circle.signals["attitude"])
    np.testing.assert_array_equal(table[["wx", "wy", "wz"]], circle.signals["body_rate"])
    np.testing.assert_array_equal(table["ref_ay"], circle.signals["reference_acceleration"][:, 1])
    assert [file.name for file in tmp_path.iterdir()] == ["c.csv"]


def test_angles_are_degrees_of_yaw_then_pitch_then_roll():
    half = np.deg2rad(15)
    roll = [np.cos(half), np.sin(half), 0, 0]
    pitch = [np.cos(half), 0, np.sin(half), 0]
    yaw = [np.cos(half), 0, 0, np.sin(half)]
    np.testing.assert_allclose(
        roll_pitch_yaw(np.array([roll, pitch, yaw])), 30 * np.eye(3), atol=1e-12
    )
    yaw_then_roll = [0.5, 0.5, 0.5, 0.5]  # 90 degrees about z, then 90 about the new x
    np.testing.assert_allclose(roll_pitch_yaw(np.array([yaw_then_roll])), [[90, 0, 90]], atol=1e-6)


def test_tune_reads_its_own_bag(circle, tmp_path):
    write_flights([circle], tmp_path / "circle.bag")
    flight = load_flight(tmp_path / "circle.bag")
    assert flight.duration == pytest.approx(4.0, abs=0.011)
    assert not [note for note in flight.notes if note.kind == "warning"]
    tolerance = {"command": 5e-4, "thrust_setpoint": 1e-7, "rotor_speed": 1e-3}
    for name, values in circle.signals.items():
        if name != "lap":
            np.testing.assert_allclose(
                flight.signals[name],
                values[: len(flight.time)],
                atol=tolerance.get(name, 1e-12),
                err_msg=name,
            )


def test_what_comes_before_time_zero_is_hover_and_a_voltmeter_reads_now_and_then(circle, tmp_path):
    rows = len(circle.time)
    volts = np.where(np.arange(rows) % 10 == 0, 16.0 - 0.01 * circle.time, np.nan)[:, None]
    signals = {**circle.signals, "battery_voltage": volts}
    begun = replace(circle, time=circle.time - 1.0, signals=signals)
    write_flights([begun], tmp_path / "circle.bag")
    flight = load_flight(tmp_path / "circle.bag")
    assert flight.duration == pytest.approx(3.0, abs=0.011)
    read = flight.series["battery_voltage"]
    np.testing.assert_allclose(read.values[:, 0], volts[::10, 0], rtol=1e-6)
    np.testing.assert_allclose(read.time, circle.time[::10] - 1.0, atol=1e-6)
    np.testing.assert_allclose(
        flight.signals["position"][0], circle.signals["position"][100], atol=1e-12
    )


def test_the_same_flight_gives_the_same_bag(circle, tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        write_flights([circle], tmp_path / name / "c.bag")
    assert (tmp_path / "a/c.bag").read_bytes() == (tmp_path / "b/c.bag").read_bytes()


def test_a_bag_holds_one_flight_and_other_suffixes_none(circle, tmp_path):
    with pytest.raises(InputError, match="holds one flight"):
        write_flights([circle, circle], tmp_path / "c.bag")
    with pytest.raises(InputError, match=r"'\.txt'"):
        write_flights([circle], tmp_path / "c.txt")
    (tmp_path / "file").touch()
    for name in ("c.bag", "c.csv"):
        with pytest.raises(InputError, match="cannot be written"):
            write_flights([circle], tmp_path / "file" / name)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_failure_leaves_no_half_file(circle, tmp_path):
    def broken():
        yield circle
        raise InputError("x", "broke", "mend it")

    with pytest.raises(InputError, match="broke"):
        write_csv(broken(), tmp_path / "c.csv")
    assert not list(tmp_path.iterdir())


def test_a_summary_says_how_fast_and_how_far_off(circle):
    summary = summary_of(circle)
    error = circle.signals["position"][:, 0] - circle.signals["reference_position"][:, 0]
    assert summary.tracking_rmse[0] == pytest.approx(np.sqrt(np.mean(error**2)))
    assert summary.top_speed == np.linalg.norm(circle.signals["velocity"], axis=1).max()
    assert summary.crash_time is None


def test_sweeps_combine_with_the_last_varying_fastest():
    grid = grid_of(["motor_constant=1e-5:2e-5:3", "mass=2:3:2"])
    np.testing.assert_allclose(grid["motor_constant"], np.repeat([1e-5, 1.5e-5, 2e-5], 2))
    np.testing.assert_allclose(grid["mass"], [2, 3, 2, 3, 2, 3])
    np.testing.assert_allclose(grid_of(["mass=2.5"])["mass"], [2.5])


@pytest.mark.parametrize(
    ("sweep", "expected"),
    [
        (["mas=1:2:3"], "did you mean 'mass'"),
        (["mass=1:2"], "'mass=1:2' is no range"),
        (["mass=1:2:0"], "is no range"),
        (["mass=1:2:2.5"], "is no range"),
        (["mass=a:b:c"], "is no range"),
        (["mass=1:nan:3"], "is no range"),
        (["mass"], "is no range"),
        (["mass=1:2:3", "mass=1:2:3"], "twice"),
        (["mass=1:2:1000", "inertia_xx=1:2:1000"], "asks for 1000000 flights"),
        (  # 2 to the power of 64
            [f"{n}=1:2:65536" for n in ("mass", "inertia_xx", "inertia_yy", "motor_constant")],
            "asks for 18446744073709551616 flights",
        ),
    ],
)
def test_a_wrong_sweep_is_named(sweep, expected):
    with pytest.raises(InputError, match=expected):
        grid_of(sweep)


def test_a_grid_goes_into_one_table(tmp_path):
    grid = grid_of(["motor_constant=1.3e-5:1.5e-5:2", "inertia_xx=0.025"])
    hover = SimulationOptions(trajectory="hover", vehicle="hovergames_updated", duration=4.0)
    flights = fly(hover, grid=grid)
    summaries = write_flights(flights, tmp_path / "g.csv")
    table = pd.read_csv(tmp_path / "g.csv")
    assert list(table.columns) == ["motor_constant", "inertia_xx", *COLUMNS]
    assert table.groupby("motor_constant")["time"].count().tolist() == [401, 401]
    constants = [summary.coefficients["motor_constant"] for summary in summaries]
    assert constants == pytest.approx([1.3e-5, 1.5e-5])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"radius": -1.0}, "--radius: is -1.0"),
        ({"duration": 0.0}, "--duration: is 0.0"),
        ({"rate": float("inf")}, "--rate: is inf"),
        ({"vehicle": "nope"}, "shipped vehicles"),
        ({"controller": "nope.yaml"}, "does not exist"),
    ],
)
def test_what_cannot_be_flown_is_refused_in_one_line(tmp_path, options, expected):
    asked = SimulationOptions(**{"trajectory": "hover"} | options)
    with pytest.raises(InputError) as error:
        write_flights(fly(asked), tmp_path / "c.csv")
    assert expected in str(error.value)
    assert "\n" not in str(error.value)
    assert not list(Path(tmp_path).iterdir())
