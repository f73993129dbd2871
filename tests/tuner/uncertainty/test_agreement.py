"""Flights of two vehicles are told from flights of one, in linear models of known answers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from tuner.equation_error.rate_controller import ControllerEstimate
from tuner.findings.findings import Code, Finding
from tuner.objective.information import FisherInformation, ResidualChange
from tuner.uncertainty.agreement import flights_disagree
from tuner.uncertainty.model_error import ModelErrors

COUNT, FLIGHTS, BLOCKS, LENGTH = 3, 4, 9, 50
NAMES = ("inertia_xx", "motor_constant", "moment_constant")


def fit_of(
    seed: int, difference: float, *, memory: int = 1, shift: float = 0.0, seen: int = FLIGHTS
) -> tuple[SimpleNamespace, ...]:
    """Return a fit and its examination; b and d have another motor constant by a difference.

    Each error lasts for ``memory`` samples. The fit is a ``shift`` away from the minimum. The
    moment constant acts in the first ``seen`` flights alone.
    """
    random = np.random.default_rng(seed)
    design = random.normal(size=(FLIGHTS, BLOCKS * LENGTH, COUNT))
    design[seen:, :, 2] = 0.0
    own = np.zeros((FLIGHTS, COUNT))
    own[1::2, 1] = difference
    noise = random.normal(size=(FLIGHTS, BLOCKS * LENGTH // memory)).repeat(memory, axis=1)
    measured = np.einsum("fnp,fp->fn", design, own) + 0.1 * noise
    fit, *_ = np.linalg.lstsq(design.reshape(-1, COUNT), measured.ravel())
    fit = fit + shift
    left = (design @ fit - measured).reshape(FLIGHTS, BLOCKS, LENGTH) / 0.1
    rows = design.reshape(FLIGHTS, BLOCKS, LENGTH, COUNT) / 0.1
    information = FisherInformation(
        channels=("only",),
        flight=np.arange(FLIGHTS),
        blocks=np.einsum("fbnp,fbnq->fbpq", rows, rows)[None],
        score=np.einsum("fbnp,fbn->fbp", rows, left)[None],
        spread=np.mean(left**2, axis=(1, 2))[None],
        nuisance_prior=np.zeros((COUNT, COUNT)),
        prior=1e-9 * np.eye(COUNT),
        crashed=np.zeros(FLIGHTS, bool),
        begins=np.zeros(FLIGHTS),
        scale=np.ones((1, FLIGHTS)),
        pull=1e-9 * fit,
        nuisance_pull=np.zeros(COUNT),
    )
    uncertainty = SimpleNamespace(names=NAMES, flights=tuple("abcd"), reference=np.ones(COUNT))
    examination = SimpleNamespace(
        uncertainty=uncertainty, information=information, model_errors=None
    )
    controller = SimpleNamespace(sees_markers=0.0)
    objective = SimpleNamespace(
        model=SimpleNamespace(controller=controller), schedule=SimpleNamespace(step=0.1)
    )
    return SimpleNamespace(findings=(), held={}, objective=objective), examination


def of_names(fitted, examination, names):
    """Return a fit and its examination with coefficients of other names, none of them in logs."""
    examination.uncertainty.names = names
    fitted.objective.space = SimpleNamespace(names=names, is_log=np.zeros(COUNT, bool))
    return fitted, examination


def test_flights_of_another_vehicle_are_named_with_the_coefficient():
    (found,) = flights_disagree(*fit_of(0, 0.1))
    assert (found.subject, found.names) in (("a, c", NAMES[1:2]), ("b, d", NAMES[1:2]))
    sign = 1.0 if found.subject == "b, d" else -1.0
    assert sign * found.numbers["difference"] == pytest.approx(
        0.1, abs=4.0 * found.numbers["error"]
    )
    assert found.numbers["error"] < 0.01


def test_what_is_nearly_zero_differs_by_so_much_and_not_by_a_share():
    fitted, examination = fit_of(0, 0.1)
    (as_share,) = flights_disagree(fitted, examination)
    examination.uncertainty.reference = 1e-4 * np.ones(COUNT)
    names = (NAMES[0], "marker_tilt_z", *NAMES[2:])
    (found,) = flights_disagree(*of_names(fitted, examination, names))
    assert found.names == ("marker_tilt_z", "rad")
    assert found.numbers == pytest.approx(as_share.numbers)


@pytest.mark.parametrize(("memory", "shift"), [(1, 0.0), (10, 0.0), (1, 0.02)])
def test_flights_of_one_vehicle_agree(memory, shift):
    fits = (fit_of(seed, 0.0, memory=memory, shift=shift) for seed in range(100))
    assert not any(flights_disagree(*fit) for fit in fits)


def test_what_a_voltmeter_may_have_misread_is_no_second_value():
    """Other readings in two flights would move what these need by as much as they differ."""
    fitted, examination = fit_of(0, 0.1)
    blocks = examination.information.blocks
    across = 0.1 * blocks[..., 1] * np.array([0.0, 1.0, 0.0, 1.0])[:, None, None]
    own = np.zeros(across.shape[:-1])
    examination.information.changes["readings 0"] = ResidualChange(across, own, own)
    assert not flights_disagree(fitted, examination)


def test_a_coefficient_that_one_flight_determines_has_no_second_value():
    assert not any(flights_disagree(*fit_of(seed, 0.0, seen=1)) for seed in range(100))


def test_a_negligible_difference_is_not_reported():
    fitted, examination = fit_of(0, 0.1)
    examination.uncertainty.reference[:] = 20.0
    assert not flights_disagree(fitted, examination)


@pytest.mark.parametrize(("step", "reported"), [(0.25, False), (0.15, True)])
def test_latencies_that_differ_by_less_than_half_a_step_agree(step, reported):
    fitted, examination = of_names(*fit_of(0, 0.1), ("inertia_xx", "estimate_latency", NAMES[2]))
    fitted.objective.schedule.step = step
    assert [found.names[0] for found in flights_disagree(fitted, examination)] == (
        ["estimate_latency"] if reported else []
    )


def test_held_coefficients_and_reported_flights_are_left_out():
    fitted, examination = fit_of(0, 0.1)
    fitted.held["motor_constant"] = "motor_constant"
    assert not flights_disagree(fitted, examination)
    fitted, examination = fit_of(0, 0.1)
    fitted.findings = (Finding(Code.FLIGHT_UNMATCHED, "warning", "a", {"position": 20.0}),)
    assert not flights_disagree(fitted, examination)
    fitted.findings = ()
    gain = ControllerEstimate("roll", "P", 0.6, 0.01, differs=True, flight="a")
    examination.model_errors = ModelErrors((), None, (gain,))
    assert not flights_disagree(fitted, examination)


@pytest.mark.parametrize(
    ("name", "said"), [("motor_constant", True), ("marker_offset_z", False)], ids=["seen", "hidden"]
)
def test_gusts_are_no_second_value_of_what_set_points_hide(name, said):
    fitted, examination = fit_of(0, 0.1)
    fitted, examination = of_names(fitted, examination, ("inertia_xx", name, "moment_constant"))
    assert flights_disagree(fitted, examination)
    fitted.findings = (Finding(Code.DISTURBANCES_FOLLOWED, "info", "flights", {}),)
    assert bool(flights_disagree(fitted, examination)) is said
