"""The scatter of fits in gusts: many draws of gusts, one vehicle, the right model.

The reference flights' plan is flown by this project's own simulator at the reference truth, in
gusts, with measurement noise; fitted by least squares of the simulated flights and, from there,
with what pushed them. Seeds are those of gusts and noise alone. ``TUNE_GUSTS_DRAWS`` sets are
drawn, in ``TUNE_GUSTS_WORKERS`` processes beside this one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import yaml

from benchmarks.calibration import fitted, problem, reference_job
from benchmarks.simulated_recordings import SimulatedFlights, simulate_like
from benchmarks.table import Bar, Section, figure
from benchmarks.timing import ROOT
from tuner.engine import Report, engine_for
from tuner.search.problem import Job
from tuner.terms.candidates import Selected
from tuner.terms.refit_with_disturbances import with_disturbances
from tuner.uncertainty.estimates import Estimate

DRAWS = int(os.environ.get("TUNE_GUSTS_DRAWS", "20"))
WORKERS = int(os.environ.get("TUNE_GUSTS_WORKERS", "0")) or None

BARS = {
    "inertia_xx": 0.025,
    "inertia_yy": 0.025,
    "inertia_zz": 0.025,
    "time_constant_up": 0.025,
    "time_constant_down": 0.025,
    "motor_constant": 0.001,
}
"""Shares of the truth by which the estimates of 20 draws may spread."""


@dataclass(frozen=True)
class Draw:
    """The estimates from a set of flights.

    Attributes
    ----------
    simulated
        Coefficient -> value, by least squares of the simulated flights.
    followed
        Coefficient -> estimate with what pushed them; None where that was not kept.
    seconds
        Of processor time: of least squares, and of the rest.
    """

    simulated: Mapping[str, float]
    followed: Mapping[str, Estimate] | None
    seconds: tuple[float, float]

    @property
    def values(self) -> Mapping[str, float]:
        """What the run would give."""
        if self.followed is None:
            return self.simulated
        return {name: estimate.value for name, estimate in self.followed.items()}


def measure() -> Section:
    """Fly and fit every draw."""
    draws = []
    with engine_for(WORKERS) as engine:
        for seed, draw in enumerate(engine.stream(_task, range(DRAWS))):
            draws.append(draw)
            print(_line(seed, draw), flush=True)
    return section(draws)


def _task(seed: int, _: Report) -> Draw:
    return fly_and_fit(seed)


def truth() -> dict[str, float]:
    """Return the reference flights' coefficients."""
    text = (ROOT / "reference_flights" / "truth.yaml").read_text(encoding="utf-8")
    return {name: float(value) for name, value in yaml.safe_load(text).items()}


def fly_and_fit(seed: int) -> Draw:
    """Fly the reference vehicle in the gusts of a seed, and fit it."""
    clock = [time.process_time()]
    objective = problem(terms=False, narrowed=1.0)
    vector = objective.space.vector_of(truth())
    flown = simulate_like(objective, vector, np.random.default_rng([seed, 7]), gusts=True)
    if flown is None:
        raise SystemExit(f"the vehicle crashed in the gusts of seed {seed}")
    found = fitted(flown.objective)
    clock.append(time.process_time())
    again = with_disturbances(Selected(_job(flown), found), lambda *_: None, lambda _: None)
    clock.append(time.process_time())
    return Draw(
        simulated=flown.objective.space.numbers(found.point.coefficients),
        followed=None if again is None else again[2].uncertainty.estimates,
        seconds=(clock[1] - clock[0], clock[2] - clock[1]),
    )


def _job(flown: SimulatedFlights) -> Job:
    """Return the reference flights' job with set-points as they were flown."""
    job = reference_job()
    flights = iter(flown.with_setpoints(job.fitted))
    recordings = tuple(
        recording if recording.holdout else replace(recording, flight=next(flights))
        for recording in job.recordings
    )
    asked = replace(job.settings, job=job.settings.job.replace(disturbances="follow"))
    return replace(job, settings=asked, recordings=recordings, objective=flown.objective)


def section(draws: Sequence[Draw]) -> Section:
    """Return the table of the scatter."""
    known, kept = truth(), [draw.followed for draw in draws if draw.followed is not None]
    rows, bars = [], []
    for name in kept[0]:
        true = known[name]
        plain, run = (
            np.array([values[name] for values in sets]) / true - 1.0
            for sets in ([draw.simulated for draw in draws], [draw.values for draw in draws])
        )
        noise = [(followed[name].parts.noise or 0.0) / true for followed in kept]
        half = [np.diff(followed[name].ci95)[0] / 2.0 / true for followed in kept]
        held = sum(followed[name].ci95[0] <= true <= followed[name].ci95[1] for followed in kept)
        spreads = np.std(plain, ddof=1), np.std(run, ddof=1), np.median(noise), np.median(half)
        shares = [float(spread) for spread in spreads]
        rows.append(
            [
                name,
                f"{100 * plain.mean():+.2f} %",
                f"{figure(100 * shares[0])} %",
                f"{100 * run.mean():+.2f} %",
                *(f"{figure(100 * share)} %" for share in shares[1:]),
                f"{held} of {len(kept)}",
            ]
        )
        if name in BARS:
            what = f"spread of {name} over draws of gusts"
            bars.append(Bar(what, 100 * shares[1], 100 * BARS[name], "at most", " %"))
    plain, rest = np.mean([draw.seconds for draw in draws], axis=0)
    text = (
        f"{len(draws)} draws of gusts of 0.1 m/s and of thrusts that wander by 0.4 %, each flown "
        "by this project's own simulator, by the reference vehicle on the reference flights' plan "
        "(four fitted flights, the spin held level), with measurement noise; every fit has the "
        "right model. Least squares of the simulated flights, and the same with what pushed them "
        f"followed, which {len(kept)} fits keep. Spread: standard deviation from draw to draw, as "
        "a share of the truth; quoted: the median of the error's part `noise`, and of the 95 % "
        f"interval's half-width. {plain:.0f} s of processor time for least squares, {rest:.0f} s "
        "for the rest and both examinations."
    )
    head = ["coefficient", "least squares, mean", "spread", "followed, mean", "spread"]
    head += ["quoted for noise", "95 % interval ±", "hold the truth"]
    return Section("Draws of gusts", text, head, rows, bars)


def _line(seed: int, draw: Draw) -> str:
    """Return a draw in a line, as soon as it is there."""
    known = truth()
    off = ", ".join(
        f"{name} {100 * (draw.simulated[name] / known[name] - 1):+.2f} → "
        f"{100 * (draw.values[name] / known[name] - 1):+.2f} %"
        for name in BARS
    )
    end = ", not followed" if draw.followed is None else ""
    return f"{seed}: {off}; {draw.seconds[0]:.0f} + {draw.seconds[1]:.0f} s{end}"
