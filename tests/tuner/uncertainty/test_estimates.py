"""Uncertainty of simulated fits with a known answer."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.objective.criterion import Point
from tuner.objective.normal import Objective
from tuner.search.normal_equations import normal_equations
from tuner.uncertainty.estimates import Uncertainty, uncertainty_of
from tuner.uncertainty.information import information_at
from tuner.uncertainty.verdict import Verdict

FREE = (
    "mass",
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "input_scaling",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
    "estimate_latency",
)
CLOCKS = np.array([[True, False], [True, True], [True, True], [False, False], [True, False]])


@pytest.fixture(scope="module")
def objective() -> Objective:
    exact = making.problem(FREE)
    return making.with_data(exact, making.truth(exact), noise=np.random.default_rng(0))


@pytest.fixture(scope="module")
def found(objective: Objective) -> Uncertainty:
    fitted = making.fitted_of(objective, making.truth(objective))
    return uncertainty_of(fitted, clocks=CLOCKS)


def test_information_is_the_searchs_own_with_clock_offsets_eliminated(
    objective: Objective,
) -> None:
    offsets = np.random.default_rng(1).normal(0.0, 0.1, CLOCKS.shape)
    point = Point(making.truth(objective).coefficients + 0.01, jnp.asarray(offsets))
    criterion = making.criterion_of(objective)
    sums = objective.sums(point, criterion, derivatives=True)
    _, _, hessian = normal_equations(
        objective.space, objective.segments.flight, point, criterion, sums
    )
    compared = sum(float(n.sum()) for n in sums.counts.values())
    count = len(objective.space)
    kept = np.concatenate([np.arange(count), count + np.flatnonzero(CLOCKS)])
    covariance = np.linalg.inv(np.asarray(hessian)[np.ix_(kept, kept)] * compared)[:count, :count]
    slope = objective.space.slope(np.asarray(point.coefficients))
    information = information_at(objective, point, criterion, clocks=CLOCKS)
    ours = np.linalg.inv(information.total)
    assert ours == pytest.approx(covariance * np.outer(slope, slope), rel=1e-5)


def test_residuals_at_the_truth_are_as_large_as_the_noise(objective: Objective) -> None:
    information = information_at(objective, making.truth(objective), making.criterion_of(objective))
    assert information.spread == pytest.approx(1.0, abs=0.15)
    assert not information.crashed.any()


def test_a_freed_mass_is_not_identifiable_and_the_direction_is_named(found: Uncertainty) -> None:
    worst = found.directions[0]
    assert worst.null
    assert worst.common_scale
    assert set(worst.moves) == {
        "mass",
        "inertia_xx",
        "inertia_yy",
        "inertia_zz",
        "motor_constant",
        "rotor_drag_coefficient",
        "rolling_moment_coefficient",
    }
    assert found.estimates["mass"].verdict is Verdict.NOT_IDENTIFIABLE
    assert found.estimates["mass"].reason.direction == worst
    assert not found.estimates["motor_constant"].identifiable


def test_ratios_stay_known_beside_a_freed_mass(found: Uncertainty) -> None:
    assert found.estimates["moment_constant"].verdict is Verdict.WELL_KNOWN
    assert found.estimates["input_scaling"].verdict is Verdict.WELL_KNOWN


def test_shares_add_up_and_are_nobodys_debt(found: Uncertainty) -> None:
    assert found.shares.min() > -1e-6
    whole = found.shares.sum(axis=(0, 1)) + found.prior_share
    assert whole == pytest.approx(1.0)
    mass = found.names.index("mass")
    assert found.prior_share[mass] > 0.99
    scaling = found.names.index("input_scaling")
    speed = found.channels.index("rotor_speed")
    assert found.shares[speed, :, scaling].sum() > 0.5


def test_the_yaw_spin_tells_the_moment_constant(found: Uncertainty) -> None:
    by_flight = found.shares.sum(axis=0)[found.flights.index("spin")]
    moment = by_flight[found.names.index("moment_constant")]
    assert moment > 0.3
    assert moment > 5 * by_flight[found.names.index("estimate_latency")]


def test_intervals_are_in_units_and_inside_the_bounds(
    found: Uncertainty, objective: Objective
) -> None:
    for parameter in objective.space.parameters:
        estimate = found.estimates[parameter.name]
        low, high = estimate.ci95
        assert parameter.lower <= low < estimate.value < high <= parameter.upper
    latency = found.estimates["estimate_latency"]
    low, high = latency.ci95
    assert high - low == pytest.approx(2 * 1.96 * latency.std_error, rel=1e-3)
    scaling = found.estimates["input_scaling"]
    low, high = scaling.ci95
    assert high / scaling.value == pytest.approx(scaling.value / low)


def test_tied_coefficients_share_their_estimate() -> None:
    exact = making.problem(
        ("inertia_xx", "inertia_yy", "input_scaling"),
        job={"ties": (("inertia_xx", "inertia_yy"),)},
    )
    noisy = making.with_data(exact, making.truth(exact), noise=np.random.default_rng(1))
    tied = uncertainty_of(making.fitted_of(noisy, making.truth(noisy)))
    first, second = tied.estimates["inertia_xx"], tied.estimates["inertia_yy"]
    assert second.std_error / first.std_error == pytest.approx(second.value / first.value)
    assert second.verdict is Verdict.TIED
    assert second.reason == first.reason.model_copy(update={"tied_to": "inertia_xx"})
