"""Whether a fit can be used: the held-out flights and what was noticed decide."""

import math
from pathlib import Path

import pytest

from tests.tuner.exporters.conftest import make_run  # noqa: F401 (a fixture)
from tuner.evaluate.records import AxesRmse
from tuner.findings.findings import Code, Finding, remedy
from tuner.findings.sentences import CONTROLLER_FILE
from tuner.report.outcome import (
    Usability,
    flights_table,
    next_step,
    outcome,
    sort_by_weight,
    verdict_counts,
    warnings_of,
)
from tuner.result import ExportRecord
from tuner.uncertainty.verdict import Verdict
from tuner.vehicle import COEFFICIENTS

CRASHED = AxesRmse(x=None, y=None, z=None, roll=None, pitch=None, yaw=None)


def rmse(metres):
    return AxesRmse(x=metres, y=metres, z=metres, roll=metres, pitch=metres, yaw=metres)


@pytest.fixture
def result(make_run):  # noqa: F811
    """A fit whose held-out flight is met to a millimetre, which is the noise."""
    run = make_run()
    fitted = run.result.flights[0].model_copy(
        update={"split": "fit", "rmse_initial": rmse(0.1), "rmse_best": rmse(0.001)}
    )
    held = fitted.model_copy(update={"name": "checks", "split": "holdout"})
    noise = {"position": 0.001, "attitude": 0.001}
    update = {"flights": (fitted, held), "settings": {"noise": noise}, "findings": ()}
    return run.result.model_copy(update=update)


def with_held(result, **update):
    fitted, held = result.flights
    return result.model_copy(update={"flights": (fitted, held.model_copy(update=update))})


def noticing(result, *findings):
    return result.model_copy(update={"findings": findings})


def test_a_held_out_flight_met_to_its_noise_makes_a_fit_usable(result):
    found = outcome(result)
    assert found.usability is Usability.USABLE
    assert found.flights[0].name == "checks"
    (met,) = found.checks
    assert met.word == "matched"
    assert met.position[2] == pytest.approx(math.sqrt(3) * 0.001)
    assert met.attitude[2] == pytest.approx(math.degrees(math.sqrt(3) * 0.001))
    assert "position error from 17 cm to 1.7 mm" in found.reasons[0]


def test_that_flights_are_simulated_is_said_where_the_job_file_says_so(result):
    assert "simulated" not in outcome(result).what
    settings = result.settings | {"job": {"simulated": True}}
    said = outcome(result.model_copy(update={"settings": settings})).what
    assert " simulated flight" in said


def test_what_goes_with_the_arms_is_said_to(result):
    row = next(iter(result.coefficients.values())).model_copy(
        update={"fitted": True, "identifiable": True, "verdict": Verdict.WELL_KNOWN}
    )

    def last_use(*names):
        coefficients = dict.fromkeys(names, row)
        return outcome(result.model_copy(update={"coefficients": coefficients})).uses[-1]

    arms = "the vehicle file's arms, which no flight shows: measure them."
    both = ("inertia_xx", "moment_constant", "motor_constant")
    assert last_use(*both) == f"inertia_xx and moment_constant go with {arms}"
    assert last_use("inertia_zz") == f"inertia_zz goes with {arms}"
    assert "arms" not in last_use("motor_constant")


def test_what_goes_with_the_mass_is_said_to_unless_it_is_fitted(result):
    mass = result.coefficients["mass"].model_copy(update={"fitted": False})
    known = {
        name: mass.model_copy(
            update={"fitted": True, "identifiable": True, "verdict": Verdict.WELL_KNOWN}
        )
        for name in ("motor_constant", "time_constant_up")
    }

    def last_use(**others):
        coefficients = {**others, **known}
        return outcome(result.model_copy(update={"coefficients": coefficients})).uses[-1]

    weighed = f"the mass, {mass.best:.4g} kg, which no flight shows: weigh it."
    assert last_use(mass=mass) == f"motor_constant goes with {weighed}"
    assert "the mass" not in last_use(mass=mass.model_copy(update={"fitted": True}))
    assert "the mass" not in last_use()


@pytest.mark.parametrize(
    ("after", "word", "standing"),
    [
        (rmse(0.02), "better", Usability.USABLE),
        (rmse(0.09), "unchanged", Usability.WITH_CARE),
        (CRASHED, "crashes", Usability.UNUSABLE),
    ],
)
def test_what_becomes_of_the_held_out_flight_decides(result, after, word, standing):
    found = outcome(with_held(result, rmse_best=after))
    assert (found.checks[0].word, found.usability) == (word, standing)


def test_a_held_out_flight_that_is_met_worse_forbids_it(result):
    numbers, names = {"before": 0.1, "after": 0.2}, ("position", "m")
    worse = Finding(Code.FLIGHT_WORSE, "warning", "checks", numbers, names)
    found = outcome(noticing(result, worse))
    assert (found.checks[0].word, found.usability) == ("worse", Usability.UNUSABLE)
    assert found.uses == ("Do not use these numbers: see the warnings for what to do first.",)


def test_another_vehicle_that_predicts_worse_than_holding_is_not_usable(result):
    """As with a mass in grams: nothing of the flown vehicle was found from there."""
    lift = {"lift": 0.3, "weight": 264.9, "mass": 27.0}
    other = Finding(Code.WRONG_VEHICLE, "warning", "quad", lift)
    assert outcome(noticing(result, other)).usability is Usability.WITH_CARE
    ahead = {"soonest": 0.1, "seconds": 0.5, "position": 0.89, "position_held": 0.49}
    worse = Finding(Code.HOLDING_BETTER, "warning", "circle", ahead, ("position",))
    assert outcome(noticing(result, worse)).usability is Usability.WITH_CARE
    assert outcome(noticing(result, other, worse)).usability is Usability.UNUSABLE


def test_a_vehicle_not_given_whose_rate_is_predicted_worse_than_before_is_not_usable(result):
    default = Finding(Code.VEHICLE_NOT_GIVEN, "warning", "hovergames", {"mass": 2.079})
    ahead = {"before": 3.6, "after": 5.9, "hold": 3.7, "seconds": 0.4}
    worse = Finding(Code.RATE_WORSE, "warning", "log15", ahead)
    for alone in (default, worse):
        assert outcome(noticing(result, alone)).usability is not Usability.UNUSABLE
    assert outcome(noticing(result, default, worse)).usability is Usability.UNUSABLE


def test_a_fit_that_leaves_a_vehicle_that_was_not_given_is_not_usable(result):
    """As of 27 g that fly with the default 2 kg: no flight shows the mass, inertia over mass is."""
    default = Finding(Code.VEHICLE_NOT_GIVEN, "warning", "hovergames", {"mass": 2.079})

    def ended(share):
        row = result.coefficients["inertia_xx"]
        moved = row.model_copy(update={"fitted": True, "best": share * row.initial})
        return result.model_copy(
            update={"coefficients": {**result.coefficients, "inertia_xx": moved}}
        )

    for factor in (1 / 7, 7.0):
        assert outcome(ended(factor)).usability is Usability.USABLE
        found = outcome(noticing(ended(factor), default))
        assert found.usability is Usability.UNUSABLE
        assert found.reasons[-1] == (
            "Another vehicle than the default one flew: inertia_xx ended far from its."
        )
    assert outcome(noticing(ended(0.4), default)).usability is Usability.WITH_CARE


def answering(part, roll, flight=CONTROLLER_FILE):
    numbers = {"roll": roll, "roll_error": 0.005, "pitch": 1.0, "pitch_error": 0.004}
    return Finding(Code.CONTROLLER_ANSWERS, "warning", flight, numbers, (part, "roll", "pitch"))


@pytest.mark.parametrize(
    ("answers", "expected"),
    [
        ((("P", 0.77), ("I", 0.74)), Usability.UNUSABLE),
        ((("P", 1.25), ("I", 1.3), ("late", 0.004)), Usability.UNUSABLE),
        ((("P", 1.25), ("I", -0.1)), Usability.UNUSABLE),
        ((("P", 0.9), ("I", 0.74)), Usability.WITH_CARE),
        ((("I", 0.7), ("late", -0.004)), Usability.WITH_CARE),
        ((("P", 0.77, "circle"), ("I", 0.74, "circle")), Usability.WITH_CARE),
    ],
)
def test_commands_of_another_rate_loop_than_the_fitted_one_forbid_it(result, answers, expected):
    """As of a vehicle file with arms half as long again, whose terms made up for them."""
    answering_all = noticing(result, *(answering(*each) for each in answers))
    found = outcome(answering_all)
    assert found.usability is expected
    assert ("another's" in found.reasons[-1]) == (expected is Usability.UNUSABLE)
    words, command = next_step(answering_all, found, Path("x"))
    assert words == remedy(answering_all.findings[0])
    assert command == "tune report x --open"


@pytest.mark.parametrize(
    ("setting", "fitted", "expected"),
    [
        ("rate.rate", (), Usability.UNUSABLE),
        ("rate.roll.ff", ("rate_gain_roll_pitch",), Usability.UNUSABLE),
        ("filters.gyro_cutoff", (), Usability.UNUSABLE),
        ("filters.gyro_cutoff", ("gyro_cutoff_factor",), Usability.USABLE),
        ("rate.yaw.k", ("rate_gain_yaw",), Usability.USABLE),
    ],
)
def test_a_setting_of_the_rate_loop_that_no_coefficient_stands_for_forbids_it(
    result, setting, fitted, expected
):
    numbers = {setting: 25.0, f"{setting}_error": 1.0, f"{setting}_file": 40.0}
    loop = Finding(Code.RATE_LOOP_DIFFERS, "warning", CONTROLLER_FILE, numbers, (setting,))
    row = result.coefficients["inertia_xx"].model_copy(update={"fitted": True})
    rows = {**result.coefficients, **dict.fromkeys(fitted, row)}
    answers = {"roll": 1.2, "roll_error": 0.01}
    follows = Finding(Code.CONTROLLER_ANSWERS, "warning", CONTROLLER_FILE, answers, ("P", "roll"))
    said = noticing(result.model_copy(update={"coefficients": rows}), loop, follows)
    assert sort_by_weight(said.findings)[0] == loop
    said = noticing(result.model_copy(update={"coefficients": rows}), loop)
    found = outcome(said)
    assert found.usability is expected
    if expected is Usability.UNUSABLE:
        assert next_step(said, found, Path("x"))[0] == remedy(loop)


def test_flights_that_tell_nothing_of_the_vehicle_and_check_nothing_are_not_usable(result):
    rows = {
        name: row.model_copy(update={"identifiable": COEFFICIENTS[name].is_effect})
        for name, row in result.coefficients.items()
    }
    unknown = result.model_copy(update={"coefficients": rows})
    assert outcome(unknown).usability is not Usability.UNUSABLE
    found = outcome(with_held(unknown, split="fit"))
    assert found.usability is Usability.UNUSABLE
    assert found.reasons[-1] == "Its flights determine no coefficient of the motor model."


def test_what_nothing_checks_or_something_doubts_is_used_with_care(result, tmp_path):
    unchecked = with_held(result, split="fit")
    assert outcome(unchecked).usability is Usability.WITH_CARE
    assert "No flight was held out" in outcome(unchecked).reasons[-1]
    assert next_step(unchecked, outcome(unchecked), tmp_path)[1] == "tune ... --holdout checks"
    lacks = {"unmatched": 2.0, "flights": 2.0, "noise_multiple": 30.0}
    doubted = noticing(result, Finding(Code.MODEL_UNMATCHED, "warning", "model", lacks))
    assert outcome(doubted).usability is Usability.WITH_CARE
    gap = noticing(result, Finding(Code.POSE_GAP, "warning", "checks", {"seconds": 0.2}))
    assert outcome(gap).usability is Usability.USABLE


def test_where_the_export_that_is_next_was_refused_the_next_step_is_why(result, tmp_path):
    """The command would be refused again."""
    why = f"{tmp_path}: its numbers are not fit to export: mass 2 is its lower bound; fit again"
    refused, written = (
        ExportRecord(format="sdf", refused=why),
        ExportRecord(format="yaml", file="a"),
    )
    for exports in ((refused,), (refused, written)):
        words, command = next_step(result, outcome(result), tmp_path, exports)
        assert words == "Its numbers are not fit to export: mass 2 is its lower bound."
        assert command.startswith("tune report")
    other = refused.model_copy(update={"format": "px4"})
    assert next_step(result, outcome(result), tmp_path, (other, written))[0].startswith("Put")
    assert outcome(result, exports=(refused,)).usability is Usability.WITH_CARE
    assert outcome(result, exports=(refused, written)).usability is Usability.USABLE


def test_a_conflict_of_measurements_is_settled_before_anything_is_exported(result, tmp_path):
    numbers = {"deviation": 9.0, "ground": 1.4e-5, "flights": 1.2e-5, "mass": 1.9}
    conflict = Finding(Code.GROUND_CONFLICT, "warning", "motor_constant", numbers, ("N s²/rad²",))
    contradicted = noticing(result, conflict)
    words, command = next_step(contradicted, outcome(contradicted), tmp_path)
    assert words == remedy(conflict)
    assert command.startswith("tune report")


def test_what_doubts_the_numbers_comes_before_what_does_not():
    gap = Finding(Code.POSE_GAP, "warning", "a", {"seconds": 0.2})
    info = Finding(Code.YAW_OPEN, "info", "b")
    doubt = Finding(Code.TURNING_UNEXPLAINED, "warning", "c", {"explained": 0.4})
    other = Finding(Code.VEHICLE_NOT_GIVEN, "warning", "d", {"mass": 2.0})
    numbers = {"rate_gain_yaw": 0.5, "rate_gain_yaw_error": 0.1}
    cause = Finding(Code.TERM_SHOWS, "warning", "rate_gain", numbers, ("rate_gain_yaw",))
    failure = Finding(Code.NOT_FINITE, "failure", "e")
    left = Finding(Code.LEFT_OUT, "warning", "f", names=("nothing flies in it", "cut it"))
    said = warnings_of((info, gap, left, doubt, other, cause, failure))
    assert [warning.link for warning in said] == ["e", "d", "rate_gain", "f", "c", "a"]
    refuted = Finding(Code.FLIGHTS_REFUTE, "failure", "e")
    said = warnings_of((gap, doubt, other, cause, refuted))
    assert [warning.link for warning in said] == ["d", "e", "rate_gain", "c", "a"]


def test_the_flight_to_hold_out_tells_least_and_is_neither_odd_nor_the_only_one(result, tmp_path):
    unchecked = with_held(result, split="fit")
    told = unchecked.coefficients["motor_constant"]
    reason = told.reason.model_copy(update={"flight": "checks"})
    rows = unchecked.coefficients | {"motor_constant": told.model_copy(update={"reason": reason})}
    unchecked = unchecked.model_copy(update={"coefficients": rows})
    other = unchecked.flights[0].name
    assert next_step(unchecked, outcome(unchecked), tmp_path)[1] == f"tune ... --holdout {other}"
    odd = Finding(Code.FLIGHT_UNMATCHED, "warning", other, {"position": 20.0})
    unmatched = noticing(unchecked, odd)
    step = next_step(unmatched, outcome(unmatched), tmp_path)
    assert step[1] == "tune ... --holdout checks"
    alone = unchecked.model_copy(update={"flights": unchecked.flights[:1]})
    assert next_step(alone, outcome(alone), tmp_path)[0].startswith("Record a second flight")


def test_how_far_flights_are_predicted_is_said_where_they_are_not_flown_whole(result):
    assert flights_table(outcome(result).flights).columns[1] == "position RMSE"
    found = outcome(with_held(result, horizon=0.51))
    assert flights_table(found.checks).columns[1] == "position RMSE in 0.51 s"
    assert "in predictions of 0.51 s" in found.reasons[0]


def test_held_coefficients_are_counted_as_held():
    verdicts = [Verdict.WELL_KNOWN, Verdict.WELL_KNOWN, Verdict.HELD, Verdict.NOT_IDENTIFIABLE]
    assert verdict_counts(verdicts) == (
        "2 are well known, 1 is held at its initial value and 1 is not identifiable"
    )
    assert verdict_counts([Verdict.HELD] * 2) == "all 2 are held at their initial values"
