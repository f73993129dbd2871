"""What a run shows while it works, where standard output is no terminal."""

import io
import re
from pathlib import Path
from types import SimpleNamespace

from rich.console import Console

from tuner.cli.progress import DOING, _MovingLine, listening
from tuner.core.spans import span, watching
from tuner.search.iteration import Iteration
from tuner.search.point_estimate import PointEstimate

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


def test_a_stage_is_one_line_with_its_last_iteration(capsys):
    with listening(quiet=False) as listener:
        listener.on_settings(SimpleNamespace(origin={"mass": "--mass"}))
        for iteration in (*iterations("2 s", 30), *iterations("whole flights", 60, first=31)):
            listener.on_iteration(iteration, 12.0)
        listener.on_message(MESSAGE)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4
    assert lines[0] == "mass: --mass"
    assert lines[1].startswith("2 s: iteration 30, horizon 2 s, position RMSE 3.33 mm")
    assert lines[2].startswith("whole flights: iteration 90, ")
    assert lines[3] == MESSAGE


def test_where_the_search_ended_is_a_table_after_its_last_stage(capsys):
    estimate = PointEstimate(name="inertia_xx", unit="kg m²", initial=0.021, estimate=0.0265)
    with listening(quiet=False) as listener:
        listener.on_iteration(iterations("polish", 1)[0], 1.0)
        listener.on_estimates([estimate])
        listener.on_message("Examining.")
    stage, head, row, searched, message = capsys.readouterr().out.splitlines()
    assert stage.startswith("polish: ")
    assert searched.startswith("The search ended here. ")
    assert head.split() == ["coefficient", "initial", "estimate", "unit"]
    assert row.split() == ["inertia_xx", "0.021", "0.0265", "kg", "m²"]
    assert message == "Examining."


def test_an_interrupted_stage_still_gets_its_line(capsys):
    with listening(quiet=False) as listener:
        for iteration in iterations("2 s", 3):
            listener.on_iteration(iteration, 12.0)
    assert capsys.readouterr().out.count("2 s: iteration 3,") == 1


def test_quiet_shows_nothing(capsys):
    with listening(quiet=True) as listener:
        listener.on_iteration(iterations("2 s", 1)[0], 1.0)
        listener.on_message("Examining.")
    assert capsys.readouterr().out == ""


def test_a_terminal_names_the_stage_that_runs_and_promises_nothing():
    shown = Console(file=io.StringIO(), force_terminal=True, width=120)
    line = _MovingLine(shown)

    def now():
        return line.__rich__().plain

    try:
        assert now().startswith("Starting, 0 s")
        with watching(line.stage), span("search"):
            assert now().startswith("Searching")
            line.show(iterations("polish", 1)[0], 4.0)
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
        for name in re.findall(r'(?:span|explanation\.part)\(\s*"([^"]+)"', path.read_text())
    }
    assert len(named) > 10
    assert named <= set(DOING)
