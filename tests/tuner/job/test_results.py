"""What a finished search is reported as."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from tuner.config import JobFile
from tuner.core.numerics import Z95
from tuner.job.results import _regressed
from tuner.objective.space import space_of
from tuner.search.problem import Job
from tuner.search.progress import best_values
from tuner.uncertainty.verdict import ReasonCode, Verdict
from tuner.vehicle import ControllerFile
from tuner.vehicle.controller import FiltersSection


@pytest.mark.parametrize(("name", "initial"), [("gyro_cutoff", 30.0), ("fuselage_drag", 0.0)])
def test_what_the_vehicle_file_leaves_open_is_held_at_the_value_that_flies(name, initial, updated):
    controller = ControllerFile(filters=FiltersSection(gyro_cutoff=30.0))
    space = space_of(updated, controller, JobFile(free=(name, "motor_constant")))
    settings = SimpleNamespace(vehicle=updated, controller=controller)
    point = SimpleNamespace(coefficients=jnp.asarray(space.initial + 0.5))
    job = Job(settings, (), {}, space, objective=None, user_settings=settings)
    values = best_values(job, SimpleNamespace(point=point, held={name: name}))
    assert values[name] == initial
    assert values["motor_constant"] > updated.aerodynamics.motor_constant


@pytest.mark.parametrize(("name", "best"), [("inertia_xx", 0.02), ("torque_trim_x", 0.02)])
@pytest.mark.parametrize(
    ("relative", "verdict"), [(0.1, "weakly_known"), (0.4, "not_identifiable")]
)
def test_a_coefficient_by_regression_has_its_interval_inside_the_bounds(
    name, best, relative, verdict
):
    error = relative if name == "inertia_xx" else relative * best
    found = _regressed(name, 0.01, best, error, (0.001, 1.1 * best))
    low = best * np.exp(-Z95 * relative) if name == "inertia_xx" else best * (1 - Z95 * relative)
    assert found.std_error == pytest.approx(relative * best)
    assert found.ci95 == pytest.approx((max(low, 0.001), 1.1 * best))
    assert found.verdict is Verdict(verdict)
    assert found.identifiable == (found.reason.code is ReasonCode.REGRESSED) == (relative < 0.25)
    assert found.reason.half_width == pytest.approx(Z95 * error)
