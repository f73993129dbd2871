import os
import subprocess
import sys
from pathlib import Path

import pytest

from tuner.exporters.targets.px4 import read_parameters
from tuner.result import read_run
from tuner.vehicle import read_vehicle

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
@pytest.mark.slow
def test_the_example_goes_from_recordings_to_a_simulator(tmp_path):
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / "fit_and_use.py", tmp_path],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "closest so far: hovergames_updated" in done.stdout

    run = read_run(tmp_path / "run")
    held_out = next(flight for flight in run.result.flights if flight.split == "holdout")
    assert held_out.rmse_best.x < held_out.rmse_initial.x / 50
    assert run.vehicle.aerodynamics.motor_constant == pytest.approx(1.386e-5, rel=0.02)

    model = (tmp_path / "quad_x.sdf").read_text()
    assert f"<motorConstant>{run.vehicle.aerodynamics.motor_constant:.12g}</motorConstant>" in model
    assert 0.4 < read_parameters(tmp_path / "quad_x.params")["MPC_THR_HOVER"] < 0.7
    assert (tmp_path / "before.html").exists()
    assert read_vehicle(tmp_path / "run" / "best_fit.yaml") == run.vehicle
