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

from benchmarks.lab_flights import drawn, write
from benchmarks.table import Bar, ResultSection, figure, seconds
from benchmarks.timing import LAB_FLIGHTS, REAL_FLIGHTS, ROOT, Spread, environment

FOLDER = ROOT / "reference_flights"
FLIGHTS = [
    FOLDER / f"{name}.bag"
    for name in ("circle_3mps", "circle_4mps", "diagonal_3mps", "lemniscate_4mps")
]
TUNE = (sys.executable, "-c", "import sys; from tuner.cli import main; sys.exit(main())")
WARM, STARTS = 2, 5
SEARCH_LINE = " s  Searched: "
"""In the line that a pipe gets when the search has ended, and a terminal its first table."""
SEEDS = 0, 1
"""Of laboratories, every other one of which has gusts."""


@dataclass(frozen=True)
class RecordedSet:
    """Recordings that are not stored here, and the limit of their fit with nothing cached.

    Attributes
    ----------
    arguments
        Of `tune`, beside the flights.
    limit
        s by the clock, or of processor time in gusts.
    """

    folder: Path
    flights: str
    arguments: tuple[str | Path, ...]
    limit: float
    in_gusts: bool = False

    def bar(self, cost: Cost) -> Bar:
        if self.in_gusts:
            name = f"processor time, {self.folder.name}"
            return Bar(name, cost.processor, self.limit, "at most", " s")
        return Bar(f"tune on {self.folder.name}", cost.seconds, self.limit, "at most", " s")

    def fit(self, folder: Path) -> Cost:
        cache = folder / self.folder.name
        cache.mkdir()
        return _fit(sorted(self.folder.glob(self.flights)), cache, "fit", *self.arguments)


def _in_gusts(name: str, limit: float) -> RecordedSet:
    folder = LAB_FLIGHTS / name
    arguments = "--config", folder / "tune.yaml", "--holdout", "yaw_spin_3rps"
    return RecordedSet(folder, "*.bag", arguments, limit, in_gusts=True)


CRAZYFLIE = "--config", ROOT / "configs" / "jobs" / "crazyflie.yaml"
RECORDED = (
    _in_gusts("gusts_only", 60.0),
    _in_gusts("terms_and_gusts", 100.0),
    RecordedSet(
        REAL_FLIGHTS / "nanobench",
        "*.csv",
        (*CRAZYFLIE, "--holdout", "B2_circle_slow_rep1", "B3_figure8_medium_rep1"),
        20.0,
    ),
    RecordedSet(REAL_FLIGHTS / "crazyswarm", "log[12]??", ("--vehicle", "crazyflie"), 40.0),
)


@dataclass(frozen=True)
class Cost:
    """The cost of a command: s to its end, of processor time, to its first results (or NaN).

    And bytes at most.
    """

    seconds: float
    memory: float
    first_results: float
    processor: float

    def row(self, name: str) -> list[str]:
        numbers = self.seconds, self.processor, self.first_results, self.memory / 2.0**30
        return [name, *map(figure, numbers)]


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
            if SEARCH_LINE in line:
                first = time.perf_counter() - began
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if status:
        raise SystemExit(f"tune {' '.join(map(str, arguments))} failed")
    processor = usage.ru_utime + usage.ru_stime
    return Cost(time.perf_counter() - began, usage.ru_maxrss * 1024.0, first, processor)


def measure() -> ResultSection:
    """Run the job in a cache of its own, then again."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cold = _fit(FLIGHTS, folder, "cold")
        warm = [_fit(FLIGHTS, folder, f"warm{i}") for i in range(WARM)]
        other, gusty = (_laboratory(folder, seed) for seed in SEEDS)
        many = _fit(_copies(folder, 10), folder, "many")
        sets = [(one, one.fit(folder)) for one in RECORDED if one.folder.is_dir()]
        answers = Spread.of([command("--help", cache=folder).seconds for _ in range(STARTS)])
        inspects = Spread.of(
            [command("inspect", FLIGHTS[0], cache=folder).seconds for _ in range(STARTS)]
        )
    whole = Spread.of([run.seconds for run in warm])
    first = Spread.of([run.first_results for run in warm])
    gib = 2.0**30
    return ResultSection(
        "From command to result",
        "The four reference flights from the original coefficients to converged, validated and "
        "reported, default settings. Cold: nothing cached, neither flights nor code. Then two "
        "simulated laboratories of the same plan whose flights were never read, the second in "
        "gusts. Ten times as many flights are copies under other names. Sets by name are "
        "recordings that are not stored here, each with nothing cached. First results: the "
        "table of where the search ended. The figures' own process is not in the processor time.",
        ["", "s", "of processor time", "first results, s", "peak GiB"],
        [
            cold.row("cold"),
            [f"warm, {WARM} runs", seconds(whole), "", seconds(first), ""],
            other.row("another laboratory"),
            gusty.row("a laboratory with gusts"),
            many.row("ten times as many flights"),
            *(cost.row(one.folder.name) for one, cost in sets),
            ["tune --help", seconds(answers), "", "", ""],
            ["tune inspect", seconds(inspects), "", "", ""],
        ],
        [
            Bar("tune on four flights, warm", whole.median, 12, "at most", " s"),
            Bar("tune on four flights, cold", cold.seconds, 20, "at most", " s"),
            Bar("first results, cold", cold.first_results, 6, "at most", " s"),
            Bar("another laboratory", other.seconds, 15, "at most", " s"),
            Bar("processor time, a laboratory with gusts", gusty.processor, 100, "at most", " s"),
            Bar("peak memory, a laboratory with gusts", gusty.memory / gib, 1.5, "at most", " GiB"),
            Bar("peak memory", cold.memory / gib, 2, "at most", " GiB"),
            Bar("peak memory, ten times as many flights", many.memory / gib, 4, "at most", " GiB"),
            Bar("tune --help", answers.median, 0.3, "at most", " s"),
            *(one.bar(cost) for one, cost in sets),
        ],
    )


def _fit(flights: Sequence[Path], folder: Path, name: str, *options: str | Path) -> Cost:
    return command("--flights", *flights, *options, "--out", folder / name, cache=folder)


def _laboratory(folder: Path, seed: int) -> Cost:
    place = folder / f"laboratory{seed}"
    place.mkdir()
    return _fit(write(drawn(seed), place, seed=seed), folder, f"fit{seed}")


def _copies(folder: Path, times: int) -> list[Path]:
    copies = [folder / f"{path.stem}_{number}.bag" for number in range(times) for path in FLIGHTS]
    for number, copy in enumerate(copies):
        shutil.copyfile(FLIGHTS[number % len(FLIGHTS)], copy)
    return copies
