"""Every `tune` command of every page, run in the order in which it stands, prints what it shows.

Where a page's own flights take minutes, short ones lie under their names.
"""

from __future__ import annotations

import re
import shutil
import webbrowser
from pathlib import Path

import pytest

from tests.docs.pages import (
    DOCS,
    PAGES,
    ROOT,
    TUTORIALS,
    WITH_COMMANDS,
    Family,
    blocks,
    commands,
    expanded,
    figures,
    in_the_text,
    is_whole,
    name_of,
)
from tests.docs.recorded import write_lab, write_logs, write_nanobench
from tuner.cli import main
from tuner.cli.app import COMMANDS
from tuner.cli.results import print_run
from tuner.report.contents import read_contents
from tuner.report.page import sections_of
from tuner.report.paper import plot_file
from tuner.result import read_run

pytestmark = pytest.mark.slow

SHARED = "tune --flights reference_flights/*.bag --out runs/first"
"""The fit of ``make demo``, which is made once for all tests, to the flights that ship."""
FIT = "tune --flights lab/*.bag --holdout circle_4mps --mass 2.243 --out runs/first"
"""The fit of ``tune --help``, whose result the commands that stand by themselves look at."""
BESIDE = [page for page in WITH_COMMANDS if page not in TUTORIALS and commands(page, Family.TUNE)]
"""What else shows commands: they stand by themselves, in a lab that has what they name."""
RUN: set[str] = set()
"""What was run: what two pages show is run for one of them."""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with what a reader has at the root of the project, and recordings."""
    place = tmp_path_factory.mktemp("lab")
    for name in ("examples", "configs", "docs"):
        (place / name).symlink_to(ROOT / name)
    (place / "runs").mkdir()
    write_lab(place / "reference_flights")
    shutil.copy(ROOT / "reference_flights" / "tune.yaml", place / "reference_flights")
    for folder in ("lab", "fleet/quad_0001"):
        (place / folder).mkdir(parents=True)
        for path in (place / "reference_flights").glob("*.bag"):
            (place / folder / path.name.replace("circle_3mps", "circle")).symlink_to(path)
    write_logs(place / "logs")
    write_nanobench(place / "nanobench")
    return place


@pytest.fixture(scope="module")
def workplace(lab: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the same with finished runs, models and a bench, under the names of the pages."""
    place = tmp_path_factory.mktemp("workplace")
    shutil.copytree(lab, place, symlinks=True, dirs_exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(place)
        assert main(expanded(FIT)) == 0
    RUN.add(same(FIT))
    for name in ("demo", "x"):
        shutil.copytree(place / "runs" / "first", place / "runs" / name)
    for model in ("model.sdf", "models/quad.sdf", "models/x500/model.sdf"):
        (place / model).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "examples" / "models" / "quad_x_gz.sdf", place / model)
    for file in (ROOT / "examples" / "bench").iterdir():
        shutil.copy(file, place)
    shutil.copy(ROOT / "configs" / "vehicles" / "hovergames_updated.yaml", place / "quad.yaml")
    for name in ("quad", "x500"):
        (place / f"{name}.params").write_text("1\t1\tMC_ROLLRATE_P\t0.15\t9\n", "utf-8")
    meant = {"FLIGHT": "lab/circle.bag", "F": "lab/circle.bag", "V": "quad.yaml", "RUN": "runs/x"}
    for placeholder, path in meant.items():
        (place / placeholder).symlink_to(place / path)
    (place / "FILE").symlink_to(place / "nanobench" / "B2_circle_slow_rep1.csv")
    return place


@pytest.fixture
def place(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a lab of one's own, and be there."""
    shutil.copytree(lab, tmp_path, symlinks=True, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", [p for p in TUTORIALS if commands(p, Family.TUNE)], ids=name_of)
def test_a_tutorial_runs_and_prints_what_it_shows(
    page: Path, place: Path, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    if SHARED in commands(page):
        shutil.rmtree(place / "reference_flights")
        (place / "reference_flights").symlink_to(ROOT / "reference_flights")
    for line in commands(page, Family.TUNE):
        if line == SHARED:
            shutil.copytree(request.getfixturevalue("demo")[0], place / "runs" / "first")
            print_run(place / "runs" / "first", read_run(place / "runs" / "first").result)
        else:
            assert main(expanded(line)) == 0, line
        RUN.add(same(line))
    printed = capsys.readouterr().out
    for block in blocks(page, "text"):
        for shown in block.splitlines():
            assert is_printed(shown, printed), shown
    folders = [path.parent for path in place.glob("runs/*/report.html")]
    if not set(figures(page)) <= _drawn(folders):
        folders = [request.getfixturevalue("demo")[0]]
    assert set(figures(page)) <= _drawn(folders)


def same(line: str) -> str:
    """Return a command without the folder that a fit is written to: it is no other fit.

    And with one name of the workplace's one run, whose page is rendered, and of its recordings.
    """
    line = re.sub(r"^tune report (RUN|runs/demo)\b", "tune report runs/x", line)
    line = line.replace("fleet/quad_0001/", "lab/").removesuffix(" --quiet")
    return re.sub(r"^(tune --flights .*) --out \S+", r"\1", line)


def _drawn(folders: list[Path]) -> set[str]:
    """Return the files of the figures of some result folders' pages."""
    return {
        plot_file(folder, chart).name
        for folder in folders
        for section in sections_of(read_contents(folder))
        for chart in section.charts
    }


def is_printed(line: str, printed: str) -> bool:
    """Return whether a line was printed, whatever its numbers, widths and line ends."""
    return wording(line) in wording(printed)


def wording(text: str) -> str:
    return re.sub(r"[\s\d.e+-]+", " ", text).strip()


@pytest.mark.parametrize("page", BESIDE, ids=name_of)
def test_commands_beside_the_tutorials_run(
    page: Path, workplace: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(workplace)
    monkeypatch.setattr(webbrowser, "open", lambda _: True)
    for line in commands(page, Family.TUNE):
        for name in COMMANDS if "COMMAND" in line else [""]:
            typed = line.replace("COMMAND", name)
            if typed.startswith("tune new-vehicle"):
                (workplace / "quad.yaml").unlink(missing_ok=True)  # it replaces none
            if same(typed) not in RUN:
                assert main(expanded(typed)) == 0, typed
            RUN.add(same(typed))


@pytest.mark.parametrize("page", [p for p in PAGES if blocks(p, "python")], ids=name_of)
def test_its_python_runs(page: Path, workplace: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(workplace)
    (block,) = blocks(page, "python")
    exec(compile(block, page.name, "exec"), {})


def test_what_is_named_in_a_text_has_its_options() -> None:
    reference = (DOCS / "reference" / "commands.md").read_text(encoding="utf-8")
    sections = dict(re.findall(r"^## (tune.*)\n((?:(?!## ).*\n?)*)", reference, re.MULTILINE))
    fragments = {span for page in PAGES for span in in_the_text(page) if not is_whole(span)}
    assert len(fragments) > 10
    for span in fragments:
        words = [word for word in span.split() if word != "…"]
        options = sections["tune" if words[1].startswith("-") else " ".join(words[:2])]
        assert {f"`{word}`" for word in words if word.startswith("--")} <= set(options.split())


def test_every_command_is_shown() -> None:
    shown = {
        line.split()[1]
        for page in WITH_COMMANDS
        for line in commands(page)
        if line.startswith("tune ")
    }
    assert set(COMMANDS) <= shown
