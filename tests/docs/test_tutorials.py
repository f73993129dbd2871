"""The tutorials as a reader follows them: their commands run in order, their output is theirs."""

from __future__ import annotations

import re
import shlex
import shutil
import webbrowser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tuner
from tests.docs.pages import DOCS, PAGES, ROOT, TUTORIALS, blocks, commands, figures
from tests.docs.px4_logs import write_logs
from tuner.cli import main
from tuner.cli.results import print_run
from tuner.evaluate.write import write_flights
from tuner.report.contents import read_contents
from tuner.report.page import sections_of
from tuner.report.paper import plot_file
from tuner.result import read_run

pytestmark = pytest.mark.slow

#: Beginnings of commands that take minutes; they are run with the tests that do.
LONG = (
    "tune --flights lab/*.bag --bench runs/bench",
    "tune sensitivity --flights reference_flights/circle_3mps.bag",
    "tune --flights reference_flights/*.bag --cross-validate",
    "tune --flights fleet/",
    "tune --flights reference_flights/*.bag --config runs/quad.job.yaml",
)
#: One that needs flights which do not ship with the project; `tests.tuner.job.test_real_flights`
#: runs it where they are.
ELSEWHERE = "tune --flights nanobench/*.csv"
LENGTHY = ("missing-terms",)
"""Tutorials with a search of their own that takes minutes."""
FOLLOWED = [
    pytest.param(page, id=page.stem, marks=pytest.mark.long if page.stem in LENGTHY else ())
    for page in TUTORIALS
    if page.stem != "service"
]
"""All but the one that needs a server, see `tests.docs.test_service_tutorial`."""
SHARED = "tune --flights reference_flights/*.bag --out runs/first"
"""The fit of ``make demo``, which is made once for all tests."""


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with what a reader has at the root of the project, who is there."""
    for name in ("reference_flights", "examples", "configs", "docs"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "runs").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def words_of(command: str) -> list[str]:
    """Return a command's arguments, patterns expanded as a shell does."""
    words = []
    for word in shlex.split(command, comments=True)[1:]:
        found = sorted(map(str, Path().glob(word))) if "*" in word else []
        words += found or [word]
    return words


@pytest.mark.parametrize("page", FOLLOWED)
def test_its_commands_run_and_print_what_it_shows(
    page: Path, place: Path, request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]
) -> None:
    if page.stem == "px4-without-mocap":
        write_logs(place / "logs")
    for line in commands(page):
        if line == SHARED:
            shutil.copytree(request.getfixturevalue("demo")[0], place / "runs" / "first")
            print_run(place / "runs" / "first", read_run(place / "runs" / "first").result)
        elif not line.startswith((*LONG, ELSEWHERE)):
            assert main(words_of(line)) == 0, line
    printed = capsys.readouterr().out
    for block in blocks(page, "text"):
        for shown in block.splitlines():
            assert is_printed(shown, printed), shown
    folders = [path.parent for path in place.glob("runs/*/report.html")]
    if not set(figures(page)) <= _drawn(folders):
        folders = [request.getfixturevalue("demo")[0]]
    assert set(figures(page)) <= _drawn(folders)


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


def test_the_python_of_the_reference_runs(place: Path, request: pytest.FixtureRequest) -> None:
    (place / "runs" / "first").symlink_to(request.getfixturevalue("demo")[0])
    (block,) = blocks(DOCS / "reference" / "python.md", "python")
    exec(compile(block, "python.md", "exec"), {})


TO_A_SERVER = ("submit", "jobs", "watch", "fetch", "cancel", "watch-folder")
"""Commands that `tests.docs.test_service_tutorial` runs against one."""
IN_MINUTES = (
    *("tune --flights", "tune sensitivity", "tune serve --"),
    "tune export runs/x --format isaaclab",  # flies a hundred draws
)
BESIDE = [page for page in PAGES if page not in TUTORIALS and commands(page)]
"""Pages beside the tutorials that show commands."""


@pytest.fixture
def workplace(place: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with a lab's flights, models, bench and finished runs, under their names."""
    monkeypatch.setattr(webbrowser, "open", lambda _: True)
    for name in ("x", "demo"):
        shutil.copytree(request.getfixturevalue("demo")[0], place / "runs" / name)
    (place / "lab").mkdir()
    (place / "lab" / "circle.bag").symlink_to(ROOT / "reference_flights" / "circle_3mps.bag")
    for model in ("model.sdf", "models/quad.sdf", "models/x500/model.sdf"):
        (place / model).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / "examples" / "models" / "quad_x_gz.sdf", place / model)
    for file in (ROOT / "examples" / "bench").iterdir():
        shutil.copy(file, place)
    shutil.copy(ROOT / "configs" / "vehicles" / "hovergames_updated.yaml", place / "quad.yaml")
    for name in ("quad", "x500"):
        (place / f"{name}.params").write_text("1\t1\tMC_ROLLRATE_P\t0.15\t9\n", "utf-8")
    return place


@pytest.mark.parametrize("page", BESIDE, ids=lambda page: page.stem)
def test_commands_beside_the_tutorials_run(page: Path, workplace: Path) -> None:
    for line in commands(page):
        if not line.startswith(IN_MINUTES) and line.split()[1] not in TO_A_SERVER:
            assert main(words_of(line.replace("/srv", str(workplace)))) == 0, line


@pytest.mark.long
@pytest.mark.parametrize("start", LONG, ids=lambda start: start.split()[2])
def test_a_command_that_takes_minutes_runs(start: str, place: Path) -> None:
    ((page, line),) = [
        (page, line) for page in TUTORIALS for line in commands(page) if line.startswith(start)
    ]
    (flight,) = tuner.simulate("circle", speed=3.0, duration=12.0)
    volts = np.full((len(flight.time), 1), 16.0)  # the bench's vehicle counts on a voltage
    recorded = replace(flight, signals={**flight.signals, "battery_voltage": volts})
    for folder in (place / "lab", place / "fleet" / "quad_0001"):
        folder.mkdir(parents=True)
        write_flights([recorded], folder / "circle.bag")
    before = commands(page)[: commands(page).index(line)]
    for needed in (words for words in before if not words.startswith((*LONG, SHARED))):
        assert main(words_of(needed)) == 0, needed
    assert main(words_of(line)) == 0


def test_what_is_not_followed_is_still_there() -> None:
    every = [line for page in TUTORIALS for line in commands(page)]
    for start in (*LONG, ELSEWHERE):
        assert any(line.startswith(start) for line in every), start
    assert SHARED in every
