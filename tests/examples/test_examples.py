"""The examples run as they are documented, and say what they should."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from examples import published_experiments, simulate_bench
from tuner.exporters.targets.px4 import read_parameters
from tuner.result import read_run
from tuner.vehicle import read_vehicle

ROOT = Path(__file__).resolve().parents[2]


def said_by(example: str, folder: Path, *arguments: str) -> str:
    """Run an example in a folder, and return what it prints."""
    done = subprocess.run(
        [sys.executable, ROOT / "examples" / example, *arguments],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.long
@pytest.mark.slow
def test_the_example_goes_from_recordings_to_a_simulator(tmp_path):
    said = said_by("fit_and_use.py", tmp_path, str(tmp_path))
    assert "closest so far: hovergames_updated" in said

    run = read_run(tmp_path / "run")
    held_out = next(flight for flight in run.result.flights if flight.split == "holdout")
    assert held_out.rmse_best.x < held_out.rmse_initial.x / 50
    assert run.vehicle.aerodynamics.motor_constant == pytest.approx(1.386e-5, rel=0.02)

    model = (tmp_path / "quad_x.sdf").read_text()
    assert f"<motorConstant>{run.vehicle.aerodynamics.motor_constant:.12g}</motorConstant>" in model
    assert 0.4 < read_parameters(tmp_path / "quad_x.params")["MPC_THR_HOVER"] < 0.7
    assert (tmp_path / "before.html").exists()
    assert read_vehicle(tmp_path / "run" / "best_fit.yaml") == run.vehicle


@pytest.mark.slow
def test_the_experiments_show_what_was_published(capsys):
    published_experiments.main("hovergames")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]

    hover = {words[0]: [float(word) for word in words[1:]] for words in lines if len(words) == 4}
    assert hover["original"] == pytest.approx([0.672, 772, 0.013], abs=0.6)
    assert hover["original"][::2] == pytest.approx([0.672, 0.013], abs=1.5e-3)
    assert hover["updated"][1] == pytest.approx(616, abs=0.6)
    assert hover["updated"][::2] == pytest.approx([0.543, 0.12], abs=1.5e-3)

    curves = [words for words in lines if "ms" in words]
    assert len(curves) == 2 * 5 * 2
    for words in curves:
        if words[words.index("ms") - 1] == "0":
            assert words[-1] == "steady"
    assert any("oscillates," in words for words in curves)

    circles = [words for words in lines if words[:1] == ["circle"]]
    assert [float(words[1]) for words in circles] == 2 * [2.1, 2.4, 3.2, 4.0]
    original, updated = float(circles[0][2]), float(circles[0][5])
    assert 0.3 < updated < original < 1.0


def test_the_shipped_recordings_come_from_the_script(tmp_path, monkeypatch, capsys):
    shipped = simulate_bench.FOLDER
    shutil.copy(shipped / "truth.yaml", tmp_path)
    monkeypatch.setattr(simulate_bench, "FOLDER", tmp_path)
    simulate_bench.main()
    recordings = sorted(shipped.glob("*.csv"))
    assert len(recordings) == 7
    for path in recordings:
        tables = [
            np.genfromtxt(place / path.name, delimiter=",", names=True).tolist()
            for place in (shipped, tmp_path)
        ]
        np.testing.assert_allclose(*tables, rtol=1e-4, atol=1e-6)
    plan = (shipped / "bench.yaml").read_text()
    for point in re.findall(r"\{.*?\}", capsys.readouterr().out):
        assert point.replace(".0,", ",") in plan
