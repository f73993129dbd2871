"""Timing of contestants in processes of their own, one run of each in turn."""

from __future__ import annotations

import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
REAL_FLIGHTS = Path(os.environ.get("TUNE_REAL_FLIGHTS", ROOT.parent / "shared" / "flights"))
"""Folders of real recordings, none of which is stored here."""
LAB_FLIGHTS = REAL_FLIGHTS.parent / "lab_flights"
"""Folders of simulated recordings with gusts and terms, likewise."""


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated measurements."""

    median: float
    low: float
    high: float

    @staticmethod
    def of(values: Sequence[float]) -> Spread:
        if len(values) < 2:
            return Spread(values[0], values[0], values[0])
        low, _, high = statistics.quantiles(values, n=4, method="inclusive")
        return Spread(statistics.median(values), low, high)

    def per(self, amount: float) -> Spread:
        """Return an amount over these times: a rate."""
        return Spread(amount / self.median, amount / self.high, amount / self.low)


@dataclass(frozen=True)
class Contestant:
    """A program that answers each line on its input by one run, and says how long that took.

    Attributes
    ----------
    command
        Prints ``ready AMOUNT REMARK`` when it has warmed up; then, for every line that it reads,
        the seconds of one run.
    settings
        What is set in its environment: threads above all.
    """

    name: str
    command: tuple[str, ...]
    settings: Mapping[str, str]


@dataclass(frozen=True)
class Throughput:
    """A contestant's result: amount per second, or why it could not take part."""

    name: str
    rate: Spread | None
    remark: str


class Running:
    """A contestant that has been started."""

    def __init__(self, contestant: Contestant) -> None:
        self.name, self.times = contestant.name, list[float]()
        self.process = subprocess.Popen(
            contestant.command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=tempfile.gettempdir(),  # some leave log files where they run
            env=environment(contestant.settings),
        )
        self.amount, self.remark = 0.0, ""

    def wait_until_ready(self) -> bool:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            word, _, rest = line.strip().partition(" ")
            if word == "ready":
                amount, _, self.remark = rest.partition(" ")
                self.amount = float(amount)
                return True
        assert self.process.stderr is not None
        last = self.process.stderr.read().strip().splitlines()[-1:] or ["ended without a word"]
        self.remark = f"could not take part: {last[0][:120]}"
        return False

    def run(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()
        self.times.append(float(self.process.stdout.readline()))

    def measured(self) -> Throughput:
        rate = Spread.of(self.times).per(self.amount) if self.times else None
        return Throughput(self.name, rate, self.remark)


def compete(contestants: Sequence[Contestant], rounds: int) -> list[Throughput]:
    """Let each run once in every round, so that what else the machine does meets all alike."""
    started: list[Running] = []
    ready: list[Running] = []
    try:
        for contestant in contestants:
            started.append(Running(contestant))
            if started[-1].wait_until_ready():
                ready.append(started[-1])
        for _ in range(rounds):
            for running in ready:
                running.run()
        return [running.measured() for running in started]
    finally:
        for running in started:
            running.process.terminate()
            running.process.communicate()


def answer(run: Callable[[], object], amount: float, remark: str = "") -> None:
    """Be a contestant: warm up, then run once for every line on the input."""
    run()
    print("ready", amount, remark, flush=True)
    for _ in sys.stdin:
        started = time.perf_counter()
        run()
        print(time.perf_counter() - started, flush=True)


def environment(settings: Mapping[str, str]) -> dict[str, str]:
    """Return the environment for a contestant: ours without settings for threads and jax."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if name not in {"NPROC", "XLA_FLAGS"} and not name.startswith(("JAX_", "OMP_"))
    }
    return kept | {"PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"} | dict(settings)


def machine() -> str:
    """Return one line on where this was measured."""
    model = platform.processor()
    cpuinfo = Path("/proc/cpuinfo")
    wide = ""
    if cpuinfo.exists():
        text = cpuinfo.read_text(errors="replace")
        model = next(
            (line.split(":")[1].strip() for line in text.splitlines() if "model name" in line),
            model,
        )
        wide = ", AVX-512" if " avx512f " in text else ""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    return (
        f"{model}, {os.cpu_count()} cores{wide}, {platform.system()}, Python "
        f"{platform.python_version()}; load average at the start {load:.1f}"
    )
