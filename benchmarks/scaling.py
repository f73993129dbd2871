"""How the time grows with flights, with their length, and with a population of coefficients."""

from __future__ import annotations

import statistics
import time
from functools import partial

from benchmarks.table import Section, figure
from tuner import runtime

REPEATS = 3


def measure() -> Section:
    """Time Jacobians of growing jobs, and populations flown forward."""
    runtime.configure()
    import jax  # noqa: PLC0415 (after the set-up)

    from benchmarks.case import COEFFICIENTS, factors, fly  # noqa: PLC0415
    from benchmarks.contestants.derivatives import jacobian_of  # noqa: PLC0415
    from tuner.parallel import in_pieces, piece_that_fits, shared_among  # noqa: PLC0415

    devices = len(jax.devices())

    def timed(function: object, vehicles: int, piece: int) -> float:
        factor = factors(vehicles)
        run = jax.jit(shared_among(in_pieces(function, piece), devices)).lower(factor).compile()
        jax.block_until_ready(run(factor))
        times = []
        for _ in range(REPEATS):
            began = time.perf_counter()
            jax.block_until_ready(run(factor))
            times.append(time.perf_counter() - began)
        return statistics.median(times)

    in_turns = partial(in_pieces, piece=piece_that_fits(8, COEFFICIENTS))
    rows = []
    for flights in (16, 64, 256):
        flown = partial(fly, samples=500, arranged=in_turns)
        took = timed(partial(jacobian_of, flown), flights, flights)
        rows.append(
            [f"Jacobian, {flights} flights of 5 s", figure(took), figure(took / flights / 5 * 1e3)]
        )
    for length in (5, 20, 80):
        flown = partial(fly, samples=100 * length, arranged=in_turns)
        took = timed(partial(jacobian_of, flown), 16, 16)
        rows.append(
            [f"Jacobian, 16 flights of {length} s", figure(took), figure(took / 16 / length * 1e3)]
        )
    for population in (64, 512, 4096):
        took = timed(partial(fly, samples=500), population, piece_that_fits(8))
        rows.append(
            [f"population of {population}, 5 s", figure(took), figure(took / population / 5 * 1e3)]
        )
    return Section(
        "Scaling",
        "Median seconds of the yardstick's loop rates in float64, and milliseconds for each second "
        f"that one vehicle flies, which would stay the same if time grew in proportion; "
        f"{runtime.describe()}.",
        ["", "s", "ms a flown second"],
        rows,
    )
