import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from lxml import html

from tests.tuner.evaluate.test_comparison import errors
from tuner.cli import main
from tuner.core.errors import ConfigError, InputError
from tuner.core.shipped import configs_folder
from tuner.evaluate.comparison import Comparison, table_of
from tuner.options import Options
from tuner.report.comparison import compare, write_table
from tuner.search.job_flights import JobFlight
from tuner.vehicle import ControllerFile

LAPS = np.array([20.0, 40.0])
GOOD = errors([[0.1, 0.1, 0.1]] * 60, [[1, 1, 1]] * 60, laps=LAPS)
BAD = errors([[0.2, 0.05, 0.2]] * 60, [[2, 2, 2]] * 60, laps=LAPS)
CRASH = errors([[9, 9, 9]] * 60, [[9, 9, 9]] * 60, laps=LAPS, crash_time=30.0)


@pytest.fixture
def table():
    return table_of({"good": {"f": GOOD}, "bad": {"f": BAD}, "worse": {"f": CRASH}})


def test_rows_are_flights_laps_and_all_for_each_vehicle(table):
    assert [(row.flight, row.lap, row.vehicle) for row in table.rows[::3]] == [
        ("f", None, "good"),
        ("f", 1, "good"),
        ("f", 2, "good"),
        ("f", 3, "good"),
        ("all", None, "good"),
    ]
    assert [row.vehicle for row in table.rows[:3]] == ["good", "bad", "worse"]
    assert table.of("bad", "f", 2).x == pytest.approx(0.2)


def test_the_lowest_of_each_axis_and_the_best_overall_are_marked(table):
    assert table.best == "good"
    winners = table.winners("f", None)
    assert winners == {
        "x": "good",
        "y": "bad",
        "z": "good",
        "roll": "good",
        "pitch": "good",
        "yaw": "good",
    }


def test_nobody_is_best_where_all_crash():
    assert table_of({"a": {"f": CRASH}, "b": {"f": CRASH}}).best is None


def test_csv_has_a_row_an_axis(table, tmp_path):
    write_table(table, tmp_path / "t.csv")
    rows = list(csv.DictReader((tmp_path / "t.csv").read_text().splitlines()))
    assert len(rows) == len(table.rows) * 6
    first = rows[0]
    assert (first["flight"], first["lap"], first["vehicle"], first["axis"]) == (
        "f",
        "",
        "good",
        "x",
    )
    assert float(first["rmse"]) == pytest.approx(0.1)
    assert (first["unit"], first["best"], first["crash_time"]) == ("m", "1", "")
    crashed = next(row for row in rows if row["vehicle"] == "worse")
    assert (crashed["rmse"], crashed["crash_time"], crashed["best"]) == ("", "30.0", "0")


def test_json_holds_the_same(table, tmp_path):
    write_table(table, tmp_path / "t.json")
    content = json.loads((tmp_path / "t.json").read_text())
    assert content["schema_version"] == 1
    assert content["best"] == "good"
    assert content["units"]["roll"] == "deg"
    assert len(content["rows"]) == len(table.rows)
    assert content["rows"][0]["rmse"]["x"] == pytest.approx(0.1)


def test_html_marks_the_best_and_needs_no_network(table, tmp_path):
    path = tmp_path / "t.html"
    write_table(table, path)
    page = html.parse(path)
    first = page.xpath("//tr")[1]
    assert [cell.text for cell in first.xpath("td/span[@class='badge well']")] == [
        "0.1000*",
        "0.1000*",
        "1.0000*",
        "1.0000*",
        "1.0000*",
    ]
    assert "crashed at 30.00 s" in path.read_text()
    assert "://" not in path.read_text()


def test_names_are_escaped_in_html(tmp_path):
    write_table(table_of({"<b>&": {"f": GOOD}}), tmp_path / "t.html")
    assert "&lt;b&gt;&amp;" in (tmp_path / "t.html").read_text()


@pytest.fixture(scope="session")
def compared(bag, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "t.csv"
    vehicles = ["hovergames", "hovergames_updated"]
    table, settings = compare(Options([str(bag)]), vehicles, [out])
    return table, settings, out


def test_recordings_are_compared_with_named_vehicles(compared):
    table, settings, out = compared
    assert table.vehicles == ("hovergames", "hovergames_updated")
    assert table.best == "hovergames_updated"
    assert table.of("hovergames_updated", "small_circle").x < 2e-4
    assert table.of("hovergames", "small_circle", 2).x > 0.01
    assert settings.origin["controller"] == "default (hovergames.yaml)"
    assert out.exists()


def test_the_job_file_says_what_flew(bag, compared, tmp_path):
    job = tmp_path / "tune.yaml"
    job.write_text("holdout: [small_circle]\nflights: {small_circle: {time_offset: 0.1}}\n")
    (tmp_path / "empty.bag").touch()
    said = []
    table, settings = compare(
        Options([str(bag), str(tmp_path / "empty.bag")], config=str(job)),
        [str(configs_folder() / "vehicles" / "hovergames_updated.yaml")],
        on_message=said.append,
    )
    assert settings.job_path == job
    (line,) = said
    assert line.startswith("warning: empty: It is empty; the flight is left out.")
    (row, *_) = table.rows
    assert row.rmse.x > 100 * compared[0].of("hovergames_updated", "small_circle").x


def test_a_mission_that_is_not_there_is_named(bag):
    with pytest.raises(InputError, match="no flight 'small_circle-2'; did you mean"):
        compare(Options([str(bag)], holdout=["small_circle-2"]), ["hovergames"])


def test_the_command_prints_the_table(bag, capsys):
    arguments = ["compare", "--flights", str(bag), "--vehicle", "hovergames_updated", "hovergames"]
    assert main([*arguments, "--laps"]) == 0
    out = capsys.readouterr().out
    assert "small_circle lap 2" in out
    assert "Best over all flights: hovergames_updated." in out
    assert main([*arguments, "--quiet"]) == 0
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--flights", "{bag}", "--vehicle"], "names no vehicle"),
        (["--flights", "{bag}", "--vehicle", "nope"], "shipped vehicles"),
        (["--flights", "nope.bag", "--vehicle", "hovergames"], "does not exist"),
        (["--flights", "{bag}", "--vehicle", "hovergames", "--out", "t.txt"], "'.txt'"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(bag, arguments, expected, capsys):
    assert main(["compare", *(word.format(bag=bag) for word in arguments)]) == 2
    err = capsys.readouterr().err
    assert expected in err
    assert err.count("\n") == 1


def test_a_vehicle_that_the_mixer_cannot_fly_is_refused(flight, updated):
    six = updated.model_copy(update={"rotors": (*updated.rotors, *updated.rotors[:2])})
    with pytest.raises(ConfigError, match="has 6 rotors"):
        Comparison([JobFlight(flight)], ControllerFile()).fly(six)


def test_a_recording_without_reference_is_refused(flight):
    bare = replace(flight, signals={"position": flight.signals["position"]})
    with pytest.raises(InputError, match="no reference"):
        Comparison([JobFlight(bare)], ControllerFile())
