"""The command `tune sensitivity` on a recording, from the command line and from Python."""

import json
import shutil

import pytest

import tuner
from tuner.cli import main
from tuner.core.errors import InputError
from tuner.core.shipped import configs_folder
from tuner.job.results import arena_of
from tuner.report.contents import read_contents
from tuner.result import OF_A_RUN
from tuner.vehicle import ControllerFile

pytestmark = pytest.mark.slow

FREE = ["motor_constant", "inertia_zz", "moment_constant"]


@pytest.fixture(scope="module")
def examined(bag, updated, tmp_path_factory):
    out = tmp_path_factory.mktemp("examined") / "out"
    return tuner.sensitivity(
        [bag],
        vehicle=updated,
        controller=ControllerFile(),
        free=FREE,
        arena=(2.0, 2.0, 2.0),
        out=out,
    )


def test_the_folder_holds_tables_matrices_and_the_report(examined):
    names = {path.name for path in examined.folder.iterdir()}
    assert (
        {
            "sensitivity.csv",
            "sensitivity.json",
            "information_shares.csv",
            "correlation.csv",
            "covariance.csv",
            "information.csv",
            "next_flight.csv",
            "about.json",
            "report.html",
        }
        <= names
        <= {*OF_A_RUN}
    )
    about = json.loads((examined.folder / "about.json").read_text())
    assert about["flights"][0]["name"] == "small_circle"
    assert len(about["flights"][0]["sha256"]) == 64


def test_the_folder_of_a_fit_is_left_alone(bag, tmp_path):
    (tmp_path / "result.json").write_text('{"schema_version": 1}')
    with pytest.raises(InputError, match="holds the result of a fit"):
        tuner.sensitivity([bag], out=tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["result.json"]


def test_the_report_says_that_nothing_was_fitted(examined):
    text = (examined.folder / "report.html").read_text()
    assert "nothing fitted" in text
    assert "What to fly next" in text
    assert "best</th>" not in text


def test_what_matters_is_known_and_what_does_not_is_not(examined):
    known = examined.knowledge.coefficients
    assert known["motor_constant"].fitted
    assert known["motor_constant"].verdict == "well_known"
    assert not known["rolling_moment_coefficient"].fitted
    changes = {
        name: max(o.change[name] for o in examined.knowledge.outputs if o.channel == "position")
        for name in known
    }
    assert changes["motor_constant"] > 100 * changes["rolling_moment_coefficient"]
    assert examined.proposals.arena == (2.0, 2.0, 2.0)


def test_an_arena_is_taken_from_the_flights(flight):
    arena = arena_of([flight])
    assert arena.x >= 2.0
    assert arena.z >= 1.5


@pytest.mark.parametrize(
    ("arena", "expected"),
    [("8,x,3", "is not a list of lengths"), ("8,6", "three lengths"), ("1,1,1", "too small")],
)
def test_a_wrong_arena_is_one_line_and_writes_nothing(bag, tmp_path, capsys, arena, expected):
    out = tmp_path / "out"
    words = ["sensitivity", "--flights", str(bag), "--arena", arena, "--out", str(out)]
    assert main(words) == 2
    err = capsys.readouterr().err
    assert expected in err
    assert err.count("\n") == 1
    assert not out.exists()


def test_a_link_that_leads_out_of_its_folder_is_not_followed(examined, tmp_path):
    folder = tmp_path / "examined"
    shutil.copytree(examined.folder, folder)
    read_contents(folder)
    (folder / "report.html").unlink()
    (folder / "report.html").symlink_to(examined.folder / "report.html")
    with pytest.raises(InputError, match=r"report\.html: is a link that leads out"):
        read_contents(folder)


def test_the_other_way_round_is_refused_too(bag):
    with pytest.raises(InputError, match="--arena"):
        tuner.sensitivity([bag], arena=(8.0, 6.0))


def test_the_command_asks_for_what_was_typed_and_prints_a_line_for_each_coefficient(
    examined, bag, tmp_path, capsys, monkeypatch
):
    asked = []

    def examine(options, arena, **_):
        asked.append((list(options.flights), list(options.fit), arena, options.out))
        return examined

    monkeypatch.setattr("tuner.job.sensitivity.examine_vehicle", examine)
    vehicle = configs_folder() / "vehicles" / "hovergames_updated.yaml"
    out = tmp_path / "out"
    words = ["sensitivity", "--flights", str(bag), "--vehicle", str(vehicle), "--fit", *FREE]
    assert main([*words, "--arena", "2,2,2", "--out", str(out)]) == 0
    assert asked == [([str(bag)], FREE, (2.0, 2.0, 2.0), out)]
    shown = capsys.readouterr().out
    assert "rolling_moment_coefficient (fixed)" in shown
    assert "The worst determined combination of coefficients: " in shown
    assert f"Written to {examined.folder}:" in shown
