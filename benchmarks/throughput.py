"""Vehicle-steps a second against the size of a batch, beside peers and the yardstick."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.table import Bar, Section, millions
from benchmarks.timing import Contestant, Measured, compete
from tuner.core import runtime

BATCHES = (1, 256, 4096)
ROUNDS = 11
HERE = Path(__file__).parent / "contestants"
ONE_THREAD = {"NPROC": "1"}
"""The fastest setting of the jax peers: XLA's threads slow small kernels down."""


def _yardstick(folder: Path) -> Path | None:
    """Build the hand-written program, if its source and a compiler are at hand."""
    source = os.environ.get("TUNE_YARDSTICK")
    compiler = shutil.which("g++")
    if not source or compiler is None:
        return None
    program = folder / "yardstick"
    flags = ["-O3", "-march=native", "-ffast-math", "-fopenmp", "-std=c++17", "-w"]
    built = subprocess.run(
        [compiler, *flags, f"-I{source}", str(HERE / "yardstick.cpp"), "-o", str(program)],
        check=False,
    )
    return program if built.returncode == 0 else None


def contestants(vehicles: int, yardstick: Path | None) -> list[Contestant]:
    """Return who takes part with a batch of so many."""
    cores, batch = str(runtime.cores()), str(vehicles)
    peers = os.environ.get("TUNE_PEERS", sys.executable)
    module = "benchmarks.contestants."
    all_contestants = [
        Contestant(f"tune, {p}", (sys.executable, "-m", module + "ours", "kernel", p, batch), {})
        for p in ("float32", "float64")
    ]
    if yardstick is not None:
        all_contestants += [
            Contestant(
                f"C++, {p}", (str(yardstick), p, batch, cores), {"OMP_WAIT_POLICY": "passive"}
            )
            for p in ("float32", "float64")
        ]
    all_contestants += [
        Contestant("drone-models", (peers, "-m", module + "drone_models", batch), ONE_THREAD),
        Contestant("crazyflow", (peers, "-m", module + "crazyflow", batch), ONE_THREAD),
        Contestant("MuJoCo C", (peers, "-m", module + "mujoco", batch, cores), {}),
    ]
    return all_contestants


def measure() -> Section:
    """Run the comparison."""
    with tempfile.TemporaryDirectory() as folder:
        yardstick = _yardstick(Path(folder))
        results = {batch: compete(contestants(batch, yardstick), ROUNDS) for batch in BATCHES}
    names = [result.name for result in results[BATCHES[0]]]
    rates = {
        (batch, result.name): None if result.rate is None else result.rate.median
        for batch, measured in results.items()
        for result in measured
    }
    rows = [
        [name, *(millions(results[batch][i].rate) for batch in BATCHES), _remark(results[4096][i])]
        for i, name in enumerate(names)
    ]

    def ratio(batch: int, ours: str, other: str) -> float | None:
        mine, theirs = rates.get((batch, ours)), rates.get((batch, other))
        return None if mine is None or theirs is None else mine / theirs

    single, double = "tune, float32", "tune, float64"
    bars = [
        Bar(
            "4096 vehicles, float32, of the C++ yardstick",
            ratio(4096, single, "C++, float32"),
            0.8,
            "at least",
        ),
        Bar(
            "4096 vehicles, float64, of the C++ yardstick",
            ratio(4096, double, "C++, float64"),
            0.8,
            "at least",
        ),
        Bar(
            "one vehicle, float32, of the scalar yardstick",
            ratio(1, single, "C++, float32"),
            0.12,
            "at least",
        ),
        Bar(
            "one vehicle, float64, of the scalar yardstick",
            ratio(1, double, "C++, float64"),
            0.12,
            "at least",
        ),
        Bar(
            "4096 vehicles, of drone-models' dynamics",
            ratio(4096, single, "drone-models"),
            8,
            "at least",
            " ×",
        ),
        Bar(
            "4096 vehicles, of crazyflow's attitude loop",
            ratio(4096, single, "crazyflow"),
            25,
            "at least",
            " ×",
        ),
        Bar("4096 vehicles, of MuJoCo C", ratio(4096, single, "MuJoCo C"), 60, "at least", " ×"),
    ]
    return Section(
        "Throughput against the size of a batch",
        "Millions of vehicle-steps a second, median and quartiles of "
        f"{ROUNDS} runs in turn. For tune and the yardstick a step is one of 1 kHz physics with "
        "rate control at 250 Hz, position control and a log of 13 states at 100 Hz; those of peers "
        "hold less, as listed. The jax peers run with NPROC=1, MuJoCo and the yardstick with a "
        "thread a core, as tune does; the log of all is in the memory of the host.",
        ["", *(f"batch {batch}" for batch in BATCHES), "settings"],
        rows,
        bars,
    )


def _remark(measured: Measured) -> str:
    return measured.remark.replace("|", "/").replace(",xla_", ", xla_")
