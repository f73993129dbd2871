"""Speed of the simulator: batches beside peers, derivatives, one vehicle, and building programs."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.table import Bar, ResultSection, figure, millions, seconds
from benchmarks.timing import ROOT, Contestant, Spread, compete, environment
from tuner.core import runtime

OURS = (sys.executable, "-m", "benchmarks.contestants.ours")
ROUNDS = 11
BATCHES = (1, 256, 4096)
HERE = Path(__file__).parent / "contestants"
ONE_THREAD = {"NPROC": "1"}
"""The fastest setting of the jax peers: XLA's threads slow small kernels down."""
FLIGHTS, SAMPLES, REVERSED = 64, 2000, 8
FORWARD, JACOBIAN, GRADIENT = "forward", "jacobian", "gradient"
STEPS = REVERSED * SAMPLES * 10
ROUNDS_OF_ONE = 25
BUILDS = 2
"""Fresh processes that build each program."""


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
        Contestant(f"tune, {p}", (*OURS, "kernel", p, batch), {}) for p in ("float32", "float64")
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


def throughput() -> ResultSection:
    """Measure vehicle-steps a second against the size of a batch, beside peers and a yardstick."""
    with tempfile.TemporaryDirectory() as folder:
        yardstick = _yardstick(Path(folder))
        results = {batch: compete(contestants(batch, yardstick), ROUNDS) for batch in BATCHES}
    names = [result.name for result in results[BATCHES[0]]]
    rates = {
        (batch, result.name): None if result.rate is None else result.rate.median
        for batch, measured in results.items()
        for result in measured
    }

    def remark(number: int) -> str:
        return results[4096][number].remark.replace("|", "/").replace(",xla_", ", xla_")

    rows = [
        [name, *(millions(results[batch][i].rate) for batch in BATCHES), remark(i)]
        for i, name in enumerate(names)
    ]

    def ratio(batch: int, ours: str, other: str) -> float | None:
        mine, theirs = rates.get((batch, ours)), rates.get((batch, other))
        return None if mine is None or theirs is None else mine / theirs

    single, double = "tune, float32", "tune, float64"
    bars = [
        Bar(what, ratio(batch, ours, other), limit, "at least", unit)
        for what, batch, ours, other, limit, unit in (
            ("4096 vehicles, float32, of the C++ yardstick", 4096, single, "C++, float32", 0.8, ""),
            ("4096 vehicles, float64, of the C++ yardstick", 4096, double, "C++, float64", 0.8, ""),
            ("one vehicle, float32, of the scalar yardstick", 1, single, "C++, float32", 0.12, ""),
            ("one vehicle, float64, of the scalar yardstick", 1, double, "C++, float64", 0.12, ""),
            ("4096 vehicles, of drone-models' dynamics", 4096, single, "drone-models", 8, " ×"),
            ("4096 vehicles, of crazyflow's attitude loop", 4096, single, "crazyflow", 25, " ×"),
            ("4096 vehicles, of MuJoCo C", 4096, single, "MuJoCo C", 60, " ×"),
        )
    ]
    return ResultSection(
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


def derivatives() -> ResultSection:
    """Measure Jacobian and gradient of 64 flights in units of one forward run of them."""
    measured = {
        contestant.name: contestant
        for contestant in compete(
            [
                Contestant(what, (*OURS, "derivatives", what), {})
                for what in (FORWARD, JACOBIAN, GRADIENT)
            ],
            ROUNDS,
        )
    }
    loss, jacobian = (
        _time(contestant.rate)
        for contestant in compete(
            [Contestant(what, (*OURS, "fit", what), {}) for what in ("loss", JACOBIAN)], ROUNDS
        )
    )
    times = {name: _time(contestant.rate) for name, contestant in measured.items()}
    memory = float(measured[GRADIENT].remark)
    base = times[FORWARD].median
    rows = [
        *([name, seconds(times[name]), figure(times[name].median / base)] for name in measured),
        ["reference flights: loss", seconds(loss), "1"],
        ["reference flights: jacobian", seconds(jacobian), figure(jacobian.median / loss.median)],
    ]
    return ResultSection(
        "Derivatives of 64 flights",
        f"{FLIGHTS} flights of {SAMPLES / 100:g} s at 1 kHz, 13 states logged at 100 Hz, float64, "
        "a thread a core, the log on the host. The Jacobian is by 12 coefficients that all flights "
        "share, forward mode, by a kernel; the gradient by 12 coefficients of each flight, reverse "
        f"mode, by XLA on one core, of {REVERSED} flights and counted for {FLIGHTS}. Below, the "
        "four reference flights as a search has them, latencies, filters and clocks included: "
        "their loss, and with it gradient and Hessian by 12 coefficients.",
        ["", "s", "forward runs"],
        rows,
        [
            Bar(
                "Jacobian of 12 coefficients over 64 flights",
                times[JACOBIAN].median / base,
                9,
                "at most",
                " forward runs",
            ),
            Bar(
                "Jacobian of the four reference flights",
                jacobian.median / loss.median,
                9,
                "at most",
                " forward runs",
            ),
            Bar(
                "temporary memory of the reverse gradient",
                memory / STEPS,
                20,
                "at most",
                " bytes a vehicle-step",
            ),
        ],
    )


def _time(rate: Spread | None) -> Spread:
    assert rate is not None
    return Spread(1 / rate.median, 1 / rate.high, 1 / rate.low)


def one_vehicle() -> ResultSection:
    """Measure one vehicle against real time."""
    (measured,) = compete([Contestant("one vehicle", (*OURS, "single"), {})], ROUNDS_OF_ONE)
    assert measured.rate is not None, measured.remark
    rate = measured.rate
    return ResultSection(
        "One vehicle against real time",
        f"A lemniscate of 40 s with all filters, logged at 100 Hz; {measured.remark}.",
        ["", "times real time"],
        [["tune simulate", f"{figure(rate.median)} ({figure(rate.low)}–{figure(rate.high)})"]],
        [Bar("one vehicle, 40 s at 400 Hz", rate.median, 2000, "at least", " × real time")],
    )


def compilation() -> ResultSection:
    """Measure the seconds to build programs in fresh processes, nothing kept from earlier."""
    rows, compiled = [], {}
    for what in (FORWARD, JACOBIAN, GRADIENT):
        pairs = []
        for _ in range(BUILDS):
            done = subprocess.run(
                [*OURS, "build", what],
                capture_output=True,
                text=True,
                check=True,
                cwd=ROOT,
                env=environment({"JAX_ENABLE_COMPILATION_CACHE": "false"}),
            )
            pairs.append([float(word) for word in done.stdout.split()])
        traced, compiled[what] = (Spread.of([pair[i] for pair in pairs]) for i in (0, 1))
        rows.append([what, seconds(traced), seconds(compiled[what])])
    return ResultSection(
        "Building programs",
        "Seconds in a fresh process with nothing kept: what jax traces in Python, then what is "
        "written as LLVM IR and compiled. The gradient, in reverse mode, is compiled by XLA. The "
        "cache in the user's folder spares the compiling from the second run on.",
        ["", "trace", "build"],
        rows,
        [
            Bar("build, forward", compiled["forward"].median, 1, "at most", " s"),
            Bar("build, Jacobian", compiled["jacobian"].median, 3, "at most", " s"),
        ],
    )
