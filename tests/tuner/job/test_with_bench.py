"""Ground measurements in a fit of a shipped recording whose truth is known."""

from pathlib import Path

import pytest
import yaml

from tuner.findings.findings import Code
from tuner.job.bench import bench
from tuner.job.run import run
from tuner.options import Options

FLIGHTS = Path(__file__).parents[3] / "reference_flights"


@pytest.mark.long
@pytest.mark.slow
def test_a_wrong_rig_is_named_and_a_right_one_agrees(tmp_path):
    truth = yaml.safe_load((FLIGHTS / "truth.yaml").read_text())
    hover = 630.0  # rad/s at 2.243 kg, by the truth's motor constant
    plan = {
        "experiments": [
            {"kind": "hover_weights", "points": [{"mass": 2.243, "rotor_speed": 0.95 * hover}]},
            {
                "kind": "propeller",
                "diameter": 0.2794,
                "thrust_coefficient": 0.1,
                "power_coefficient": 0.05,
            },
        ]
    }
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump(plan))
    ground = bench(path, out=tmp_path / "ground")
    options = Options([str(FLIGHTS / "lemniscate_4mps.bag")], bench=str(ground.folder))
    _, result = run(options, out=tmp_path / "run")
    motor, moment = result.sources["motor_constant"], result.sources["moment_constant"]
    assert motor.flights == pytest.approx(truth["motor_constant"], rel=0.002)
    assert motor.ground == pytest.approx(truth["motor_constant"] / 0.95**2, rel=0.01)
    assert motor.deviation < -3
    assert abs(moment.deviation) < 3
    conflicts = [f.subject for f in result.findings if f.code is Code.GROUND_CONFLICT]
    assert conflicts == ["motor_constant"]
    assert result.coefficients["motor_constant"].initial == pytest.approx(motor.ground)
