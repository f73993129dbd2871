"""One vehicle against real time."""

from __future__ import annotations

import sys

from benchmarks.table import Bar, Section, figure
from benchmarks.timing import Contestant, compete

ROUNDS = 25


def measure() -> Section:
    """Fly 40 s again and again."""
    command = (sys.executable, "-m", "benchmarks.contestants.ours", "single")
    (measured,) = compete([Contestant("one vehicle", command, {})], ROUNDS)
    assert measured.rate is not None, measured.remark
    rate = measured.rate
    return Section(
        "One vehicle against real time",
        f"A lemniscate of 40 s with all filters, logged at 100 Hz; {measured.remark}.",
        ["", "times real time"],
        [["tune simulate", f"{figure(rate.median)} ({figure(rate.low)}–{figure(rate.high)})"]],
        [Bar("one vehicle, 40 s at 400 Hz", rate.median, 2000, "at least", " × real time")],
    )
