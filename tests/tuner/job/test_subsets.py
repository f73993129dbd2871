"""A run ends in a result, each part explained, whatever is free, flown, in the model and fed in."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tuner.core.errors import InputError
from tuner.findings.findings import Code
from tuner.job.run import run
from tuner.options import Options
from tuner.result import read_run

FREE = (
    "inertia_xx",
    "inertia_zz",
    "input_scaling",
    "zero_position_armed",
    "time_constant_up",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "estimate_latency",
)
TERMS = ("none", "[rotor_drag_ratio]", "[center_of_mass, rotor_inertia]", "auto")
INLETS = ("reference", "body_rate", "actuator", "rotor_speed", "attitude")


@pytest.mark.slow
@pytest.mark.parametrize("draw", range(5))
def test_a_draw_of_what_is_fitted_ends_in_a_result(
    draw: int, bag: Path, full_bag: Path, tmp_path: Path
) -> None:
    """Or in one line that says why not: never in a fault, nor with a part that failed."""
    random = np.random.default_rng(draw)
    free = random.choice(FREE, size=int(random.integers(1, 4)), replace=False)
    bags = [str(bag), str(full_bag)] if random.random() < 0.5 else [str(full_bag)]
    job, folder = tmp_path / "job.yaml", tmp_path / "run"
    job.write_text(
        f"free: [{', '.join(free)}]\nterms: {random.choice(TERMS)}\n"
        f"disturbances: none\ninlet: {INLETS[draw % len(INLETS)]}\n"
    )
    options = Options(flights=bags, vehicle="hovergames_updated", config=str(job), force=True)
    try:
        run(options, out=folder)
    except InputError:  # in one line
        return
    result = read_run(folder).result
    assert not [f for f in result.findings if f.code is Code.PART_FAILED]
    for name in free:
        assert np.isfinite(result.coefficients[name].best)
