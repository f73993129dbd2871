"""The page of results remembers what was measured before, and a regression shows on it."""

import sys
from datetime import UTC, datetime

import pytest

from benchmarks import __main__ as command
from benchmarks import reading, simulator
from benchmarks.table import (
    TITLE,
    Bar,
    ResultSection,
    lines_of,
    sections_of,
    update_bars,
    update_section,
    updated_history,
)

MORNING = datetime(2026, 11, 21, 9, 5, tzinfo=UTC)
EVENING = datetime(2026, 11, 21, 21, 0, tzinfo=UTC)
NEXT_DAY = datetime(2026, 11, 22, 9, 5, tzinfo=UTC)


def rate(measured):
    return Bar("rate", measured, 1.0, "at least", " M")


def wait(measured):
    return Bar("wait, warm", measured, 100.0, "at most", " s")


def with_line(page, bars, when=MORNING, version="1.0", *, whole=True):
    return update_section(
        page, updated_history(page, bars, when=when, version=version, whole=whole)
    )


def test_every_whole_measure_is_a_line_and_none_is_lost():
    page = with_line("# Page\n", [rate(2.0), wait(30.0)])
    page = with_line(page, [rate(2.1), wait(29.0)], EVENING)
    first, second = lines_of(page)
    assert first == {
        "measured": "2026-11-21 09:05",
        "version": "1.0",
        "rate": "2",
        "wait, warm": "30",
    }
    assert second["rate"] == "2.1"


@pytest.mark.parametrize(
    ("when", "version", "lines"), [(EVENING, "1.0", 1), (NEXT_DAY, "1.0", 2), (EVENING, "1.1", 2)]
)
def test_a_part_joins_the_line_of_its_day_and_version(when, version, lines):
    page = with_line("# Page\n", [rate(2.0)])
    page = with_line(page, [wait(30.0)], when, version, whole=False)
    assert len(lines_of(page)) == lines
    assert lines_of(page)[-1]["wait, warm"] == "30"
    assert ("rate" in lines_of(page)[-1]) is (lines == 1)


@pytest.mark.parametrize(
    ("bar", "marked"), [(rate(1.5), True), (rate(1.9), False), (rate(9.0), False)]
)
def test_what_is_worse_than_the_best_before_is_marked_either_way_round(bar, marked):
    page = with_line(with_line("# Page\n", [rate(2.0), wait(1 / 2.0)]), [rate(1.9), wait(1 / 1.9)])
    turned = wait(1 / bar.measured)
    last = lines_of(with_line(page, [bar, turned], NEXT_DAY))[-1]
    assert last["rate"].endswith("↓") is marked
    assert last["wait, warm"].endswith("↓") is marked


def test_what_could_not_be_measured_leaves_a_gap_and_no_mark():
    page = with_line(with_line("# Page\n", [rate(2.0)]), [rate(None)], EVENING)
    page = with_line(page, [rate(1.0)], NEXT_DAY)
    assert "rate" not in lines_of(page)[1]
    assert lines_of(page)[2]["rate"] == "1 ↓"


def test_bars_of_a_part_take_their_rows_in_the_first_table_and_new_ones_follow():
    other = "\n## One\n\n| rate | 7 |\n"
    page = f"# Page\n\n| bar |\n| --- |\n| rate | 1 M | at least 1 M | met |\n{other}"
    new = update_bars(page, [rate(0.5), wait(30.0)])
    assert "| rate | 0.5 M | at least 1 M | missed |\n| wait, warm | 30 s |" in new
    assert new.endswith(f"\n{other}")


def test_the_command_writes_lines_and_keeps_what_it_does_not_measure(tmp_path, monkeypatch):
    results = tmp_path / "RESULTS.md"
    kept = ResultSection("Calibration", "Of another day.", ["a"], [["1"]])
    results.write_text(update_section(with_line("# Page\n", [rate(2.0)]), kept), encoding="utf-8")
    monkeypatch.setattr(command, "RESULTS", results)
    parts = {name: command.PARTS[name] for name in ("derivatives", "reading")}
    monkeypatch.setattr(command, "PARTS", parts)
    speed = ResultSection("Derivatives", "Now.", ["a"], [["2"]], [rate(1.0)])
    monkeypatch.setattr(simulator, "derivatives", lambda: speed)
    monkeypatch.setattr(
        reading, "measure", lambda: ResultSection("Reading", "Now.", ["a"], [["3"]])
    )

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["benchmarks", *words])
        command.main()
        return results.read_text(encoding="utf-8")

    whole = run()
    assert list(sections_of(whole)) == [TITLE, "Derivatives", "Reading", "Calibration"]
    assert [line["rate"] for line in lines_of(whole)] == ["2", "1 ↓"]
    speed = ResultSection("Derivatives", "Later.", ["a"], [["2"]], [rate(3.0)])
    part = run("derivatives", "--update")
    assert [line["rate"] for line in lines_of(part)] == ["2", "3"]
    assert "| rate | 3 M | at least 1 M | met |" in part.partition("\n## ")[0]
    assert sections_of(part)["Calibration"] == sections_of(whole)["Calibration"]
    unchanged = run("derivatives")
    assert unchanged == part


def test_the_page_of_the_project_has_its_releases():
    page = command.RESULTS.read_text(encoding="utf-8")
    assert next(line["version"] for line in lines_of(page)) == "0.1.0"
