"""The report as its readers see it: what it says, and that it draws in a browser."""

from __future__ import annotations

import html
import json
import re
from pathlib import Path

import pytest

from tests.tuner.report import making
from tests.tuner.report.conftest import FREE, ROLLING
from tuner.core.errors import InputError
from tuner.findings.findings import Code, Finding
from tuner.report import render
from tuner.report.contents import SearchRecord, read_contents
from tuner.report.page import sections_of
from tuner.report.sections.coefficients import sources
from tuner.result import ExportRecord, ExportRecords, Gate, read_run
from tuner.uncertainty.records import Sources
from tuner.uncertainty.verdict import Direction

WITH_MASS = (
    "mass",
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
)


def words(page: Path) -> str:
    """Return what a reader reads, tags and scripts left out."""
    text = page.read_text().partition('<script id="figures"')[0]
    text = re.sub(r"<style>.*?</style>", " ", text, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]*>", " ", text)).split())


def test_the_page_answers_what_a_reader_asks(report: Path) -> None:
    text = words(report)
    assert text.index("Usable") < text.index("Coefficients coefficient")
    assert "7 coefficients were fitted to 1 flight; 1 was held out to check them" in text
    assert "spin, held out: position error from" in text
    assert "Not as physical values: rolling_moment_coefficient, not identifiable." in text
    assert "Gazebo cannot fly fuselage_drag" in text
    assert "rotor_drag_coefficient 0.000806 0.0009672 N s²/(rad m) +20 %" in text
    for heading in (
        "Coefficients",
        "In Gazebo",
        "Terms beyond the motor model",
        "Flights",
        "Local sensitivity",
        "Information and correlation",
        "Residuals",
        "Search",
        "Provenance",
    ):
        assert heading in text
    assert "swing, lap 2" in text
    assert "3 → 1.2, 1 (0.75)" in text
    assert "What to log next time" in text
    assert "Log the command at 200 Hz" in text
    assert "Added to Gazebo's motor model: fuselage_drag." in text
    assert "well known" in text
    assert "ab" * 32 in text
    assert "multirotor-tune 0.1.0" in text


def test_the_page_is_one_file_without_the_network(report: Path) -> None:
    raw = report.read_text()
    head, _, rest = raw.partition('<script id="figures"')
    plots, _, library = rest.partition('<script id="library"')
    assert len(head) + len(library) < 400_000
    assert len(plots) > 10_000
    assert not re.search(r'(src|href)="(?!#|data:|export/)', head)
    assert "@import" not in head
    assert "url(" not in head


def test_what_a_user_typed_stays_text(report: Path) -> None:
    assert making.COMMAND in words(report)
    assert making.COMMAND not in report.read_text()


@pytest.fixture(scope="module")
def figures(report: Path) -> list[Path]:
    """Return the files of the page's figures, drawn into its folder."""
    render(report.parent, plots=True)
    return sorted((report.parent / "plots").iterdir())


def test_the_main_figures_are_written_for_papers(figures: list[Path]) -> None:
    drawn = {path.name: path.read_bytes() for path in figures}
    assert {"swing_position.svg", "correlation.svg", "sensitivity.svg", "waterfall.svg"} <= {*drawn}
    assert b"inertia_xx" in drawn["correlation.svg"]


def test_the_same_folder_renders_the_same_page_and_figures(
    report: Path, figures: list[Path]
) -> None:
    files = [report, *figures]
    before = [file.read_bytes() for file in files]
    render(report.parent, plots=True)
    assert [file.read_bytes() for file in files] == before


def test_a_freed_mass_is_named_as_the_scale_that_no_flight_shows(tmp_path: Path) -> None:
    scale = dict.fromkeys(("mass", "inertia_xx", "motor_constant"), 1.0)
    making.write_run(
        tmp_path, WITH_MASS, Direction(moves=scale, error=20.0, null=True, common_scale=True)
    )
    text = words(render(tmp_path))
    assert "scale together: multiplied by one factor, every motion stays the same" in text
    assert "Weigh the mass and fix it" in text
    mass = text.partition("take-off mass")[2].partition("moment of inertia about forward")[0]
    assert "○ not identifiable" in mass
    assert "scale together" in mass
    moment = text.partition("drag torque per thrust")[2].partition("drag in the rotor plane")[0]
    assert "● well known" in moment


def test_the_rolling_moment_is_not_identifiable(report: Path) -> None:
    text = words(report)
    rolling = text.partition("moment in the rotor plane")[2].partition("axial airspeed")[0]
    assert "○ not identifiable" in rolling
    assert "the flights alone hardly tell it from ten times as much" in rolling
    assert "rolling_moment_coefficient alone: it is not identifiable" in text


def test_a_folder_that_is_no_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="result folder"):
        render(tmp_path)
    with pytest.raises(InputError, match="is no folder"):
        render(tmp_path / "none")


def test_a_damaged_file_is_named(report: Path, tmp_path: Path) -> None:
    for name in ("result.json", "best_fit.yaml", "effective.yaml"):
        (tmp_path / name).write_bytes((report.parent / name).read_bytes())
    (tmp_path / "sensitivity.json").write_text('{"schema_version": 2}')
    with pytest.raises(InputError, match=r"sensitivity\.json"):
        render(tmp_path)


def test_a_file_whose_parts_do_not_agree_is_named(tmp_path: Path) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    knowledge = json.loads((tmp_path / "sensitivity.json").read_text())
    name = knowledge["outputs"][0]["change"].popitem()[0]
    (tmp_path / "sensitivity.json").write_text(json.dumps(knowledge))
    with pytest.raises(InputError, match=rf"sensitivity\.json: lacks .* known of {name}"):
        render(tmp_path)
    result = json.loads((tmp_path / "result.json").read_text())
    result["findings"] = [{"code": "pose_gap", "level": "warning", "subject": "swing"}]
    (tmp_path / "result.json").write_text(json.dumps(result))
    with pytest.raises(InputError, match=r"result\.json: finding 'pose_gap' lacks"):
        render(tmp_path)


def test_numbers_that_make_no_figure_are_one_line(tmp_path: Path) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    knowledge = json.loads((tmp_path / "sensitivity.json").read_text())
    for shares in next(iter(knowledge["coefficients"].values()))["shares"].values():
        shares.update(dict.fromkeys(shares, 1e308))
    (tmp_path / "sensitivity.json").write_text(json.dumps(knowledge))
    with pytest.raises(InputError, match="has files that do not go together"):
        render(tmp_path)


@pytest.mark.parametrize("value", [float("nan"), None])
def test_an_effect_over_time_that_is_no_number_or_lacks_is_named(tmp_path: Path, value) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    knowledge = json.loads((tmp_path / "sensitivity.json").read_text())
    changes = next(iter(knowledge["effects_over_time"][0]["change"].values()))
    changes[:1] = [] if value is None else [value]
    (tmp_path / "sensitivity.json").write_text(json.dumps(knowledge))
    expected = "lacks an effect over the time" if value is None else "is not JSON"
    with pytest.raises(InputError, match=rf"sensitivity\.json: {expected}"):
        render(tmp_path)


def test_a_proposal_that_lacks_a_target_is_named(tmp_path: Path) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    flight = {"name": "circle", "trajectory": {}, "shrinks": {}, "volume": 1.0}
    proposals = {"schema_version": 2, "arena": [8, 6, 3], "seconds": 20, "flights": [flight]}
    proposals |= {"targets": ["inertia_zz"], "fixed_targets": [], "all_known": False}
    (tmp_path / "next_flight.json").write_text(json.dumps(proposals))
    with pytest.raises(InputError, match=r"next_flight\.json: lacks what circle would narrow"):
        render(tmp_path)


def test_terms_that_are_worth_nothing_are_one_line(report: Path) -> None:
    text = words(report)
    assert "Tried, and worth nothing here: ground_effect." in text
    assert "fuselage_drag fuselage_drag 30 % 28 % 4 % in the model" in text


def test_warnings_stand_with_the_outcome_and_remarks_are_folded(tmp_path: Path) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    result = read_run(tmp_path).result
    gap = Finding(Code.POSE_GAP, "warning", "swing", {"seconds": 0.4})
    late = Finding(Code.INPUT_LATE, "info", "spin", {"seconds": 0.002})
    result.model_copy(update={"findings": (late, gap)}).write(tmp_path)
    raw = render(tmp_path).read_text()
    box = raw.partition('id="outcome"')[2].partition("</section>")[0]
    assert "No pose was recorded for 0.40 s" in box
    assert "Check the cameras" in box
    remarks = raw.partition('<details class="section" id="remarks">')[2].partition("</details>")[0]
    assert "+2.00 ms late" in remarks


def test_exports_are_linked_with_their_conditions(tmp_path: Path) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    gates = (Gate(name="it hovers"), Gate(name="it flies", objections=("it crashed",)))
    made = ExportRecord(format="sdf", file="export/quad.sdf", gates=gates)
    refused = ExportRecord(format="px4", refused="no thrust")
    ExportRecords(exports={"sdf": made, "px4": refused}).write(tmp_path)
    page = render(tmp_path)
    assert '<a href="export/quad.sdf" download>quad.sdf</a>' in page.read_text()
    text = words(page)
    assert "1 of 2 checks of the export failed, and were accepted" in text
    assert "○ failed: it flies (it crashed)" in text
    assert "px4 refused no thrust" in text


def test_no_figure_shows_a_single_point(tmp_path: Path) -> None:
    making.write_run(tmp_path, FREE, ROLLING)
    search = SearchRecord.read(tmp_path)
    short = search.model_copy(
        update={"iterations": search.iterations[:1], "starts": search.starts[:1]}
    )
    short.write(tmp_path)
    keys = [c.key for s in sections_of(read_contents(tmp_path)) for c in s.charts]
    assert "intervals" in keys
    assert not {"waterfall", "trace", "selection"} & set(keys)


def source(deviation, flights=1.4e-5):
    return Sources(
        ground=1.5e-5,
        ground_error=1e-7,
        flights=flights,
        flights_error=None if flights is None else 1e-8,
        both=1.4e-5,
        both_error=1e-8,
        deviation=deviation,
    )


def test_a_conflict_is_marked_and_what_flights_do_not_say_is_none():
    section = sources(
        {
            "motor_constant": source(-10.0),
            "moment_constant": source(1.0),
            "inertia_xx": source(None, flights=None),
        }
    )
    said = [row[-1].text for row in section.tables[0].rows]
    assert said == ["● conflict", "○ yes", "flights do not identify it"]


def test_a_fit_without_ground_measurements_has_no_such_section(report: Path) -> None:
    keys = {section.key for section in sections_of(read_contents(report.parent))}
    assert "coefficients" in keys
    assert not {"sources", "bench"} & keys
