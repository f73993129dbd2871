"""The selection of terms in words."""

import pytest

from tuner.selection.table import SelectionCode, SelectionRow
from tuner.wording.result import gain_in_words, reason_in_words, selection_in_words


def row(code, *, kept=False):
    return SelectionRow(group="battery", names=("battery_exponent",), kept=kept, reason=code)


@pytest.mark.parametrize("code", SelectionCode)
def test_every_reason_is_a_clause(code):
    clause = reason_in_words(row(code))
    assert clause
    assert not clause.endswith(".")


def test_what_was_added_is_named():
    rows = [row(SelectionCode.PREDICTS_FLIGHTS, kept=True), row(SelectionCode.IMMATERIAL)]
    assert selection_in_words(rows) == "Added to Gazebo's motor model: battery."
    assert "any term" in selection_in_words(rows[1:])
    assert selection_in_words([]) == ""


def test_a_gain_is_a_share_of_the_loss():
    assert [gain_in_words(g) for g in (0.123, 1e-6, None)] == ["12 %", "0 %", "–"]
