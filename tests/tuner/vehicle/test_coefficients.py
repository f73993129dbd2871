from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from docs.generate.pages import markdown_table
from tuner.config import CoefficientSettings, JobFile
from tuner.core.errors import ConfigError
from tuner.core.shipped import find_config
from tuner.objective.space import space_of
from tuner.vehicle import (
    COEFFICIENTS,
    REGISTRY,
    ControllerFile,
    initial_values,
    read_vehicle,
    with_values,
)
from tuner.vehicle.controller import FiltersSection
from tuner.vehicle.model import coefficients_in, model_of, with_coefficients

PAGE = Path(__file__).parents[3] / "docs" / "reference" / "coefficients.md"


@pytest.fixture(scope="module")
def vehicle():
    return read_vehicle(find_config("vehicles", "hovergames", Path()))


def test_the_default_fit_frees_what_flights_show_and_freezes_mass_and_rolling_moment(vehicle):
    names = space_of(vehicle, ControllerFile(), JobFile()).names
    assert len(names) == 12
    assert "mass" not in names
    assert "rolling_moment_coefficient" not in names
    assert {"estimate_latency", "actuator_latency"} <= set(names)


def test_values_come_back_from_the_search_vector(vehicle):
    space = space_of(
        vehicle,
        ControllerFile(),
        JobFile(free=("inertia_xx", "motor_constant", "estimate_latency")),
    )
    values = {"inertia_xx": 0.03, "motor_constant": 1.2e-5, "estimate_latency": 0.02}
    returned = space.numbers(space.vector_of(values))
    for name, value in values.items():
        assert float(returned[name]) == pytest.approx(value, rel=1e-9)


@given(st.lists(st.floats(-50, 50), min_size=12, max_size=12))
def test_no_step_leaves_the_bounds(steps):
    space = space_of(
        read_vehicle(find_config("vehicles", "hovergames", Path())), ControllerFile(), JobFile()
    )
    values = space.numbers(steps)
    for parameter in space.parameters:
        value = float(values[parameter.name])
        assert parameter.lower * (1 - 1e-9) <= value <= parameter.upper * (1 + 1e-9)


def test_slope_is_the_derivative_of_the_scaled_coordinate(vehicle):
    space = space_of(vehicle, ControllerFile(), JobFile())
    vector = space.initial + 0.3
    slope = (space.scaled(vector + 1e-6) - space.scaled(vector - 1e-6)) / 2e-6
    np.testing.assert_allclose(slope, space.slope(vector), rtol=1e-7)
    assert (1.0 / space.slope(np.full(len(space), -1e4)) ** 2 < np.inf).all()  # on every bound


def test_a_start_on_its_bound_is_moved_inside_and_remembered(vehicle):
    space = space_of(vehicle, ControllerFile(), JobFile(free=("estimate_latency",)))
    (parameter,) = space.parameters
    assert parameter.moved == 0.0
    assert 0 < parameter.initial < 0.02


def test_a_filter_that_the_rate_loop_cannot_have_is_not_looked_for(vehicle):
    free, slow = ("gyro_cutoff",), ControllerFile.model_validate({"rate": {"rate": 250.0}})
    (parameter,) = space_of(vehicle, ControllerFile(), JobFile(free=free)).parameters
    assert parameter.upper == 4 * ControllerFile().filters.gyro_cutoff
    (parameter,) = space_of(vehicle, slow, JobFile(free=free)).parameters
    assert 120.0 < parameter.upper < 125.0
    asked = JobFile.model_validate(
        {"free": free, "coefficients": {"gyro_cutoff": {"upper": 130.0}}}
    )
    with pytest.raises(ConfigError, match=r"not below half of rate\.rate \(125 Hz\); lower it"):
        space_of(vehicle, slow, asked)


def test_tied_coefficients_keep_their_ratio(vehicle):
    job = JobFile(free=("inertia_xx", "inertia_zz"), ties=(("inertia_xx", "inertia_zz"),))
    space = space_of(vehicle, ControllerFile(), job)
    assert space.names == ("inertia_xx",)
    values = space.numbers(space.initial + 1.0)
    ratio = vehicle.inertia.zz / vehicle.inertia.xx
    assert float(values["inertia_zz"] / values["inertia_xx"]) == pytest.approx(ratio)


def test_a_tie_to_a_fixed_coefficient_is_refused(vehicle):
    with pytest.raises(ConfigError, match="tied"):
        space_of(
            vehicle,
            ControllerFile(),
            JobFile(free=("inertia_xx",), ties=(("inertia_xx", "inertia_yy"),)),
        )


def test_bounds_of_the_job_file_hold(vehicle):
    settings = {"motor_constant": CoefficientSettings(lower=8e-6, upper=1e-5)}
    space = space_of(
        vehicle, ControllerFile(), JobFile(free=("motor_constant",), coefficients=settings)
    )
    assert float(space.numbers([99.0])["motor_constant"]) == pytest.approx(1e-5)


def test_every_coefficient_has_a_place_in_the_model(vehicle):
    model = model_of(vehicle, ControllerFile())
    for name in COEFFICIENTS:
        changed = with_coefficients(model, {name: jnp.asarray(123.0)})
        assert float(coefficients_in(changed)[name]) == 123.0
        others = {n: float(v) for n, v in coefficients_in(changed).items() if n != name}
        assert others == {n: float(v) for n, v in coefficients_in(model).items() if n != name}


def test_the_search_for_the_gyro_cutoff_starts_at_the_one_that_flies(vehicle):
    slower = ControllerFile(filters=FiltersSection(gyro_cutoff=30.0))
    job = JobFile(free=("gyro_cutoff",))
    (parameter,) = space_of(vehicle, slower, job).parameters
    assert parameter.initial == 30.0
    assert initial_values(vehicle, slower)["gyro_cutoff"] == 30.0
    quicker = with_values(vehicle, {"gyro_cutoff": 25.0})
    (parameter,) = space_of(quicker, slower, job).parameters
    assert parameter.initial == 25.0
    assert float(model_of(quicker, slower).controller.filters.gyro_cutoff) == 25.0


def test_a_filter_that_is_left_out_cannot_be_fitted(vehicle):
    none = ControllerFile(filters=FiltersSection(gyro_cutoff=None))
    with pytest.raises(ConfigError, match=r"setup\.gyro_cutoff"):
        space_of(vehicle, none, JobFile(free=("gyro_cutoff",)))
    assert "gyro_cutoff" not in space_of(vehicle, none, JobFile()).fixed


def test_a_freed_effect_starts_at_its_neutral_value_and_appears_in_the_model(vehicle):
    space = space_of(vehicle, ControllerFile(), JobFile(free=("fuselage_drag",)))
    (parameter,) = space.parameters
    assert parameter.moved is None
    assert float(space.numbers(space.initial)["fuselage_drag"]) == 0.0
    model = model_of(vehicle, ControllerFile())
    assert "fuselage_drag" not in coefficients_in(model)
    values = {n: np.asarray(v) for n, v in space.values(space.initial + 1.0).items()}
    moved = with_coefficients(model, values)
    assert float(coefficients_in(moved)["fuselage_drag"]) == pytest.approx(0.02, rel=0.01)


def test_an_effect_that_is_neither_in_the_file_nor_free_is_absent(vehicle):
    assert "fuselage_drag" not in space_of(vehicle, ControllerFile(), JobFile()).fixed
    given = with_values(vehicle, {"fuselage_drag": 0.01})
    assert space_of(given, ControllerFile(), JobFile()).fixed["fuselage_drag"] == 0.01
    assert float(coefficients_in(model_of(given, ControllerFile()))["fuselage_drag"]) == 0.01


def test_a_coefficient_that_is_zero_is_fitted_linearly_between_given_bounds(vehicle):
    off = with_values(vehicle, {"zero_position_armed": 0.0})
    free = ("zero_position_armed",)
    with pytest.raises(ConfigError, match="no logarithm"):
        space_of(off, ControllerFile(), JobFile(free=free))
    settings = CoefficientSettings(lower=0.0, upper=200.0, scale="linear")
    job = JobFile(free=free, coefficients={"zero_position_armed": settings})
    space = space_of(off, ControllerFile(), job)
    (parameter,) = space.parameters
    assert parameter.initial == pytest.approx(10.0)  # off the bound
    assert parameter.prior_sd > 0.0
    assert np.isfinite(space.prior_residuals(space.initial)).all()


@pytest.mark.parametrize("start", [-0.02, -0.03])
def test_a_negative_start_on_or_beyond_its_bound_is_moved_just_inside(vehicle, start):
    name = "center_of_mass_x"
    job = JobFile(free=(name,), coefficients={name: CoefficientSettings(lower=-0.02, upper=0.05)})
    space = space_of(with_values(vehicle, {name: start}), ControllerFile(), job)
    (parameter,) = space.parameters
    assert parameter.moved == start
    assert parameter.initial == pytest.approx(-0.0165)
    assert space.numbers(space.initial)[name] == pytest.approx(-0.0165)


def test_every_row_is_complete():
    for name, row in REGISTRY.items():
        assert row.name == name
        assert row.meaning
        assert row.source
        assert row.prior_sd > 0
        assert bool(row.place[1]) == (row.scope in ("vehicle", "setup"))
        if row.place[1]:
            assert set(row.exported_as) == {"sdf", "px4"}
            low, high = row.limits(1.0)
            assert low < high
        if row.is_effect:
            assert row.neutral is not None
            assert row.scale == "linear" or row.neutral > 0
            low, high = row.limits(row.neutral)
            assert low < row.neutral < high


def test_the_table_of_the_reference_is_the_registrys():
    assert markdown_table() in PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "bounds", "expected"),
    [
        ("moment_constant", (-0.1, 0.1), "moment_constant is -0.1; it should be at least 0"),
        ("motor_constant", (1e-3, 1e-2), "mean 1e-05 is not within 0.001 to 0.01"),
        ("estimate_latency", (0.0, 0.5), "estimate_latency is 0.5; it should be at most 0.1"),
    ],
)
def test_bounds_that_no_vehicle_file_or_prior_can_hold_are_refused(vehicle, name, bounds, expected):
    given = dict(zip(("lower", "upper"), bounds, strict=True)) | {"scale": "linear"}
    given["prior"] = {"mean": 1e-5, "sd": 1e-5}
    with pytest.raises(ConfigError, match=expected):
        space_of(vehicle, ControllerFile(), JobFile(coefficients={name: given}))


def test_what_goes_with_another_has_no_bounds_of_its_own(vehicle):
    ties, bounds = (("inertia_xx", "inertia_yy"),), {"lower": 0.01, "upper": 0.05}
    space_of(vehicle, ControllerFile(), JobFile(ties=ties, coefficients={"inertia_xx": bounds}))
    with pytest.raises(ConfigError, match="'inertia_yy' goes with 'inertia_xx', and has bounds"):
        space_of(vehicle, ControllerFile(), JobFile(ties=ties, coefficients={"inertia_yy": bounds}))
