"""One worker, two and four: folds of the reference flights, a night of jobs, trivial tasks."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks import work
from benchmarks.table import Bar, Section, figure
from benchmarks.timing import ROOT
from tuner import runtime
from tuner.engine import engine_for

FOLDER = ROOT / "reference_flights"
TRIVIAL = 10_000
JOBS, JOB = 400, 0.3
"""Of the simulated night: so many jobs, s of each on average."""
REPEATS = 3


def measure() -> Section:
    """Cross-validate, simulate a night, and count what the scheduler does in a second."""
    runtime.configure()
    folds, tables = _cross_validation()
    nights = _nights()
    rows = [
        *(
            [f"folds, {name}", figure(s), "", figure(t), figure(m / 2**20)]
            for name, (s, t, m) in folds.items()
        ),
        *(
            [f"{JOBS} jobs of {JOB} s, {n} workers", figure(s), figure(model), "", ""]
            for n, (s, model, _) in nights.items()
        ),
        *(
            [f"{TRIVIAL} trivial tasks, {n} workers", figure(s), "", "", ""]
            for n, (*_, s) in nights.items()
        ),
    ]
    gain = folds["one worker"][0] / folds["two workers"][0]
    return Section(
        "Workers",
        "Cross-validation of the four fitted reference flights, warm, the least of "
        f"{REPEATS}: in this process on all its devices, and in workers of a core each. A night's "
        "jobs are waits that vary by a factor of two: what they take beside the model, the sum of "
        "their times divided by the workers, is the engine's. "
        f"Tables of all engines are {'the same' if len(set(tables)) == 1 else 'DIFFERENT'}.",
        ["", "s", "model, s", "threads of a worker", "most MiB of a worker"],
        rows,
        [
            Bar("cross-validation, two workers over one", gain, 1.7, "at least", " times"),
            Bar("threads of a worker", folds["two workers"][1], 40, "at most"),
            Bar(
                "trivial tasks in a second, two workers",
                TRIVIAL / nights[2][2],
                100,
                "at least",
            ),
        ],
    )


def _cross_validation() -> tuple[dict[str, tuple[float, float, float]], list[str]]:
    """Return engine -> least s, threads and bytes of a worker; and every table."""
    from tuner.config import Options, settle  # noqa: PLC0415 (jax is configured first)
    from tuner.job.cross_validation import CROSS_VALIDATION_FILE, cross_validate  # noqa: PLC0415
    from tuner.job.prepare import job_of  # noqa: PLC0415
    from tuner.job.search import search  # noqa: PLC0415
    from tuner.recordings import read_recordings  # noqa: PLC0415

    settings = settle(Options([str(path) for path in sorted(FOLDER.glob("*.bag"))]))
    job = job_of(settings, read_recordings(settings))
    found, tables = {}, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fitted = search(job, folder, resume=False, on_progress=lambda *_: None)
        for label, workers in (("here", None), ("one worker", 1), ("two workers", 2)):
            times = []
            with engine_for(workers) as engine:
                for _ in range(REPEATS):
                    began = time.perf_counter()
                    cross_validate(job, fitted, folder, lambda _: None)
                    times.append(time.perf_counter() - began)
                    tables.append((folder / CROSS_VALIDATION_FILE).read_text())
                processes = engine.map(work.process, range(2 * (workers or 1)))
            found[label] = (
                min(times),
                max(one["threads"] for one in processes),
                max(one["memory"] for one in processes),
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
            engine.map(work.nothing, range(TRIVIAL))
            trivial = time.perf_counter() - began
        found[workers] = (night, float(drawn.sum()) / workers, trivial)
    return found
