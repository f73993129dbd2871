"""Real Crazyflie flights through the actuator inlet; skipped where they are not at hand."""

import os
from pathlib import Path

import pytest

from tuner.job.run import run
from tuner.options import Options

ROOT = Path(__file__).parents[3]
FLIGHTS = (
    Path(os.environ.get("TUNE_REAL_FLIGHTS", ROOT.parent / "shared" / "flights")) / "nanobench"
)
FITTED = ("B2_circle_fast_rep1", "B5_helix_medium_rep1")
HELD_OUT = ("B2_circle_slow_rep1", "B3_figure8_medium_rep1")


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.skipif(not FLIGHTS.is_dir(), reason=f"no real recordings in {FLIGHTS}")
def test_held_out_flights_are_met_twice_as_well_as_by_the_unfitted_vehicle(tmp_path):
    options = Options(
        [str(FLIGHTS / f"{name}.csv") for name in (*FITTED, *HELD_OUT)],
        config=str(ROOT / "configs" / "jobs" / "crazyflie.yaml"),
        holdout=list(HELD_OUT),
    )
    folder, result = run(options, out=tmp_path / "run")
    held = [flight for flight in result.flights if flight.split == "holdout"]
    assert {flight.name for flight in held} == set(HELD_OUT)
    for flight in held:
        for axis, before in flight.rmse_initial:
            assert getattr(flight.rmse_best, axis) < 0.5 * before, (flight.name, axis)
        assert flight.horizon == 0.5
        assert flight.input_late == pytest.approx(0.0, abs=2e-3)
        (_, before), (_, after) = flight.predicted_initial, flight.predicted_best
        for name in ("position", "velocity", "attitude", "body_rate"):
            assert getattr(after, name) < 0.5 * getattr(before, name), (flight.name, name)
    assert result.settings["window_starts"] == {}
    assert result.coefficients["torque_trim_x"].best != 0.0
    assert (folder / "report.html").exists()
