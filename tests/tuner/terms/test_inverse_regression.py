"""Errors in measured rotor speeds do not pass for inertia: a fit to noisy speeds, and the truth."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from tests.tuner.job.test_windows import fitted_through, job_through
from tuner.findings.findings import Code
from tuner.objective.criterion import Point
from tuner.recordings.flight import Series
from tuner.terms import inverse_regression as balanced
from tuner.terms.inverse_regression import balance_of, with_inputs_balanced
from tuner.uncertainty.examination import examine
from tuner.vehicle import values_of

NOISE, DRIFT = 2.0, 1.0
"""rad/s."""
FREE = ("inertia_xx", "inertia_yy", "motor_constant", "moment_constant", "inertia_zz")


@pytest.fixture(scope="module")
def noisy(full_flight):
    """Return a flight whose rotor speeds were measured with smoothed noise and with drift."""
    speed = full_flight.series["rotor_speed"]
    generator = np.random.default_rng(2)
    rate = 1.0 / np.median(np.diff(speed.time))
    noise = gaussian_filter1d(generator.normal(size=speed.values.shape), 0.01 * rate, axis=0)
    drift = np.cumsum(generator.normal(size=speed.values.shape), axis=0)
    drift = (drift - drift.mean(axis=0)) / drift.std()
    measured = speed.values + NOISE * noise / noise.std() + DRIFT * drift
    return replace(
        full_flight,
        series=dict(full_flight.series) | {"rotor_speed": Series(speed.time, measured)},
    )


@pytest.fixture(scope="module")
def job(noisy, full_bag, updated):
    return job_through("rotor_speed", noisy, full_bag, updated, free=FREE)


@pytest.fixture(scope="module")
def fitted(job, tmp_path_factory):
    return fitted_through(job, tmp_path_factory.mktemp("balanced"))


def shares(job, fitted, updated):
    truth, values = values_of(updated), job.space.numbers(fitted.point.coefficients)
    return {name: values[name] / truth[name] for name in FREE}


def test_noise_passes_for_inertia_and_the_balance_takes_it_out(job, fitted, updated):
    searched = shares(job, fitted, updated)
    messages = []
    settled, examination, findings = with_inputs_balanced(
        job, fitted, examine(fitted), messages.append
    )
    found = shares(job, settled, updated)
    assert searched["inertia_xx"] > 1.3
    assert found["inertia_xx"] == pytest.approx(1.0, abs=0.1)
    assert found["inertia_yy"] == pytest.approx(1.0, abs=0.15)
    assert found["motor_constant"] == pytest.approx(1.0, abs=0.01)
    yaw = found["moment_constant"] / found["inertia_zz"]
    assert yaw == pytest.approx(1.0, abs=0.05)
    assert messages == ["Balancing the recorded motion and the rotor speeds."]
    (finding,) = findings
    assert finding.code is Code.INERTIA_BALANCED
    assert "inertia_xx" in finding.names
    assert finding.numbers["inertia_xx_balanced"] < finding.numbers["inertia_xx_fitted"]
    assert settled.loss_best > fitted.loss_best  # least squares meets the noisy flights better
    np.testing.assert_array_equal(
        np.asarray(examination.full_problem.point.coefficients)[: len(FREE)],
        settled.point.coefficients,
    )


def test_a_balance_that_predicts_badly_is_said_and_not_taken(job, fitted, monkeypatch):
    monkeypatch.setattr(balanced, "TOLERATED", -0.9)
    examination = examine(fitted)
    kept, wider, (finding,) = with_inputs_balanced(job, fitted, examination, lambda _: None)
    assert kept is fitted
    before, after = (e.uncertainty.estimates["inertia_xx"] for e in (examination, wider))
    assert after.std_error > before.std_error
    assert after.ci95[0] < finding.numbers["inertia_xx_balanced"] < after.value
    assert finding.code is Code.INERTIA_NOT_BALANCED
    assert finding.level == "warning"


def test_true_speeds_balance_at_the_truth(full_flight, full_bag, updated):
    job = job_through("rotor_speed", full_flight, full_bag, updated, free=FREE)
    objective = job.objective
    vector = job.space.vector_of(values_of(updated))
    point = Point(jnp.asarray(vector), objective.start(vector).offsets)
    balance = balance_of(objective, point, job.fitted)
    model, space = objective.model, objective.space
    lacking = np.asarray(balance.residuals(model, space, vector))
    wrong = np.asarray(balance.residuals(model, space, job.space.initial))
    assert lacking.shape[0] == 6
    assert lacking.shape[-1] == objective.segments.count
    assert (np.abs(lacking).mean(axis=(1, 2)) < 0.2 * np.abs(wrong).mean(axis=(1, 2)))[2:].all()
    columns = np.asarray(balance.jacobian(model, space, vector))
    for number in range(len(FREE)):
        step = 1e-5 * np.eye(len(FREE))[number]
        slope = (
            np.asarray(balance.residuals(model, space, vector + step))
            - np.asarray(balance.residuals(model, space, vector - step))
        ) / 2e-5
        np.testing.assert_allclose(columns[..., number], slope, rtol=1e-5, atol=1e-3)


def test_commands_are_not_balanced(full_flight, full_bag, updated, fitted):
    job = job_through("actuator", full_flight, full_bag, updated, free=FREE)
    assert with_inputs_balanced(job, fitted, None, lambda _: None) == (fitted, None, ())
