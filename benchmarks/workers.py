"""One worker, two and four: folds of the reference flights, a night of jobs, trivial tasks."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks import work
from benchmarks.table import Bar, ResultSection, figure
from benchmarks.timing import ROOT
from tuner.config import resolve_settings
from tuner.core import runtime
from tuner.engine import Engine, engine_for

FOLDER = ROOT / "reference_flights"
TRIVIAL_TASKS = 10_000
JOBS, JOB = 400, 0.3
"""Of the simulated night: so many jobs, s of each on average."""
REPEATS = 3


def measure() -> ResultSection:
    """Cross-validate, simulate a night, and count what the scheduler does in a second."""
    runtime.configure()
    folds, tables = _cross_validation()
    nights = _nights()
    rows = [
        *(
            [f"folds, {name}", *map(figure, (f.seconds, f.busiest, f.threads, f.memory / 2**20))]
            for name, f in folds.items()
        ),
        *(
            [f"{JOBS} jobs of {JOB} s, {n} workers", figure(s), figure(model), "", ""]
            for n, (s, model, _) in nights.items()
        ),
        *(
            [f"{TRIVIAL_TASKS} trivial tasks, {n} workers", figure(s), "", "", ""]
            for n, (*_, s) in nights.items()
        ),
    ]
    gain = folds["one worker"].seconds / folds["two workers"].seconds
    return ResultSection(
        "Workers",
        "Cross-validation of the four fitted reference flights, warm, the least of "
        f"{REPEATS}: in this process on all its devices, and in workers of a core each. A night's "
        "jobs are waits that vary by a factor of two: what they take beside the model, the sum of "
        "their times divided by the workers, is the engine's. "
        f"Tables of all engines are {'the same' if len(set(tables)) == 1 else 'DIFFERENT'}.",
        ["", "s", "busiest worker's processor or model, s", "threads", "most MiB"],
        rows,
        [
            Bar("cross-validation, two workers over one", gain, 1.7, "at least", " times"),
            Bar("threads of a worker", folds["two workers"].threads, 40, "at most"),
            Bar(
                "trivial tasks in a second, two workers",
                TRIVIAL_TASKS / nights[2][2],
                100,
                "at least",
            ),
        ],
    )


@dataclass(frozen=True)
class _Folds:
    """A cross-validation: s, s of the busiest worker's processor, its threads, its bytes."""

    seconds: float
    busiest: float
    threads: float
    memory: float


def _processes(engine: Engine, workers: int) -> dict[float, dict[str, float]]:
    """Return process -> what it says of itself."""
    return {one["pid"]: one for one in engine.map(work.process, range(2 * workers))}


def _cross_validation() -> tuple[dict[str, _Folds], list[str]]:
    """Return engine -> its cross-validation, and every table."""
    from tuner.options import Options  # noqa: PLC0415 (jax is configured first)
    from tuner.search.estimation import search  # noqa: PLC0415
    from tuner.search.job_flights import read_recordings  # noqa: PLC0415
    from tuner.search.problem import job_of  # noqa: PLC0415
    from tuner.uncertainty.refits import CROSS_VALIDATION_FILE, cross_validate  # noqa: PLC0415

    settings = resolve_settings(Options([str(path) for path in sorted(FOLDER.glob("*.bag"))]))
    job = job_of(settings, read_recordings(settings)[0])
    found, tables = {}, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fitted = search(job, folder, resume=False, on_progress=lambda *_: None)
        for label, workers in (("here", None), ("one worker", 1), ("two workers", 2)):
            times, busy = [], []
            with engine_for(workers) as engine:
                for _ in range(REPEATS):
                    before = _processes(engine, workers or 1)
                    began = time.perf_counter()
                    cross_validate(job, fitted, folder, lambda _: None)
                    times.append(time.perf_counter() - began)
                    after = _processes(engine, workers or 1)
                    busy.append(
                        max(after[pid]["processor"] - before[pid]["processor"] for pid in after)
                    )
                    tables.append((folder / CROSS_VALIDATION_FILE).read_text())
            found[label] = _Folds(
                min(times),
                min(busy),
                max(one["threads"] for one in after.values()),
                max(one["memory"] for one in after.values()),
            )
    return found, tables


def _nights() -> dict[int, tuple[float, float, float]]:
    """Return workers -> s of a night's jobs, s that the model says, s of trivial tasks."""
    drawn = JOB * np.random.default_rng(0).uniform(0.5, 1.5, JOBS)
    found = {}
    for workers in (1, 2, 4):
        with engine_for(workers) as engine:
            engine.map(work.nothing, range(workers))
            began = time.perf_counter()
            engine.map(work.wait, [float(seconds) for seconds in drawn])
            night = time.perf_counter() - began
            began = time.perf_counter()
            engine.map(work.nothing, range(TRIVIAL_TASKS))
            trivial = time.perf_counter() - began
        found[workers] = (night, float(drawn.sum()) / workers, trivial)
    return found
