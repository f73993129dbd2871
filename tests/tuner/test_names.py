"""What users, recordings and requests call things: whatever it is, nothing is written elsewhere."""

import re
import tempfile
from contextlib import contextmanager
from datetime import date
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import tuner
from tests.tuner.exporters.conftest import as_the_run_says, make_run
from tests.tuner.report import making
from tests.tuner.report.conftest import FREE, ROLLING
from tuner.cli import main
from tuner.config import ExportSettings
from tuner.core import disk
from tuner.core.disk import file_name, inside
from tuner.core.errors import InputError, OutputError
from tuner.exporters.export import export_formats_of_job
from tuner.report import render
from tuner.report.paper import write_plots
from tuner.report.section import Chart, Panel
from tuner.result import BEST_FIT_FILE
from tuner.vehicle import write_vehicle

__all__ = ["make_run"]

OUTSIDE = Path(tempfile.gettempdir()) / "tune-outside"
EVIL = ("..", "../", "/", "\\", "..\\", ".", "~", "C:", "\0", "\n", "\u202e", "-rf", "é", "x" * 300)
WORDS = (f"{OUTSIDE}/evil", "evil", "$HOME", "%2e%2e%2f", "*", "nul", ".bashrc", "a b")
NAMES = st.lists(st.sampled_from(EVIL + WORDS) | st.text(max_size=5), max_size=5).map("".join)
EXAMPLES = settings(
    max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)


@contextmanager
def nothing_outside(folder: Path):
    """Hold that what is written meanwhile lies in a folder, under plain names."""

    def elsewhere():
        beside = {p for p in folder.parent.rglob("*") if folder not in (p, *p.parents)}
        return beside | set(OUTSIDE.parent.glob(f"{OUTSIDE.name}*"))

    before, known = elsewhere(), set(folder.rglob("*"))
    yield
    assert elsewhere() == before
    made = {path.name for path in set(folder.rglob("*")) - known}
    assert [name for name in made if not re.fullmatch(r"\w[\w.-]{0,99}", name, re.ASCII)] == []


@given(NAMES | st.text(max_size=300), st.sampled_from(["", ".svg", ".params"]))
def test_a_file_s_name_is_plain_whatever_it_is_made_of(name, suffix):
    made = file_name(name, suffix)
    assert re.fullmatch(r"[A-Za-z0-9_][A-Za-z0-9_.-]*", made)
    assert len(made) <= disk.MAX_NAME_LETTERS
    assert made.endswith(suffix)
    assert file_name(made) == made or suffix


@given(st.lists(st.text("ab/. é", min_size=1, max_size=4), min_size=2, max_size=30, unique=True))
def test_two_names_are_two_files(names):
    assert len({file_name(name) for name in names}) == len(names)


@pytest.mark.parametrize("name", ["", ".", "..", "../x", "/etc/x", "a/../../x", "a\0b", "link/x"])
def test_what_leads_out_of_a_folder_is_refused(tmp_path, name):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "link").symlink_to(tmp_path)
    with pytest.raises(OutputError, match=r"leads out of .*; name a file inside it"):
        inside(tmp_path / "in", name)
    assert inside(tmp_path / "in", "plots/x.svg") == tmp_path / "in" / "plots" / "x.svg"


@EXAMPLES
@given(NAMES)
def test_exports_of_a_job_stay_in_its_folder(make_run, name):
    run = make_run()
    write_vehicle(run.vehicle.replace(name=name), run.folder / BEST_FIT_FILE)
    wanted = ExportSettings(formats=("yaml", "sdf", "px4"))
    with nothing_outside(run.folder):
        done = dict(
            export_formats_of_job(run.folder, wanted, refly=as_the_run_says, today=date(2024, 5, 6))
        )
    assert all(isinstance(path, Path) and path.exists() for path in done.values()), done


@settings(EXAMPLES, max_examples=10)
@given(NAMES)
def test_the_command_and_python_export_into_the_run_s_folder(make_run, capsys, name):
    run = make_run()
    write_vehicle(run.vehicle.replace(name=name), run.folder / BEST_FIT_FILE)
    with nothing_outside(run.folder):
        assert main(["export", str(run.folder), "--format", "yaml", "--accept", "a test"]) == 0
        tuner.export(run.folder, "px4", accept="a test")
    capsys.readouterr()
    assert {path.suffix for path in (run.folder / "export").iterdir()} >= {".yaml", ".params"}


@EXAMPLES
@given(NAMES)
def test_figures_of_flights_profiles_and_channels_stay_in_theirs(tmp_path, name):
    folder = tmp_path / "run"
    folder.mkdir(exist_ok=True)
    with nothing_outside(folder):
        write_plots([Chart(f"{name}_position", "", [Panel([])])], folder)


def test_a_page_about_hostile_flights_is_drawn_with_their_names(tmp_path, monkeypatch):
    names = ("../../evil", f"{OUTSIDE}/x")
    monkeypatch.setattr(making, "FLIGHTS", names)
    folder = tmp_path / "run"
    folder.mkdir()
    with nothing_outside(folder):
        making.write_run(folder, FREE, ROLLING)
        page = render(folder, plots=True).read_text()
    assert "../../evil (held out)" in page or "../../evil: position" in page
    (folder / "plots").rename(folder / "drawn")
    (folder / "plots").symlink_to(tmp_path)
    with nothing_outside(folder), pytest.raises(InputError, match="leads out of"):
        render(folder, plots=True)
