"""What a run shows while it works, where standard output is no terminal."""

import io
import re
from pathlib import Path
from types import SimpleNamespace

from rich.console import Console

from tuner.cli.progress import STAGE_PHRASES, _LiveLine, progress_on_terminal
from tuner.core.spans import span, watching
from tuner.findings.findings import Code, Finding
from tuner.search.listener import Iteration, PointEstimate

MESSAGE = "Examining [how well] each coefficient is known, of which there are many." * 4


def iterations(stage, count, first=1):
    return [
        Iteration(
            stage=stage,
            number=number,
            loss=1.0 / number,
            position_rmse=0.1 / number,
            accepted=True,
            horizon=2.0,
            damping=None if stage == "2 s" else 0.5,
        )
        for number in range(first, first + count)
    ]


def lines_of(capsys):
    """Return what was printed, without the seconds before each line."""
    return [re.sub(r"^ *\d+ s  ", "", line) for line in capsys.readouterr().out.splitlines()]


def test_a_stage_is_one_line_and_a_search_ends_with_its_last_iteration(capsys):
    with progress_on_terminal(quiet=False) as listener:
        listener.on_settings(SimpleNamespace(origin={"mass": "--mass"}))
        with span("reading"):
            pass
        with span("search"):
            for iteration in (*iterations("2 s", 30), *iterations("whole flights", 60, first=31)):
                listener.on_iteration(iteration, 12.0)
        listener.on_message(MESSAGE)
        with span("examination"), span("reading"):
            pass
    assert lines_of(capsys) == [
        "Reading the flights",
        "Searching, and compiling its first steps",
        "Searched: whole flights: iteration 90, horizon 2 s, position RMSE 1.11 mm, loss 0.01111",
        "Examining how well each coefficient is known",
    ]


def test_verbose_shows_settings_messages_and_where_the_search_ended(capsys):
    estimate = PointEstimate(name="inertia_xx", unit="kg m²", initial=0.021, estimate=0.0265)
    with progress_on_terminal(quiet=False, verbose=True) as listener:
        listener.on_settings(SimpleNamespace(origin={"mass": "--mass"}))
        listener.on_iteration(iterations("polish", 1)[0], 1.0)
        listener.on_estimates([estimate])
        listener.on_message(MESSAGE)
    origin, stage, head, row, searched, message = lines_of(capsys)
    assert origin == "mass: --mass"
    assert stage.startswith("Searched: polish: ")
    assert searched.startswith("The search ended here. ")
    assert head.split() == ["coefficient", "initial", "estimate", "unit"]
    assert row.split() == ["inertia_xx", "0.021", "0.0265", "kg", "m²"]
    assert message == MESSAGE


def test_an_interrupted_search_still_gets_its_line_and_says_how_to_go_on(capsys):
    with progress_on_terminal(quiet=False) as listener:
        for iteration in iterations("2 s", 3):
            listener.on_iteration(iteration, 12.0)
        listener.on_stop("Continue with --resume.")
    stage, go_on = lines_of(capsys)
    assert "2 s: iteration 3," in stage
    assert go_on == "Continue with --resume."


def test_another_vehicle_than_the_one_that_flew_is_named_before_the_search(capsys):
    with progress_on_terminal(quiet=False) as listener:
        listener.on_doubt(Finding(Code.MASS_NOT_GIVEN, "warning", "quad", {"mass": 2.0}))
    (line,) = lines_of(capsys)
    assert line.startswith("! quad: Its 2 kg are the shipped file's")
    assert line.endswith("Give what it weighs at take-off with --mass.")


def test_quiet_shows_nothing(capsys):
    with progress_on_terminal(quiet=True) as listener:
        listener.on_iteration(iterations("2 s", 1)[0], 1.0)
        listener.on_message("Examining.")
    assert capsys.readouterr().out == ""


def test_a_terminal_names_the_stage_that_runs_and_promises_nothing():
    shown = Console(file=io.StringIO(), force_terminal=True, width=120)
    line = _LiveLine(shown)

    def now():
        return line.__rich__().plain

    try:
        assert now().startswith("Starting, 0 s")
        with watching(line.stage), span("search"):
            assert now().startswith("Searching")
            line.show(iterations("polish", 1)[0])
            assert now().startswith("polish: iteration 1")
            assert "left" not in now()
            with span("examination"):
                assert now().startswith("Examining how well")
            with span("a new stage"):
                assert now().startswith("A new stage")
            assert now().startswith("Searching")
        with span("reading"):  # nobody watches any more
            assert now().startswith("Starting")
    finally:
        line.close()


def test_every_stage_of_a_run_has_its_words():
    named = {
        name
        for folder in ("job", "recordings")
        for path in Path("tuner", folder).glob("*.py")
        for name in re.findall(r'(?:span|reporter\.attempt)\(\s*"([^"]+)"', path.read_text())
    }
    assert len(named) > 10
    assert named <= set(STAGE_PHRASES)
