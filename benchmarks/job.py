"""From the command to the result, cold and warm; its memory; how soon the command line answers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path

from benchmarks.table import Bar, Section, figure, seconds
from benchmarks.timing import ROOT, Spread, environment
from tuner.cli.progress import SEARCHED

FOLDER = ROOT / "reference_flights"
FLIGHTS = [
    FOLDER / f"{name}.bag"
    for name in ("circle_3mps", "circle_4mps", "diagonal_3mps", "lemniscate_4mps")
]
TUNE = (sys.executable, "-c", "import sys; from tuner.cli import main; sys.exit(main())")
WARM, STARTS = 2, 5


@dataclass(frozen=True)
class Cost:
    """What a command costs: s to its end and to its first results (NaN without), bytes at most."""

    seconds: float
    memory: float
    first_results: float


def command(*arguments: str | Path, cache: Path) -> Cost:
    """Run ``tune`` and return what it costs."""
    began, first = time.perf_counter(), nan
    with subprocess.Popen(
        [*TUNE, *map(str, arguments)],
        stdout=subprocess.PIPE,
        text=True,
        cwd=cache,
        env=environment({"XDG_CACHE_HOME": str(cache), "PYTHONUNBUFFERED": "1"}),
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if line.startswith(SEARCHED[:20]):
                first = time.perf_counter() - began
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise SystemExit(f"tune {' '.join(map(str, arguments))} failed")
    return Cost(time.perf_counter() - began, usage.ru_maxrss * 1024.0, first)


def measure() -> Section:
    """Run the job in a cache of its own, then again."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cold = _fit(FLIGHTS, folder, "cold")
        warm = [_fit(FLIGHTS, folder, f"warm{i}") for i in range(WARM)]
        many = _fit(_copies(folder, 10), folder, "many")
        answers = Spread.of([command("--help", cache=folder).seconds for _ in range(STARTS)])
        inspects = Spread.of(
            [command("inspect", FLIGHTS[0], cache=folder).seconds for _ in range(STARTS)]
        )
    whole = Spread.of([run.seconds for run in warm])
    first = Spread.of([run.first_results for run in warm])
    gib = 2.0**30
    return Section(
        "From command to result",
        "The four reference flights from the original coefficients to converged, validated and "
        "reported, default settings. Cold: nothing cached, neither flights nor compiled code. Ten "
        "times as many flights are copies under other names, their shapes compiled anew. First "
        "results: the table of where the search ended.",
        ["", "s", "first results, s", "peak GiB"],
        [
            ["cold", *map(figure, (cold.seconds, cold.first_results, cold.memory / gib))],
            [f"warm, {WARM} runs", seconds(whole), seconds(first), ""],
            [
                "ten times as many flights",
                *map(figure, (many.seconds, many.first_results, many.memory / gib)),
            ],
            ["tune --help", seconds(answers), "", ""],
            ["tune inspect", seconds(inspects), "", ""],
        ],
        [
            Bar("tune on four flights, warm", whole.median, 12, "at most", " s"),
            Bar("tune on four flights, cold", cold.seconds, 35, "at most", " s"),
            Bar("first results, cold", cold.first_results, 20, "at most", " s"),
            Bar("peak memory", cold.memory / gib, 2, "at most", " GiB"),
            Bar("peak memory, ten times as many flights", many.memory / gib, 4, "at most", " GiB"),
            Bar("tune --help", answers.median, 0.3, "at most", " s"),
        ],
    )


def _fit(flights: Sequence[Path], folder: Path, name: str) -> Cost:
    return command("--flights", *flights, "--out", folder / name, cache=folder)


def _copies(folder: Path, times: int) -> list[Path]:
    copies = []
    for number in range(times):
        for flight in FLIGHTS:
            copies.append(folder / f"{flight.stem}_{number}.bag")
            shutil.copyfile(flight, copies[-1])
    return copies
