"""A run's result in words: its second answer, its terms, how often intervals held."""

import pytest

from benchmarks.calibration import KINDS
from tests.tuner.exporters.test_export import EFFECTIVE
from tuner.report.result_texts import (
    calibration_in_words,
    effective_in_words,
    gain_in_words,
    selection_in_words,
)
from tuner.result import PoseRmse
from tuner.uncertainty.records import COVERAGE_LEVELS, Calibration, CoverageRecord, calibration
from tuner.vehicle.selection_table import SelectionCode, SelectionRow


def test_the_second_answer_is_said_with_what_it_costs():
    assert effective_in_words(EFFECTIVE) == (
        "Gazebo cannot fly fuselage_drag. With its effective coefficients it misses the flights by "
        "1.2 cm and 0.2°, the physical model by 2 mm and 0.1°; with the physical coefficients and "
        "without these terms it would be 5 cm and 0.4°."
    )
    carrying = EFFECTIVE.model_copy(update={"carried": ("center_of_mass_x",)})
    assert effective_in_words(carrying).endswith("Gazebo has a place for center_of_mass_x.")


def test_a_crash_and_a_metre_are_said_as_such():
    assert PoseRmse(position=None, attitude=None).words == "a crash"
    assert PoseRmse(position=2.345, attitude=12.0).words == "2.35 m and 12°"
    assert PoseRmse(position=2.345, attitude=None).words == "2.35 m"  # it is followed


def row(code, *, kept=False):
    return SelectionRow(group="battery", names=("battery_exponent",), kept=kept, reason=code)


@pytest.mark.parametrize("code", SelectionCode)
def test_every_reason_is_a_clause(code):
    clause = row(code).reason.text
    assert clause
    assert not clause.endswith(".")


def test_what_was_added_is_named():
    rows = [row(SelectionCode.PREDICTS_FLIGHTS, kept=True), row(SelectionCode.IMMATERIAL)]
    assert selection_in_words(rows) == "Added to Gazebo's motor model: battery."
    assert "any term" in selection_in_words(rows[1:])
    assert selection_in_words([]) == ""


def test_a_gain_is_a_share_of_the_loss():
    assert [gain_in_words(g) for g in (0.123, 1e-6, None)] == ["12 %", "0 %", "–"]


def held(flights, share):
    coverage = dict(zip(COVERAGE_LEVELS, (0.6, 0.8, share), strict=True))
    return CoverageRecord(flights=flights, sets=12, intervals=144, coverage=coverage, least=0.8)


def test_every_kind_of_flight_is_named_with_what_it_held():
    measured = Calibration(date="2026-01-02", kinds=(held("noise alone", 0.97), held("gusts", 0.9)))
    assert calibration_in_words(measured) == (
        "Measured in simulation, 12 sets of flights of each kind, with the terms that flew in the "
        "model (2026-01-02): 97 % (noise alone) and 90 % (gusts) of the 95 % intervals held the "
        "truth."
    )


def test_what_is_shipped_is_of_every_kind_of_flight():
    shipped = calibration()
    assert [kind.flights for kind in shipped.kinds] == [kind.name for kind in KINDS]
    for kind in shipped.kinds:
        assert kind.intervals >= 12 * kind.sets
        shares = [kind.coverage[level] for level in COVERAGE_LEVELS]
        assert shares == sorted(shares)
        assert 0.0 <= kind.least <= shares[-1] <= 1.0
