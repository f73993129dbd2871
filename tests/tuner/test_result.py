import json

import pytest

from tests.tuner.exporters.conftest import make_run  # noqa: F401 (a fixture)
from tuner.core.errors import InputError, OutputError
from tuner.findings.findings import Code, Finding
from tuner.report.contents import read_contents
from tuner.result import ExportRecord, ExportRecords, forget, place_for, read_run


def test_a_result_comes_back_from_its_file_as_it_was(make_run):  # noqa: F811
    run = make_run()
    run.result.write(run.folder)
    again = read_run(run.folder)
    assert again == run
    assert again.vehicle.name == "hovergames_updated"


def test_keys_of_later_versions_are_passed_over(make_run):  # noqa: F811
    run = make_run()
    path = run.folder / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"later": 1}))
    assert read_run(run.folder).result == run.result


FIXED = {"verdict": "fixed", "reason": {"code": "not_fitted"}}


def test_a_verdict_is_a_code_with_the_numbers_of_its_reason(make_run):  # noqa: F811
    run = make_run()
    written = json.loads((run.folder / "result.json").read_text())["coefficients"]["mass"]
    assert written["verdict"] == "well_known"
    assert written["reason"] == {"code": "interval", "half_width": 0.02}


def test_findings_come_back_as_they_were(make_run):  # noqa: F811
    run = make_run()
    numbers = {"far_off": 7, "flights": 9.0}
    finding = Finding(Code.FLIGHTS_FAR_OFF, "warning", "circle", numbers, ("x", ""))
    run.result.model_copy(update={"findings": (finding,)}).write(run.folder)
    (again,) = read_run(run.folder).result.findings
    assert again == finding
    assert repr(again.numbers["far_off"]) == "7"


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"schema_version": 3}, "has schema version 3, and this tune reads version 2"),
        ({"schema_version": 1}, "has schema version 1, and this tune reads version 2"),
        ({"schema_version": None}, "has no schema version"),
        ({"seed": "x"}, "seed is 'x'"),
        ({"status": "done"}, "status is 'done'"),
        ({"versions": {"tune": "9" * 10**5}}, "it should have at most 200 characters"),
        (
            {
                "coefficients": {
                    "mas": {"unit": "", "initial": 1, "best": 1, "fitted": False} | FIXED
                }
            },
            "'mas'",
        ),
    ],
)
def test_what_is_no_result_is_refused_in_one_line(make_run, change, expected):  # noqa: F811
    run = make_run()
    path = run.folder / "result.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError) as error:
        read_run(run.folder)
    assert expected in str(error.value)
    assert str(path) in str(error.value)


def changed(run, key, value):
    path = run.folder / "result.json"
    content = json.loads(path.read_text())
    content["coefficients"]["mass"][key] = value
    path.write_text(json.dumps(content))


def test_numbers_that_were_edited_in_one_file_are_no_result(make_run):  # noqa: F811
    run = make_run()
    changed(run, "best", 2.0)
    with pytest.raises(InputError, match=r"best_fit\.yaml: mass is 2\.243, and 2 in result\.json"):
        read_run(run.folder)


@pytest.mark.parametrize("value", ["nan", "2.079", True, float("inf"), 10**400])
def test_a_number_is_a_finite_number(make_run, value):  # noqa: F811
    run = make_run()
    changed(run, "initial", value)
    with pytest.raises(InputError, match=r"result\.json"):
        read_run(run.folder)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('"seed": 0', '"seed": 0, "seed": 1', "has the key 'seed' twice"),
        ('"duration": 36.0', '"duration": 1e999', "holds 1e999, which is no finite number"),
        ('"seed": 0', '"seed": ' + "[" * 100_000, "nested too deeply"),
    ],
)
def test_a_file_that_says_two_things_or_no_number_is_refused(make_run, old, new, expected):  # noqa: F811
    path = make_run().folder / "result.json"
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=expected):
        read_run(path.parent)


@pytest.mark.parametrize("name", ["export", "effective", "report.html", "best_fit.yaml"])
def test_a_link_that_leads_out_of_a_result_folder_is_not_followed(make_run, tmp_path, name):  # noqa: F811
    folder, outside = make_run().folder, tmp_path / "outside"
    outside.mkdir()
    (folder / "environment").symlink_to(outside)
    read_run(folder)  # what is of no run leads where it likes
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(outside)
    for use in (read_run, read_contents, place_for):
        with pytest.raises(InputError, match=f"{name}: is a link that leads out"):
            use(folder)


def test_a_folder_without_a_result_is_named(tmp_path):
    with pytest.raises(InputError, match="finished run"):
        read_run(tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        read_run(tmp_path / "gone")
    (tmp_path / "result.json").write_text("{")
    with pytest.raises(InputError, match=r"result\.json"):
        read_run(tmp_path)


def test_nothing_of_an_earlier_run_is_left_for_the_next_one(make_run):  # noqa: F811
    folder = make_run().folder
    exports = folder / "export"
    exports.mkdir()
    for path in (folder / "bootstrap.csv", folder / "notes.txt", exports / "quad.sdf"):
        path.touch()
    (exports / "own.sdf").touch()
    records = {
        kind: ExportRecord(format=kind, file=file)
        for kind, file in {"sdf": "export/quad.sdf", "px4": "export/../notes.txt"}.items()
    }
    ExportRecords(exports=records).write(folder)
    forget(folder)
    left = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert left == {"notes.txt", "export/own.sdf"}


def test_what_cannot_be_removed_is_one_line(make_run):  # noqa: F811
    folder = make_run().folder
    (folder / "report.html").mkdir()
    with pytest.raises(OutputError, match=r"report\.html: cannot be written"):
        forget(folder)
