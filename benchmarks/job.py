"""From the command to the result, cold and warm; its memory; how soon the command line answers."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.table import Bar, Section, figure, seconds
from benchmarks.timing import ROOT, Spread, environment

FOLDER = ROOT / "reference_flights"
FLIGHTS = [
    FOLDER / f"{name}.bag"
    for name in ("circle_3mps", "circle_4mps", "diagonal_3mps", "lemniscate_4mps")
]
TUNE = (sys.executable, "-c", "import sys; from tuner.cli import main; sys.exit(main())")
WARM, STARTS = 2, 5


def command(*arguments: str | Path, cache: Path) -> tuple[float, float]:
    """Run ``tune``; return its seconds and its greatest memory in bytes."""
    began = time.perf_counter()
    process = subprocess.Popen(
        [*TUNE, *map(str, arguments)],
        stdout=subprocess.DEVNULL,
        cwd=cache,
        env=environment({"XDG_CACHE_HOME": str(cache)}),
    )
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"tune {' '.join(map(str, arguments))} failed")
    return time.perf_counter() - began, usage.ru_maxrss * 1024.0


def measure() -> Section:
    """Run the job in a cache of its own, then again."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        cold, memory = _fit(FLIGHTS, folder, "cold")
        warm = Spread.of([_fit(FLIGHTS, folder, f"warm{i}")[0] for i in range(WARM)])
        many_time, many_memory = _fit(_copies(folder, 10), folder, "many")
        answers = Spread.of([command("--help", cache=folder)[0] for _ in range(STARTS)])
        inspects = Spread.of(
            [command("inspect", FLIGHTS[0], cache=folder)[0] for _ in range(STARTS)]
        )
    gib = 2.0**30
    return Section(
        "From command to result",
        "The four reference flights from the original coefficients to converged, validated and "
        "reported, default settings. Cold: nothing cached, neither flights nor compiled code. Ten "
        "times as many flights are copies under other names, their shapes compiled anew.",
        ["", "s", "peak GiB"],
        [
            ["cold", figure(cold), figure(memory / gib)],
            [f"warm, {WARM} runs", seconds(warm), ""],
            ["ten times as many flights", figure(many_time), figure(many_memory / gib)],
            ["tune --help", seconds(answers), ""],
            ["tune inspect", seconds(inspects), ""],
        ],
        [
            Bar("tune on four flights, warm", warm.median, 12, "at most", " s"),
            Bar("tune on four flights, cold", cold, 35, "at most", " s"),
            Bar("peak memory", memory / gib, 2, "at most", " GiB"),
            Bar("peak memory, ten times as many flights", many_memory / gib, 4, "at most", " GiB"),
            Bar("tune --help", answers.median, 0.3, "at most", " s"),
        ],
    )


def _fit(flights: Sequence[Path], folder: Path, name: str) -> tuple[float, float]:
    return command("--flights", *flights, "--out", folder / name, "--quiet", cache=folder)


def _copies(folder: Path, times: int) -> list[Path]:
    copies = []
    for number in range(times):
        for flight in FLIGHTS:
            copies.append(folder / f"{flight.stem}_{number}.bag")
            shutil.copyfile(flight, copies[-1])
    return copies
