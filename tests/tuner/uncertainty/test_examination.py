"""Sensitivities against simulations with the coefficient changed by hand."""

from __future__ import annotations

import csv
import io
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.objective.normal_equations import Objective, flight_batches
from tuner.uncertainty.estimates import flights_refute
from tuner.uncertainty.examination import Examination, examine, knowledge_of
from tuner.uncertainty.identifiability import stand_ins_of
from tuner.uncertainty.records import Knowledge
from tuner.uncertainty.sensitivity import shortest_half
from tuner.uncertainty.verdict import ReasonCode, Verdict

FREE = ("inertia_xx", "input_scaling", "motor_constant", "moment_constant", "estimate_latency")
UNIT = {"position": 1.0, "attitude": 180.0 / np.pi, "body_rate": 1.0, "rotor_speed": 1.0}


@pytest.fixture(scope="module")
def objective() -> Objective:
    return making.problem(FREE, seed=0)


@pytest.fixture(scope="module")
def examination(objective: Objective) -> Examination:
    return examine(making.fitted_of(objective, making.truth(objective)))


@pytest.fixture(scope="module")
def knowledge(objective: Objective, examination: Examination) -> Knowledge:
    return knowledge_of(examination, objective.space, making.truth(objective))


def test_flights_that_do_not_fit_the_memory_take_turns(
    objective: Objective, examination: Examination
) -> None:
    small = replace(objective, memory=1)
    fitted = making.fitted_of(small, making.truth(small))
    assert [list(p) for p, _ in flight_batches(small, fitted.point, fitted.criterion)] == [[0], [1]]
    turns = examine(fitted)
    assert turns.residuals[0].flight != turns.residuals[-1].flight
    assert [r.flight for r in turns.residuals] == [r.flight for r in examination.residuals]
    for name, value in vars(examination.information).items():
        if isinstance(value, np.ndarray):
            size = np.abs(np.nan_to_num(value)).max()
            np.testing.assert_allclose(getattr(turns.information, name), value, atol=1e-9 * size)
        else:
            assert getattr(turns.information, name) == value
    assert turns.sensitivity.steps == pytest.approx(examination.sensitivity.steps)
    in_turns, at_once = (vars(e.sensitivity) for e in (turns, examination))
    for kind in ("outputs", "effects_over_time"):
        one, other = ([leaf.model_dump() for leaf in e[kind]] for e in (in_turns, at_once))
        for here, there in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
            assert here == (there if isinstance(there, str) else pytest.approx(there, rel=1e-6))


def test_a_fit_that_is_only_compared_is_known_as_well_without_its_effects(
    objective: Objective, examination: Examination
) -> None:
    known = examine(making.fitted_of(objective, making.truth(objective)), effects=False)
    assert known.uncertainty.estimates == examination.uncertainty.estimates
    assert examination.sensitivity.outputs
    assert examination.residuals
    assert not known.sensitivity.outputs
    assert not known.residuals


@pytest.mark.parametrize(("name", "factor"), [("motor_constant", 0.3), ("inertia_xx", 0.1)])
def test_flights_that_the_fitted_vehicle_does_not_fly_say_nothing(
    objective: Objective, name: str, factor: float
) -> None:
    """With so little of its thrust it falls; with so little inertia it tumbles on the second."""
    space = objective.space
    values = space.numbers(space.initial)
    point = objective.start(space.vector_of({**values, name: factor * values[name]}))
    known = examine(making.fitted_of(objective, point)).uncertainty
    assert {known.estimates[one].verdict for one in FREE} == {Verdict.NOT_IDENTIFIABLE}
    assert {known.estimates[one].reason.code for one in FREE} == {ReasonCode.REFUTED}
    assert np.all(known.covariance.error >= space.prior_sd)
    assert not stand_ins_of(known)
    (said,) = flights_refute(known)
    assert said.level == "failure"
    looked_at = examine(making.fitted_of(objective, point), at_minimum=False).uncertainty
    assert not any(looked_at.estimates[one].parts.astray for one in FREE)
    assert not list(flights_refute(looked_at))


def test_flights_that_agree_on_another_vehicle_do_not_disagree(
    objective: Objective, examination: Examination
) -> None:
    """Where nothing was fitted, each flight wants the same step, which tells of no scatter."""
    values = objective.space.numbers(making.truth(objective).coefficients)
    known = examination.uncertainty.estimates["motor_constant"]
    values["motor_constant"] += 10.0 * known.std_error
    off = objective.start(objective.space.vector_of(values))
    looked_at = examine(making.fitted_of(objective, off), at_minimum=False).uncertainty
    for name, estimate in looked_at.estimates.items():
        there = examination.uncertainty.estimates[name]
        assert estimate.parts.residuals == pytest.approx(there.parts.residuals, rel=0.3)
        assert not estimate.parts.search


@pytest.mark.parametrize(
    ("diverged", "crashed", "refuted"),
    [
        ([True, False, False], [True, False, False], True),
        ([True, False, False], [False, False, True], False),
        ([True, True, False], [False, False, False], True),
    ],
)
def test_a_crash_or_most_flights_refute_a_fit(
    objective: Objective, diverged: list[bool], crashed: list[bool], refuted: bool
) -> None:
    information = examine(making.fitted_of(objective, making.truth(objective))).information
    seen = replace(information, diverged=np.array(diverged), crashed=np.array(crashed))
    assert seen.refuted is refuted


def test_flights_that_are_disturbed_as_much_as_they_move_still_tell(objective: Objective) -> None:
    random, shaken = np.random.default_rng(0), {}
    for channel, old in objective.segments.measured.items():
        values = np.asarray(old.values)
        if channel != "attitude":
            values = values + random.permutation(values - values.mean(axis=0))
        shaken[channel] = replace(old, values=values)
    segments = replace(objective.segments, measured=shaken)
    disturbed = replace(objective, segments=segments)
    information = examine(making.fitted_of(disturbed, making.truth(disturbed))).information
    assert information.diverged is not None
    assert not information.diverged.any()


def flown(objective: Objective, name: str, factor: float) -> dict[str, np.ndarray]:
    """Return channel -> (n, k, F) residuals in its unit with one coefficient changed."""
    space = objective.space
    values = {n: float(v) for n, v in space.numbers(space.initial).items()}
    values[name] *= factor
    point = objective.start(space.vector_of(values))
    jacobian = objective.jacobian(point, making.criterion_of(objective))
    return {c: np.asarray(r) * making.NOISE[c] * UNIT[c] for c, r in jacobian.residuals.items()}


@pytest.mark.parametrize("name", ["inertia_xx", "moment_constant"])
def test_the_change_for_one_percent_is_the_simulations_own(
    objective: Objective, knowledge: Knowledge, name: str
) -> None:
    up, down = flown(objective, name, 1.0005), flown(objective, name, 0.9995)
    for output in knowledge.outputs:
        segment = making.FLIGHTS.index(output.flight)
        axis = "1234".find(output.axis) if output.channel == "rotor_speed" else None
        row = ["x", "y", "z"].index(output.axis) if output.axis in "xyz" else axis
        if row is None:
            row = ["roll", "pitch", "yaw"].index(output.axis)
        change = (up[output.channel] - down[output.channel])[:, row, segment] * 10.0
        expected = np.sqrt(np.mean(change**2))
        tiny = 1e-6 * making.NOISE[output.channel] * UNIT[output.channel]
        assert output.change[name] == pytest.approx(expected, rel=1e-3, abs=tiny)


def test_rmse_for_ten_percent_is_the_simulations_own(
    objective: Objective, knowledge: Knowledge
) -> None:
    up = flown(objective, "motor_constant", 1.1)
    for output in knowledge.outputs:
        if output.channel == "position":
            segment, row = making.FLIGHTS.index(output.flight), "xyz".index(output.axis)
            expected = np.sqrt(np.mean(up["position"][:, row, segment] ** 2))
            assert output.rmse_up["motor_constant"] == pytest.approx(expected, rel=1e-3)
            assert output.rmse < expected or output.flight == "spin"


def test_fixed_coefficients_are_examined_as_if_they_were_free(knowledge: Knowledge) -> None:
    mass = knowledge.coefficients["mass"]
    assert not mass.fitted
    assert mass.bias["motor_constant"] > 0.2
    assert set(knowledge.coefficients) > set(FREE)


def test_an_increase_of_the_fixed_one_moves_the_fitted_as_a_refit_would(
    objective: Objective, examination: Examination
) -> None:
    information = examination.information
    count = len(objective.space)
    place = count + list(examination.of_fixed).index("mass")
    step = -np.linalg.solve(information.total[:count, :count], information.data[:count, place])
    names = list(objective.space.names)
    row = examination.bias[list(examination.of_fixed).index("mass")]
    motor = names.index("motor_constant")
    assert row[motor] == pytest.approx(step[motor])


def test_white_residuals_are_called_white(examination: Examination) -> None:
    assert len(examination.residuals) == 8
    assert sum(residual.white for residual in examination.residuals) >= 7
    for residual in examination.residuals:
        assert residual.rms == pytest.approx(1.0, abs=0.15)


def test_residuals_of_a_wrong_model_are_not_white(objective: Objective) -> None:
    wrong = objective.start(objective.space.initial + 0.1)
    coloured = examine(making.fitted_of(objective, wrong)).residuals
    assert not any(residual.white for residual in coloured if residual.channel == "position")


def test_half_of_an_effect_is_where_it_is() -> None:
    effect = np.zeros(40)
    effect[20:24] = 1.0
    assert shortest_half(np.arange(40) + 0.5, effect) == (20.0, 22.0)
    assert shortest_half(np.arange(40) + 0.5, np.zeros(40)) == (0.0, 40.0)


def test_files_hold_the_knowledge(knowledge: Knowledge, tmp_path: Path) -> None:
    knowledge.write(tmp_path)
    assert Knowledge.read(tmp_path) == knowledge
    rows = list(csv.DictReader(io.StringIO((tmp_path / "sensitivity.csv").read_text())))
    assert {row["coefficient"] for row in rows} == set(knowledge.coefficients)
    assert len(rows) == len(knowledge.coefficients) * 26
    assert {row["unit"] for row in rows if row["channel"] == "attitude"} == {"deg"}
    lines = (tmp_path / "covariance.csv").read_text().splitlines()
    assert lines[0] == "coefficient," + ",".join(FREE)
    matrix = np.array([[float(v) for v in line.split(",")[1:]] for line in lines[1:]])
    errors = [knowledge.coefficients[name].std_error for name in FREE]
    assert np.sqrt(np.diag(matrix)) == pytest.approx(errors)
    shares = list(csv.DictReader(io.StringIO((tmp_path / "information_shares.csv").read_text())))
    for name in knowledge.coefficients:
        total_share = sum(float(row["share"]) for row in shares if row["coefficient"] == name)
        assert total_share == pytest.approx(1.0)
