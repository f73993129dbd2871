"""This project in the comparisons: ``python -m benchmarks.contestants.ours kernel float32 4096``.

Likewise ``single``, one vehicle as `tune simulate` flies it; ``derivatives jacobian``, of 64
flights; ``fit jacobian``, of the four reference flights; and ``build jacobian``, which prints the
seconds to trace and to build with nothing kept.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from tuner.core import runtime

BUILD = "build"
runtime.configure(keep_compiled=sys.argv[1:2] != [BUILD])

import jax  # noqa: E402 (after the set-up)
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from jax import Array  # noqa: E402

from benchmarks.calibration import reference_job  # noqa: E402
from benchmarks.case import STEPS, Kernel, factors, fly  # noqa: E402
from benchmarks.simulator import FLIGHTS, GRADIENT, JACOBIAN, REVERSED, SAMPLES  # noqa: E402
from benchmarks.timing import answer  # noqa: E402
from tuner.config import TrajectorySettings  # noqa: E402
from tuner.core.shipped import configs_folder  # noqa: E402
from tuner.evaluate.closed_loop import simulate  # noqa: E402
from tuner.objective.criterion import Point  # noqa: E402
from tuner.search.progress import criterion_of, initial_progress  # noqa: E402
from tuner.search.stages import plan  # noqa: E402
from tuner.vehicle import ControllerFile, read_vehicle  # noqa: E402

STEPS_PER_RUN = 8_000_000
"""vehicle-steps a run, at least a tenth of a second."""
DURATION = 40.0
"""s that one vehicle flies."""


def kernel(precision: str, batch: str) -> None:
    vehicles = int(batch)
    samples = max(100, min(20_000, STEPS_PER_RUN // (vehicles * STEPS)))
    flight, factor = Kernel(precision), np.asarray(factors(vehicles))
    answer(
        lambda: flight(factor, samples=samples),
        vehicles * samples * STEPS,
        f"{precision}, a thread a core, log on the host",
    )


def single() -> None:
    controller = ControllerFile()
    vehicle = read_vehicle(configs_folder() / "vehicles" / "hovergames.yaml")
    lemniscate = TrajectorySettings(name="lemniscate")
    physics = controller.physics
    answer(
        lambda: list(simulate(vehicle, controller, lemniscate, duration=DURATION)),
        DURATION,
        f"physics at {physics.rate:g} Hz, {physics.integrator}, float64, signals included",
    )


def gradient(factor: Array) -> Array:
    """Return the gradient of each flight's sum of squares by its own factors, (12, flights)."""

    def loss(factor: Array) -> Array:
        squares = [jnp.sum(leaf * leaf) for leaf in jax.tree.leaves(fly(factor, samples=SAMPLES))]
        return sum(squares, jnp.zeros(()))

    slope: Array = jax.grad(loss)(factor)
    return slope


def derivatives(what: str) -> None:
    if what == GRADIENT:
        factor = factors(REVERSED)
        run = jax.jit(gradient).lower(factor).compile()
        memory = run.memory_analysis()
        assert memory is not None
        answer(
            lambda: jax.block_until_ready(run(factor)),
            REVERSED / FLIGHTS,
            f"{memory.temp_size_in_bytes}",
        )
        return
    flights, own = Kernel(moves=what == JACOBIAN), np.asarray(factors(FLIGHTS))
    answer(lambda: flights(own, samples=SAMPLES), 1.0)


def fit(what: str) -> None:
    objective = reference_job().objective
    rate = float(objective.schedule.log_rate)
    stage = plan("gradient", objective.samples, rate, windows=False, robust=True, steps=1)[-1]
    progress = initial_progress(objective, objective.space.initial[None])
    vector, offsets = (
        np.asarray(part[0]) for part in (progress.points.coefficients, progress.points.offsets)
    )
    criterion = criterion_of(stage, progress.scales, offsets)
    answer(
        lambda: objective.sums(Point(vector, offsets), criterion, derivatives=what == JACOBIAN),
        1.0,
        str(len(objective.space)),
    )


def build(what: str) -> None:
    began = time.perf_counter()
    if what == GRADIENT:
        lowered = jax.jit(gradient).lower(factors(8))
        traced = time.perf_counter()
        lowered.compile()
    else:
        program = Kernel(moves=what == JACOBIAN).program
        _ = program._traced
        traced = time.perf_counter()
        assert program.is_kernel
    print(traced - began, time.perf_counter() - traced)


if __name__ == "__main__":
    modes: dict[str, Callable[..., None]] = {
        "kernel": kernel,
        "single": single,
        "derivatives": derivatives,
        "fit": fit,
    }
    (modes | {BUILD: build})[sys.argv[1]](*sys.argv[2:])
