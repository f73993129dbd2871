from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.coefficients import HABITS, space_of
from tuner.config import COEFFICIENTS, ControllerFile, JobFile, read_vehicle
from tuner.config.job import CoefficientSettings
from tuner.config.shipped import find_config
from tuner.errors import ConfigError
from tuner.model import model_of, with_coefficients


@pytest.fixture(scope="module")
def vehicle():
    return read_vehicle(find_config("vehicles", "hovergames", Path()))


def test_the_default_fit_frees_what_flights_show_and_freezes_mass_and_rolling_moment(vehicle):
    names = space_of(vehicle, JobFile()).names
    assert len(names) == 12
    assert "mass" not in names
    assert "rolling_moment_coefficient" not in names
    assert {"estimate_latency", "actuator_latency"} <= set(names)


def test_values_come_back_from_the_search_vector(vehicle):
    space = space_of(vehicle, JobFile(free=("inertia_xx", "motor_constant", "estimate_latency")))
    values = {"inertia_xx": 0.03, "motor_constant": 1.2e-5, "estimate_latency": 0.02}
    found = space.values(jnp.asarray(space.vector_of(values)))
    for name, value in values.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-9)


@given(st.lists(st.floats(-50, 50), min_size=12, max_size=12))
def test_no_step_leaves_the_bounds(steps):
    space = space_of(read_vehicle(find_config("vehicles", "hovergames", Path())), JobFile())
    found = space.values(jnp.asarray(steps))
    for parameter in space.parameters:
        value = float(found[parameter.name])
        assert parameter.lower * (1 - 1e-9) <= value <= parameter.upper * (1 + 1e-9)


def test_slope_is_the_derivative_of_the_scaled_coordinate(vehicle):
    space = space_of(vehicle, JobFile())
    vector = space.initial + 0.3
    slope = np.diag(np.asarray(jax.jacfwd(space.scaled)(jnp.asarray(vector))))
    np.testing.assert_allclose(slope, space.slope(vector), rtol=1e-9)


def test_a_start_on_its_bound_is_moved_inside_and_remembered(vehicle):
    space = space_of(vehicle, JobFile(free=("estimate_latency",)))
    (parameter,) = space.parameters
    assert parameter.moved == 0.0
    assert 0 < parameter.initial < 0.02


def test_tied_coefficients_keep_their_ratio(vehicle):
    job = JobFile(free=("inertia_xx", "inertia_zz"), ties=(("inertia_xx", "inertia_zz"),))
    space = space_of(vehicle, job)
    assert space.names == ("inertia_xx",)
    found = space.values(jnp.asarray(space.initial + 1.0))
    ratio = vehicle.inertia.zz / vehicle.inertia.xx
    assert float(found["inertia_zz"] / found["inertia_xx"]) == pytest.approx(ratio)


def test_a_tie_to_a_fixed_coefficient_is_refused(vehicle):
    with pytest.raises(ConfigError, match="tied"):
        space_of(vehicle, JobFile(free=("inertia_xx",), ties=(("inertia_xx", "inertia_yy"),)))


def test_bounds_of_the_job_file_hold(vehicle):
    settings = {"motor_constant": CoefficientSettings(lower=8e-6, upper=1e-5)}
    space = space_of(vehicle, JobFile(free=("motor_constant",), coefficients=settings))
    assert float(space.values(jnp.asarray([99.0]))["motor_constant"]) == pytest.approx(1e-5)


def test_every_coefficient_has_a_habit_and_a_place_in_the_model(vehicle):
    assert set(HABITS) == set(COEFFICIENTS)
    model = model_of(vehicle, ControllerFile())
    for name in COEFFICIENTS:
        changed = with_coefficients(model, {name: jnp.asarray(123.0)})
        differing = [
            new
            for old, new in zip(jax.tree.leaves(model), jax.tree.leaves(changed), strict=True)
            if not np.array_equal(old, new)
        ]
        assert differing == [123.0]
