"""Uncertainty of simulated fits with a known answer."""

from __future__ import annotations

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.findings.findings import Code, sentence
from tuner.objective.criterion import Point
from tuner.objective.information import information_at
from tuner.objective.normal_equations import Objective, normal_equations
from tuner.uncertainty.estimates import (
    Uncertainty,
    _lags,
    term_findings,
    uncertainty_of,
    unrefuted,
)
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
OFFSETS_FITTED = np.array(
    [[True, False], [True, True], [True, True], [False, False], [True, False]]
)


@pytest.fixture(scope="module")
def objective() -> Objective:
    return making.problem(FREE, seed=0)


@pytest.fixture(scope="module")
def uncertainty(objective: Objective) -> Uncertainty:
    fitted = making.fitted_of(objective, making.truth(objective))
    return uncertainty_of(fitted, offsets_fitted=OFFSETS_FITTED)


def test_information_is_the_searchs_with_clock_offsets_eliminated(
    objective: Objective,
) -> None:
    offsets = np.random.default_rng(1).normal(0.0, 0.1, OFFSETS_FITTED.shape)
    point = Point(making.truth(objective).coefficients + 0.01, jnp.asarray(offsets))
    criterion = making.criterion_of(objective)
    sums = objective.sums(point, criterion, derivatives=True)
    _, _, hessian = normal_equations(objective, point, criterion, sums)
    compared = sum(float(n.sum()) for n in sums.counts.values())
    count = len(objective.space)
    kept = np.concatenate([np.arange(count), count + np.flatnonzero(OFFSETS_FITTED)])
    covariance = np.linalg.inv(np.asarray(hessian)[np.ix_(kept, kept)] * compared)[:count, :count]
    slope = objective.space.slope(np.asarray(point.coefficients))
    information = information_at(objective, point, criterion, offsets_fitted=OFFSETS_FITTED)
    inverse = np.linalg.inv(information.total)
    assert inverse == pytest.approx(covariance * np.outer(slope, slope), rel=1e-5)


def test_residuals_at_the_truth_are_as_large_as_the_noise(objective: Objective) -> None:
    information = information_at(objective, making.truth(objective), making.criterion_of(objective))
    assert information.spread == pytest.approx(1.0, abs=0.15)
    assert not information.crashed.any()


def test_a_freed_mass_is_not_identifiable_and_the_direction_is_named(
    uncertainty: Uncertainty,
) -> None:
    worst = uncertainty.directions[0]
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
    assert uncertainty.estimates["mass"].verdict is Verdict.NOT_IDENTIFIABLE
    assert uncertainty.estimates["mass"].reason.direction == worst
    assert not uncertainty.estimates["motor_constant"].identifiable


def test_ratios_stay_known_beside_a_freed_mass(uncertainty: Uncertainty) -> None:
    assert uncertainty.estimates["moment_constant"].verdict is Verdict.WELL_KNOWN
    assert uncertainty.estimates["input_scaling"].verdict is Verdict.WELL_KNOWN


def test_shares_are_not_negative_and_add_up(uncertainty: Uncertainty) -> None:
    assert uncertainty.shares.min() > -1e-6
    total_share = uncertainty.shares.sum(axis=(0, 1)) + uncertainty.prior_share
    assert total_share == pytest.approx(1.0)
    mass = uncertainty.names.index("mass")
    assert uncertainty.prior_share[mass] > 0.99
    scaling = uncertainty.names.index("input_scaling")
    speed = uncertainty.channels.index("rotor_speed")
    assert uncertainty.shares[speed, :, scaling].sum() > 0.5


def test_the_yaw_spin_identifies_the_moment_constant(uncertainty: Uncertainty) -> None:
    by_flight = uncertainty.shares.sum(axis=0)[uncertainty.flights.index("spin")]
    moment = by_flight[uncertainty.names.index("moment_constant")]
    assert moment > 0.3
    assert moment > 5 * by_flight[uncertainty.names.index("estimate_latency")]


def test_intervals_are_in_units_and_inside_the_bounds(
    uncertainty: Uncertainty, objective: Objective
) -> None:
    for parameter in objective.space.parameters:
        estimate = uncertainty.estimates[parameter.name]
        low, high = estimate.ci95
        assert parameter.lower <= low < estimate.value < high <= parameter.upper
    latency = uncertainty.estimates["estimate_latency"]
    low, high = latency.ci95
    assert high - low == pytest.approx(2 * 1.96 * latency.std_error, rel=1e-3)
    scaling = uncertainty.estimates["input_scaling"]
    low, high = scaling.ci95
    assert high / scaling.value == pytest.approx(scaling.value / low)


def test_tied_coefficients_share_their_estimate() -> None:
    noisy = making.problem(
        (
            "inertia_xx",
            "inertia_yy",
            "inertia_zz",
            "input_scaling",
            "motor_constant",
            "moment_constant",
        ),
        job={"ties": (("inertia_xx", "inertia_yy"),)},
        seed=1,
    )
    tied = uncertainty_of(making.fitted_of(noisy, making.truth(noisy)))
    first, second = tied.estimates["inertia_xx"], tied.estimates["inertia_yy"]
    assert second.std_error / first.std_error == pytest.approx(second.value / first.value)
    assert second.verdict is Verdict.TIED
    assert second.reason == first.reason.model_copy(update={"tied_to": "inertia_xx"})


def test_rotor_time_constants_and_command_delays_are_lags_and_the_estimates_latency_is_none() -> (
    None
):
    fit = making.problem(("inertia_xx", "time_constant_up", "estimate_latency", "actuator_latency"))
    moved = fit.space.numbers(fit.space.initial)
    lags = _lags(fit.space, np.asarray(fit.space.scaled(jnp.asarray(fit.space.initial))))
    by_name = dict(zip(fit.space.names, lags, strict=True))
    assert by_name["time_constant_up"] == pytest.approx(1.0 / float(moved["time_constant_up"]))
    assert by_name["actuator_latency"] == 1.0
    assert by_name["estimate_latency"] == by_name["inertia_xx"] == 0.0


def test_a_term_that_another_may_replace_is_said_with_it_though_its_interval_holds_neutral():
    wide = SimpleNamespace(value=1.1, std_error=0.06, ci95=(0.98, 1.22), identifiable=True)
    fitted, known = (
        SimpleNamespace(held={}),
        SimpleNamespace(estimates={"gyro_cutoff_factor": wide}),
    )
    assert not list(term_findings(fitted, known))
    other = {"gyro_filter": {"derivative_cutoff_factor": 1.5}}
    (found,) = term_findings(fitted, known, other)
    assert (found.subject, found.names) == ("gyro_filter", ("gyro_cutoff_factor",))
    assert found.numbers["derivative_cutoff_factor"] == 1.5
    assert "Or it does not, and derivative_cutoff_factor = 1.5:" in sentence(found)


@pytest.mark.parametrize(("lag", "said"), [(1e-5, False), (-0.8e-3, False), (2e-3, True)])
def test_tachometers_that_hardly_lag_are_not_warned_of(lag, said):
    """Stamps of a table without noise had warned of 0.01 ms, which another term might replace."""
    ends = (lag - 1e-5, lag + 1e-5)
    known = SimpleNamespace(value=lag, std_error=7e-6, ci95=ends, identifiable=True)
    uncertainty = SimpleNamespace(estimates={"tachometer_lag": known})
    other = {"tachometer_lag": {"time_constant_second": 1e-3}}
    found = [one.subject for one in term_findings(SimpleNamespace(held={}), uncertainty, other)]
    assert found == ["tachometer_lag"] * said


def test_terms_that_flights_do_not_identify_have_no_number_in_findings():
    """Its error may be any: 2e9 was."""
    known = SimpleNamespace(value=1.02, std_error=0.001, ci95=(1.018, 1.022), identifiable=True)
    unknown = SimpleNamespace(value=1.3, std_error=2e9, ci95=(1.1, 2.0), identifiable=False)
    estimates = {"gyro_scale_x": known, "gyro_scale_y": known, "gyro_scale_z": unknown}
    fitted = SimpleNamespace(held={"gyro_scale_y": "gyro_scale_y"})
    (found,) = term_findings(fitted, SimpleNamespace(estimates=estimates))
    assert found.names == ("gyro_scale_x",)
    assert found.numbers == {"gyro_scale_x": 1.02, "gyro_scale_x_error": 0.001}
    assert not list(term_findings(fitted, SimpleNamespace(estimates={"gyro_scale_z": unknown})))
    assert not list(term_findings(fitted, SimpleNamespace(estimates={"tachometer_memory": known})))


@pytest.mark.parametrize(
    ("verdict", "refuted"), [(Verdict.WELL_KNOWN, True), (Verdict.WEAKLY_KNOWN, False)]
)
def test_what_the_fit_knows_well_refutes_what_was_said_of_its_start(verdict, refuted):
    verdicts = {"inertia_xx": Verdict.WELL_KNOWN, "motor_constant": verdict}
    known = SimpleNamespace(
        estimates={name: SimpleNamespace(verdict=one) for name, one in verdicts.items()}
    )
    said = (
        Code.SINGULAR_DIRECTION.warning("coefficients", *verdicts),
        Code.NO_EFFECT.warning("motor_constant"),
    )
    other = Code.NO_EFFECT.warning("a term that was dropped")
    assert unrefuted((*said, other), known) == ((other,) if refuted else (*said, other))


@pytest.mark.parametrize(
    ("factors", "said"), [((1.17, 0.85, 1.17), True), ((1.04, 0.97, 0.95), False)]
)
def test_rotors_of_a_frame_that_the_file_has_otherwise_are_warned_of(factors, said):
    """As of a dead-cat frame that the file has square: what they gave was "usable"."""
    estimates = {
        f"rotor_thrust_scale_{number}": SimpleNamespace(
            value=value, std_error=0.007, ci95=(value - 0.014, value + 0.014), identifiable=True
        )
        for number, value in enumerate(factors, start=1)
    }
    fitted, known = SimpleNamespace(held={}), SimpleNamespace(estimates=estimates)
    found = [one for one in term_findings(fitted, known) if one.code is Code.ROTORS_UNEQUAL]
    assert [one.numbers["rotor_4"] for one in found] == [1.0 / np.prod(factors)] * said
    unsure = {
        name: SimpleNamespace(**vars(e) | {"std_error": 0.1}) for name, e in estimates.items()
    }
    assert not list(term_findings(fitted, SimpleNamespace(estimates=unsure)))
