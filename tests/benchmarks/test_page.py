"""The page of results says what was measured, and does not call a missed bar met."""

import sys

import pytest

from benchmarks.__main__ import page
from benchmarks.table import Bar, ResultSection, figure, millions, update_section
from benchmarks.timing import Contestant, Spread, compete

ANSWERS = """
import sys, time
print("noise before")
print("ready 1000 two threads", flush=True)
for number, _ in enumerate(sys.stdin, 1):
    print(0.25 * number, flush=True)
"""


def test_contestants_run_in_turn_and_rates_are_per_second():
    given = [
        Contestant("one", (sys.executable, "-c", ANSWERS), {}),
        Contestant("absent", (sys.executable, "-c", "import no_such_peer"), {}),
    ]
    present, absent = compete(given, rounds=3)
    assert present.rate is not None
    assert present.rate.median == pytest.approx(1000 / 0.5)
    assert present.rate.low < present.rate.median < present.rate.high
    assert present.remark == "two threads"
    assert absent.rate is None
    assert "no_such_peer" in absent.remark


@pytest.mark.parametrize(
    ("measured", "sense", "verdict"),
    [
        (2.0, "at least", "met"),
        (1.0, "at least", "missed"),
        (1.0, "at most", "met"),
        (2.0, "at most", "missed"),
        (None, "at most", "not measured"),
    ],
)
def test_a_bar_is_met_or_missed(measured, sense, verdict):
    assert Bar("speed", measured, 1.5, sense).row()[-1] == verdict


def test_the_page_begins_with_the_bars_and_holds_every_table():
    bar = Bar("twice as fast", 1.9, 2.0, "at least", " ×")
    section = ResultSection(
        "Speed", "How.", ["", "rate"], [["ours", millions(Spread.of([2e6]))]], [bar]
    )
    text = page([section], "here", 1.0)
    assert "| twice as fast | 1.9 × | at least 2 × | missed |" in text
    assert text.index("twice as fast") < text.index("## Speed") < text.index("| ours | 2 (2–2) |")
    assert "NPROC" in text


def test_a_part_takes_the_place_that_it_had_on_the_page():
    one, two, three = (ResultSection(t, "Old.", ["a"], [["1"]]) for t in ("One", "Two", "Three"))
    old = update_section(update_section("# Page\n", one), two)
    assert update_section(old, two) == old
    new = update_section(old, ResultSection("One", "New.", ["a"], [["2"]]))
    assert new == old.replace("Old.", "New.", 1).replace("| 1 |", "| 2 |", 1)
    assert update_section(old, three).index("## Three") > old.index("## Two")


def test_figures_have_three_digits():
    assert [figure(value) for value in (0.0, 0.12345, 12.345, 1234.5)] == [
        "0",
        "0.123",
        "12.3",
        "1234",
    ]
