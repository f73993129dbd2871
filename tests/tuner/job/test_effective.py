"""A whole job of a vehicle with terms that Gazebo lacks: what it exports in their place."""

import re

import pytest

from tuner.config import TrajectorySettings
from tuner.evaluate.closed_loop import simulate
from tuner.evaluate.simulation_files import write_flights
from tuner.exporters import effective
from tuner.exporters.effective import find_effective, recordings_of
from tuner.exporters.simulators import GAZEBO_CLASSIC
from tuner.job.run import run
from tuner.options import Options
from tuner.result import read_run
from tuner.vehicle import ControllerFile, values_of, with_values, write_vehicle

LACKED = {
    "fuselage_drag": 0.05,
    "rotor_drag_ratio_y": 2.0,
    "thrust_inflow_coefficient": 1e-3,
    "rotor_inertia": 2e-4,
}
JOB = """\
free: [inertia_xx, inertia_yy, inertia_zz, time_constant_up, time_constant_down, motor_constant,
  moment_constant, rotor_drag_coefficient]
terms: none
disturbances: none
"""


def test_coefficients_for_gazebo_end_at_the_bottom_of_their_valley(updated, tmp_path, monkeypatch):
    """A search that leaves ten thousand times less to gain finds the same ones."""
    vehicle = updated.replace(effects=LACKED)
    start = with_values(vehicle, {"motor_constant": 1.4e-5, "rotor_drag_coefficient": 3e-4})
    write_vehicle(start, tmp_path / "vehicle.yaml")
    shape = TrajectorySettings(name="circle", radius=1.0, omega=1.0, speed_scale=3.0)
    bag, job = tmp_path / "circle.bag", tmp_path / "job.yaml"
    write_flights(simulate(vehicle, ControllerFile(), shape, duration=8.0), bag)
    job.write_text(JOB)
    folder, result = run(
        Options([str(bag)], vehicle=str(tmp_path / "vehicle.yaml"), config=str(job), force=True),
        out=tmp_path / "run",
    )
    finished = read_run(folder)
    assert {term.group for term in result.effective.lost} == {
        "fuselage_drag",
        "rotor_drag_ratio",
        "thrust_inflow",
        "rotor_inertia",
    }
    ended = values_of(finished.effective)
    (sdf,) = folder.glob("**/*.sdf")
    (exported,) = set(re.findall("<timeConstantUp>(.*)</timeConstantUp>", sdf.read_text()))
    assert float(exported) == pytest.approx(ended["time_constant_up"])

    monkeypatch.setattr(effective, "MIN_TOLERANCE", 1e-8)
    further = values_of(find_effective(finished, GAZEBO_CLASSIC, recordings_of).vehicle)
    assert ended == pytest.approx(further, rel=0.02)
    assert finished.effective.inertia == finished.vehicle.inertia  # the fit's is no rigid body's
