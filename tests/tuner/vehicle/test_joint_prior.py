"""Ground measurements as a prior with covariance: in the search's equations, and beside flights."""

from types import SimpleNamespace

import numpy as np
import pytest

from tuner.config import JobFile, resolve_settings
from tuner.core.errors import ConfigError, InputError
from tuner.core.shipped import configs_folder, find_config
from tuner.findings.findings import Code
from tuner.ground.measurement import BenchRecord, joint_prior
from tuner.objective.criterion import Criterion, Point, SegmentSums
from tuner.objective.normal_equations import normal_equations
from tuner.objective.space import space_of
from tuner.options import Options
from tuner.uncertainty.agreement import ground_conflicts, sources_of
from tuner.vehicle import ControllerFile, read_vehicle
from tuner.vehicle.joint_prior import JointPrior

FREE = ("motor_constant", "moment_constant", "actuator_latency")
COVARIANCE = np.array([[1e-4, -1e-4, 0.0], [-1e-4, 4e-4, 0.0], [0.0, 0.0, 1e-6]])
MEAN = np.array([np.log(1.4e-5), np.log(0.03), 0.004])
PRIOR = JointPrior(FREE, MEAN, np.linalg.inv(COVARIANCE))


def vehicle(**changes):
    file = read_vehicle(find_config("vehicles", "hovergames_updated", configs_folder()))
    return file.replace(**changes)


def space(free=FREE, prior=PRIOR, **job):
    return space_of(vehicle(), ControllerFile(), JobFile(free=free, **job), prior)


def loss_of(prior, scaled):
    off = np.asarray(scaled) - prior.mean
    return 0.5 * off @ prior.information @ off


def test_the_residuals_have_the_prior_s_loss():
    fit = space()
    scaled = np.array([np.log(1.45e-5), np.log(0.031), 0.006])
    residual = fit.joint_rows @ scaled + fit.joint_offset
    assert 0.5 * residual @ residual == pytest.approx(loss_of(PRIOR, scaled))


def test_a_fixed_coefficient_conditions_the_others():
    fit = space(free=("moment_constant", "actuator_latency"))
    scaled = np.array([np.log(0.031), 0.006])
    whole = np.array([np.log(vehicle().aerodynamics.motor_constant), *scaled])
    residual = fit.joint_rows @ scaled + fit.joint_offset
    assert 0.5 * residual @ residual == pytest.approx(loss_of(PRIOR, whole))


def test_a_combination_that_was_not_measured_stays_open():
    along = np.array([1.0, 1.0, 0.0])  # a torque stand alone
    prior = JointPrior(FREE, MEAN, np.outer(along, along) / 0.01**2 + np.diag([0, 0, 1e6]))
    fit = space(prior=prior)
    scaled = MEAN + np.array([0.3, -0.3, 0.0])
    residual = fit.joint_rows @ scaled + fit.joint_offset
    assert residual @ residual == pytest.approx(0.0, abs=1e-6)


def test_another_scale_is_refused():
    settings = {"motor_constant": {"scale": "linear", "lower": 1e-6, "upper": 1e-4}}
    with pytest.raises(ConfigError, match="in another scale"):
        space(coefficients=settings)


def equations(fit, vector):
    """Return loss, gradient and Hessian where the flights say nothing."""
    count, offsets = len(fit), 5
    sums = SegmentSums(
        loss=np.zeros(1),
        gradient=np.zeros((count + offsets, 1)),
        hessian=np.zeros((count + offsets, count + offsets, 1)),
        squares={"position": np.zeros(1)},
        counts={"position": np.ones(1)},
        crash_time=np.full(1, np.inf),
        states=None,
    )
    criterion = Criterion(
        horizon=1,
        scale={"position": np.ones(1)},
        reference_offset=np.zeros((2, 1)),
    )
    point = Point(vector, np.zeros((offsets, 1)))
    return normal_equations(
        SimpleNamespace(space=fit, flight=np.zeros(1, int)), point, criterion, sums
    )


def test_the_search_s_gradient_is_that_of_its_loss():
    fit = space()
    vector = fit.initial + 0.1
    loss, gradient, hessian = equations(fit, vector)
    weak, _, weak_hessian = equations(space(prior=None), vector)
    scaled = np.asarray(fit.scaled(vector))
    assert float(loss - weak) == pytest.approx(loss_of(PRIOR, scaled))
    steps = 1e-5 * np.eye(len(fit))
    slope = [(equations(fit, vector + s)[0] - equations(fit, vector - s)[0]) / 2e-5 for s in steps]
    np.testing.assert_allclose(gradient[: len(fit)], slope, rtol=1e-7)
    turn = fit.slope(vector)
    expected = PRIOR.information * np.outer(turn, turn)
    added = (hessian - weak_hessian)[: len(fit), : len(fit)]
    np.testing.assert_allclose(added, expected, rtol=1e-8, atol=1e-8)


def side_by_side(flights_mean, flights_information):
    """Return the sources of a fit whose flights have a quadratic loss."""
    fit = space()
    total = flights_information + PRIOR.information
    pull = flights_information @ flights_mean + PRIOR.information @ MEAN
    end = np.linalg.solve(total, pull)
    values = {name: fit.parameters[i].value_at(end[i]) for i, name in enumerate(FREE)}
    vector = fit.vector_of(values)
    error = np.sqrt(np.diag(np.linalg.inv(total)))
    uncertainty = SimpleNamespace(
        covariance=SimpleNamespace(beyond_noise=np.ones(3)),
        estimates={
            name: SimpleNamespace(value=values[name], std_error=error[i])
            for i, name in enumerate(FREE)
        },
    )
    fitted = SimpleNamespace(
        objective=SimpleNamespace(space=fit), point=SimpleNamespace(coefficients=vector), held={}
    )
    return sources_of(fitted, uncertainty, total)


def test_flights_alone_are_what_they_would_have_given():
    flights = MEAN + np.array([0.01, -0.02, 0.001])
    spread = np.diag([0.01, 0.03, 0.001])
    sources = side_by_side(flights, np.linalg.inv(spread @ spread))
    motor = sources["motor_constant"]
    assert motor.flights == pytest.approx(np.exp(flights[0]))
    assert motor.flights_error == pytest.approx(0.01 * motor.flights)
    assert motor.ground == pytest.approx(1.4e-5)
    assert motor.ground_error == pytest.approx(0.01 * 1.4e-5)
    assert motor.deviation == pytest.approx(0.01 / np.hypot(0.01, 0.01))
    assert not list(ground_conflicts(sources, 2.0))


def test_a_contradiction_is_a_finding():
    flights = MEAN + np.array([0.1, 0.0, 0.0])
    spread = np.diag([0.01, 0.03, 0.001])
    sources = side_by_side(flights, np.linalg.inv(spread @ spread))
    (finding,) = ground_conflicts(sources, 2.0)
    assert (finding.code, finding.subject) == (Code.GROUND_CONFLICT, "motor_constant")
    assert finding.numbers["mass"] == pytest.approx(2.0 * np.exp(-0.1))  # they go with it
    (free,) = ground_conflicts(sources, None)
    assert "mass" not in free.numbers
    assert finding.numbers["deviation"] == pytest.approx(0.1 / np.hypot(0.01, 0.01))


def record(**changes):
    content = {
        "names": list(FREE),
        "scaled": MEAN.tolist(),
        "information": PRIOR.information.tolist(),
        "covariance": COVARIANCE.tolist(),
        "chi_square": 0.0,
        "degrees_of_freedom": 0,
        "p_value": 1.0,
        "conflicts": [],
        "experiments": [],
    }
    return BenchRecord.model_validate(content | changes)


def test_a_folder_of_ground_measurements_is_a_prior(tmp_path):
    record().write(tmp_path)
    prior = joint_prior(tmp_path)
    assert prior.names == FREE
    np.testing.assert_array_equal(prior.information, PRIOR.information)


@pytest.mark.parametrize("changes", [{"names": ["a", "b", "c"]}, {"scaled": [1.0]}, {"names": []}])
def test_an_edited_folder_is_refused(tmp_path, changes):
    record(**changes).write(tmp_path)
    with pytest.raises(InputError, match="was edited"):
        joint_prior(tmp_path)


def test_another_folder_is_refused(tmp_path):
    (tmp_path / "a.csv").write_text("time,x\n0,0\n")
    options = Options([str(tmp_path / "a.csv")], bench=str(tmp_path), vehicle="hovergames")
    with pytest.raises(InputError, match="the result folder of tune bench"):
        resolve_settings(options)
