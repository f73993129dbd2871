"""The page of results says what was measured, and does not call a missed bar met."""

import sys

import pytest

from benchmarks import __main__ as command
from benchmarks import derivatives, reading
from benchmarks.__main__ import page
from benchmarks.table import (
    Bar,
    Section,
    figure,
    millions,
    sections_of,
    update_bars,
    update_section,
)
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
    section = Section("Speed", "How.", ["", "rate"], [["ours", millions(Spread.of([2e6]))]], [bar])
    text = page([section], "here", 1.0)
    assert "| twice as fast | 1.9 × | at least 2 × | missed |" in text
    assert text.index("twice as fast") < text.index("## Speed") < text.index("| ours | 2 (2–2) |")
    assert "NPROC" in text


def test_a_part_takes_the_place_that_it_had_on_the_page():
    one, two, three = (Section(t, "Old.", ["a"], [["1"]]) for t in ("One", "Two", "Three"))
    old = update_section(update_section("# Page\n", one), two)
    assert update_section(old, two) == old
    new = update_section(old, Section("One", "New.", ["a"], [["2"]]))
    assert new == old.replace("Old.", "New.", 1).replace("| 1 |", "| 2 |", 1)
    assert update_section(old, three).index("## Three") > old.index("## Two")


def test_figures_have_three_digits():
    assert [figure(value) for value in (0.0, 0.12345, 12.345, 1234.5)] == [
        "0",
        "0.123",
        "12.3",
        "1234",
    ]


def rate(measured):
    return Bar("rate", measured, 1.0, "at least", " M")


def test_bars_of_a_part_take_their_rows_in_the_first_table_and_new_ones_follow():
    other = "\n## One\n\n| rate | 7 |\n"
    before = f"# Page\n\n| bar |\n| --- |\n| rate | 1 M | at least 1 M | met |\n{other}"
    new = update_bars(before, [rate(0.5), Bar("wait, warm", 30.0, 100.0, "at most", " s")])
    assert "| rate | 0.5 M | at least 1 M | missed |\n| wait, warm | 30 s |" in new
    assert new.endswith(f"\n{other}")


def test_the_command_writes_parts_and_keeps_what_it_does_not_measure(tmp_path, monkeypatch):
    results = tmp_path / "RESULTS.md"
    kept = Section("Calibration", "Of another day.", ["a"], [["1"]])
    results.write_text(update_section("# Page\n", kept), encoding="utf-8")
    monkeypatch.setattr(command, "RESULTS", results)
    monkeypatch.setattr(command, "PARTS", ("derivatives", "reading"))
    speed = Section("Derivatives", "Now.", ["a"], [["2"]], [rate(1.0)])
    monkeypatch.setattr(derivatives, "measure", lambda: speed)
    monkeypatch.setattr(reading, "measure", lambda: Section("Reading", "Now.", ["a"], [["3"]]))

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
        command.main()
        return results.read_text(encoding="utf-8")

    whole = run()
    assert list(sections_of(whole)) == ["Derivatives", "Reading", "Calibration"]
    speed = Section("Derivatives", "Later.", ["a"], [["2"]], [rate(3.0)])
    part = run("derivatives", "--update")
    assert "| rate | 3 M | at least 1 M | met |" in part.partition("\n## ")[0]
    assert "Later." in sections_of(part)["Derivatives"]
    assert sections_of(part)["Calibration"] == sections_of(whole)["Calibration"]
    unchanged = run("derivatives")
    assert unchanged == part
