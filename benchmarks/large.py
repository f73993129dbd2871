"""Time and memory of an iteration of a fit to many flights, with a figure."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

from benchmarks.table import Bar, ResultSection, figure
from benchmarks.timing import ROOT, environment

FLIGHTS = (25, 50, 100, 200)
PICTURE = Path(__file__).with_name("large.png")
GIB = 2.0**30


def measure() -> ResultSection:
    """Iterate on growing numbers of flights, each in a process of its own."""
    module = "benchmarks.contestants.large"
    found = {}
    for flights in FLIGHTS:
        done = subprocess.run(
            [sys.executable, "-m", module, str(flights)],
            stdout=subprocess.PIPE,
            text=True,
            check=True,
            cwd=ROOT,
            env=environment({}),
        )
        seconds, memory = (float(word) for word in done.stdout.split())
        found[flights] = (seconds, memory)
    draw(found, PICTURE)
    return section(found)


def section(found: Mapping[int, tuple[float, float]]) -> ResultSection:
    """Return the table of flights -> processor seconds of an iteration, and bytes at most."""
    rows = [
        [str(flights), figure(seconds), figure(1e3 * seconds / flights), figure(memory / GIB)]
        for flights, (seconds, memory) in found.items()
    ]
    fewest, most = min(found), max(found)
    growth = (found[most][0] / most) / (found[fewest][0] / fewest)
    return ResultSection(
        "Many flights",
        "An iteration of a search by 20 coefficients, two latencies among them, on simulated "
        "flights of 40 s at 400 Hz, all of them whole: loss, gradient, Hessian and step. Processor "
        "seconds on both cores, the better of two, and the most memory that its process had, "
        "reading and simulating the recordings included.\n\n"
        f"![Time and memory against the number of flights]({PICTURE.name})",
        ["flights", "processor s", "ms a flight", "peak GiB"],
        rows,
        [
            Bar(f"peak memory, {most} flights of 40 s", found[most][1] / GIB, 6, "at most", " GiB"),
            Bar(
                f"an iteration, {most} flights over {fewest}",
                growth,
                1.2,
                "at most",
                " times a flight's",
            ),
        ],
    )


def draw(found: Mapping[int, tuple[float, float]], to: Path) -> None:
    """Draw both against the number of flights, beside what would be in proportion."""
    from matplotlib.figure import Figure  # noqa: PLC0415 (a second to import)

    flights = list(found)
    picture = Figure(figsize=(8.0, 3.2), layout="constrained")
    time, memory = picture.subplots(1, 2)
    slope = found[flights[-1]][0] / flights[-1]
    time.plot(flights, [slope * n for n in flights], "--", color="0.6", label="in proportion")
    time.plot(flights, [seconds for seconds, _ in found.values()], "o-", label="measured")
    time.set_ylabel("an iteration [processor s]")
    time.legend()
    memory.plot(flights, [size / GIB for _, size in found.values()], "o-")
    memory.axhline(6.0, ls=":", color="0.4")
    memory.annotate("bar", (flights[0], 6.0), xytext=(0, -12), textcoords="offset points")
    memory.set_ylabel("peak memory [GiB]")
    for axes in (time, memory):
        axes.set_xlabel("flights of 40 s")
        axes.set_xlim(0)
        axes.set_ylim(0)
        axes.grid(alpha=0.3)
    picture.savefig(to, dpi=110)
