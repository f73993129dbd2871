"""What surrounds each flight: enters its simulation alone, and is estimated beside its clocks."""

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import criterion_of, problem, truth, with_data
from tuner.objective.criterion import OFFSET_SD, Point, units_of
from tuner.objective.information import information_at
from tuner.objective.normal_equations import normal_equations, with_conditions
from tuner.objective.segments import OFFSETS
from tuner.vehicle import condition_rows

NAMES = ("wind_x", "wind_y", "battery_decline")
TRUTH = np.array([[0.3, -0.2], [0.1, 0.25], [1e-3, 3e-3]])


def rows_of(values):
    """Return a point's rows (offsets and conditions, 2) without clock offsets."""
    units = units_of(NAMES)[:, None]
    return jnp.asarray(np.concatenate([np.zeros((len(OFFSETS), 2)), values / units]))


@pytest.fixture(scope="module")
def fit():
    """Return a fit with wind and a declining battery in its data, and its true point."""
    plain = problem(("motor_constant",))
    objective, point = with_conditions(plain, truth(plain), NAMES)
    point = Point(point.coefficients, rows_of(TRUTH))
    return with_data(objective, point), point


def equations(objective, point):
    criterion = criterion_of(objective, prior=0.0)
    sums = objective.sums(point, criterion)
    return normal_equations(objective, point, criterion, sums)


def test_the_prior_of_a_condition_is_that_of_an_offset_in_its_unit():
    for name, row in condition_rows().items():
        assert units_of([name])[0] * OFFSET_SD == pytest.approx(row.prior_sd)
    assert set(NAMES) <= set(condition_rows())


def test_no_wind_and_a_steady_battery_change_nothing():
    plain = problem(("motor_constant",))
    point = plain.start(plain.space.initial + 0.2)
    criterion = criterion_of(plain)
    wider, there = with_conditions(plain, point, NAMES)
    before = plain.sums(point, criterion, derivatives=False)
    after = wider.sums(there, criterion, derivatives=False)
    np.testing.assert_allclose(after.loss, before.loss, rtol=1e-12)
    for name, squares in before.squares.items():
        np.testing.assert_allclose(after.squares[name], squares, rtol=1e-12)


@pytest.mark.parametrize("names", [(), NAMES])
def test_derivatives_by_per_flight_parameters_are_those_among_all(names):
    plain = problem(("motor_constant",))
    objective, point = with_conditions(plain, plain.start(plain.space.initial + 0.2), names)
    criterion = criterion_of(objective)
    among, own = (objective.sums(point, criterion, still=still) for still in (False, True))
    np.testing.assert_allclose(own.loss, among.loss, rtol=1e-12)
    np.testing.assert_allclose(own.gradient, among.gradient[1:], rtol=1e-9)
    np.testing.assert_allclose(own.hessian, among.hessian[1:, 1:], rtol=1e-9)
    assert np.abs(own.gradient).max() > 0.0


def test_the_gradient_is_the_finite_difference(fit):
    objective, point = fit
    point = Point(point.coefficients, 0.5 * point.offsets)
    _, gradient, _ = equations(objective, point)
    by_row = np.asarray(gradient[1:]).reshape(len(OFFSETS) + len(NAMES), 2)
    for row in range(len(NAMES)):
        step = jnp.zeros_like(point.offsets).at[len(OFFSETS) + row, 0].set(1e-4)
        above = equations(objective, Point(point.coefficients, point.offsets + step))[0]
        below = equations(objective, Point(point.coefficients, point.offsets - step))[0]
        expected = float(above - below) / 2e-4
        assert by_row[len(OFFSETS) + row, 0] == pytest.approx(expected, rel=1e-3, abs=1e-9)


def test_each_flights_own_are_estimated(fit):
    objective, point = fit
    first = 1 + 2 * len(OFFSETS)
    rows = jnp.zeros_like(point.offsets)
    for _ in range(6):
        _, gradient, hessian = equations(objective, Point(point.coefficients, rows))
        step = -np.linalg.solve(hessian[first:, first:], gradient[first:])
        rows = rows.at[len(OFFSETS) :].add(step.reshape(len(NAMES), 2))
    values = np.asarray(rows[len(OFFSETS) :]) * units_of(NAMES)[:, None]
    np.testing.assert_allclose(values, TRUTH, rtol=0.01)


def test_per_flight_parameters_cost_information(fit):
    objective, point = fit
    criterion, known = criterion_of(objective), np.zeros(point.offsets.shape, bool)
    estimated = known.copy()
    estimated[len(OFFSETS) :] = True
    certain = information_at(objective, point, criterion, offsets_fitted=known)
    doubtful = information_at(objective, point, criterion, offsets_fitted=estimated)
    assert 0 < float(doubtful.data[0, 0]) < 0.99 * float(certain.data[0, 0])
