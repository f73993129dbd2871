"""How the search fares on the shipped recordings when something is made hard for it.

    python examples/search_trials.py reference   # from the original coefficients
    python examples/search_trials.py starts      # from random starts in a box of a factor 3
    python examples/search_trials.py mass        # mass freed, which no flight identifies
    python examples/search_trials.py clock       # one recording's poses stamped 20 ms late
    python examples/search_trials.py noise       # one recording replaced by noise

Each prints one row of the README's table. With ``--workers N`` or ``--cluster FILE`` they are
computed side by side.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from tuner.core.runtime import configure

configure()

from tuner.config import Settings, resolve_settings  # noqa: E402 jax is configured first
from tuner.engine import Report, engine_for  # noqa: E402
from tuner.evaluate.validation import validate  # noqa: E402
from tuner.findings.findings import Code  # noqa: E402
from tuner.objective.criterion import OFFSET_UNIT  # noqa: E402
from tuner.options import Options  # noqa: E402
from tuner.recordings.flight import Flight, Series  # noqa: E402
from tuner.search.estimation import search  # noqa: E402
from tuner.search.job_flights import read_recordings  # noqa: E402
from tuner.search.problem import Job, job_of  # noqa: E402
from tuner.search.progress import Fit  # noqa: E402
from tuner.uncertainty.estimates import uncertainty_of  # noqa: E402
from tuner.uncertainty.verdict import direction_in_words, verdict_in_words  # noqa: E402
from tuner.vehicle import with_values  # noqa: E402 (jax is configured first)

FOLDER = Path(__file__).parents[1] / "reference_flights"
TIMES = ("time_constant_up", "time_constant_down", "estimate_latency", "actuator_latency")
BOX = 3.0
STARTS = 16
LATE = 0.020
SPOILT = "diagonal_3mps"


def settings_of(**options: object) -> Settings:
    """Return the settings of the shipped job, some of them changed."""
    changed = Options([str(path) for path in sorted(FOLDER.glob("*.bag"))], **options)  # type: ignore[arg-type]
    return resolve_settings(changed)


def truth() -> dict[str, float]:
    """Return the coefficients with which the recordings were flown."""
    return dict(yaml.safe_load((FOLDER / "truth.yaml").read_text()))


def solved(
    settings: Settings, change: Callable[[Flight], Flight] = lambda flight: flight
) -> tuple[Job, Fit, float]:
    """Return a job on changed recordings, its solution, and the s that the search took."""
    recordings = [replace(r, flight=change(r.flight)) for r in read_recordings(settings)[0]]
    job = job_of(settings, recordings)
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        fitted = search(job, Path(folder), resume=False, on_progress=lambda *_: None)
    return job, fitted, time.perf_counter() - began


def worst(job: Job, fitted: Fit) -> str:
    """Return how far the coefficients are from the truth."""
    true, values = truth(), job.space.numbers(fitted.point.coefficients)
    off = {name: abs(float(value) / true[name] - 1.0) for name, value in values.items()}
    mechanical = max((name for name in off if name not in TIMES), key=lambda name: off[name])
    lag = max(TIMES[:2], key=lambda name: off[name])
    latency = abs(float(values["estimate_latency"]) - true["estimate_latency"])
    return (
        f"{mechanical} {100 * off[mechanical]:.2f} % off, {lag} {100 * off[lag]:.1f} % off, "
        f"estimate latency {1e3 * latency:.3f} ms off"
    )


def reference() -> str:
    """Fit from the original coefficients, and fly the held-out flight."""
    job, fitted, seconds = solved(settings_of())
    flown = validate(job, fitted)
    (held,) = (r.flight for r in job.recordings if r.holdout)
    first, last = flown.initial[held.name].rmse, flown.best[held.name].rmse
    ratios = [getattr(first, axis) / getattr(last, axis) for axis in ("x", "y", "z")]
    place = ", ".join(f"{1e3 * getattr(last, axis):.2f}" for axis in ("x", "y", "z"))
    return (
        f"{worst(job, fitted)}; {held.name}, held out: {place} mm, "
        f"{min(ratios):.0f} to {max(ratios):.0f} times better; "
        f"{fitted.evaluations} Jacobians, {seconds:.0f} s"
    )


def starts() -> str:
    """Fit from random starts around the truth."""
    settings = settings_of()
    settings = replace(settings, vehicle=with_values(settings.vehicle, truth()))
    plan = settings.job.search.model_copy(
        update={"starts": 1 + STARTS, "spread": BOX, "method": "gradient"}
    )
    settings = replace(settings, job=settings.job.model_copy(update={"search": plan}))
    job, fitted, seconds = solved(settings)
    losses = np.array([outcome.loss for outcome in fitted.outcomes[1:]], float)
    reached = int((losses < 1.01 * np.nanmin(losses)).sum())
    return f"{reached} of {STARTS} reach the same minimum: {worst(job, fitted)}; {seconds:.0f} s"


def mass() -> str:
    """Free the mass, which scales with everything that carries or drags it."""
    settings = settings_of()
    free = tuple(name for name in truth() if name != "rolling_moment_coefficient")
    start = settings.vehicle.replace(mass=1.1 * settings.vehicle.mass)
    settings = replace(settings, vehicle=start, job=settings.job.model_copy(update={"free": free}))
    _, fitted, _ = solved(settings)
    uncertainty = uncertainty_of(fitted)
    verdict = verdict_in_words(uncertainty.estimates["mass"].verdict)
    return f"{verdict}: {direction_in_words(uncertainty.directions[0])}"


def clock() -> str:
    """Stamp one recording's poses late."""

    def late(flight: Flight) -> Flight:
        if flight.name != SPOILT:
            return flight
        series = dict(flight.series)
        for name in ("position", "velocity", "attitude"):
            series[name] = Series(series[name].time + LATE, series[name].values)
        return replace(flight, series=series)

    job, fitted, _ = solved(settings_of(), late)
    number = [flight.name for flight in job.fitted].index(SPOILT)
    late_by = float(fitted.point.offsets[0, number]) * OFFSET_UNIT
    others = np.delete(np.asarray(fitted.point.offsets[0]) * OFFSET_UNIT, number)
    return (
        f"{SPOILT} found {1e3 * late_by:.2f} ms late, the others at most "
        f"{1e3 * np.abs(others).max():.2f} ms: {worst(job, fitted)}"
    )


def noise() -> str:
    """Replace everything measured on one flight by noise as wide as what it measured."""
    generator = np.random.default_rng(0)

    def spoilt(flight: Flight) -> Flight:
        if flight.name != SPOILT:
            return flight
        series = dict(flight.series)
        for name in ("position", "body_rate", "rotor_speed", "command"):
            signal = series[name]
            recorded = np.where(np.isfinite(signal.values), signal.values, 0.0)
            white = generator.standard_normal(recorded.shape)
            drawn = recorded.mean(axis=0) + recorded.std(axis=0) * white
            series[name] = Series(signal.time, np.where(np.isfinite(signal.values), drawn, np.nan))
        turns = generator.standard_normal(series["attitude"].values.shape)
        turns /= np.linalg.norm(turns, axis=1, keepdims=True)
        series["attitude"] = Series(series["attitude"].time, turns)
        return replace(flight, series=series)

    job, fitted, _ = solved(settings_of(), spoilt)
    named = [f.subject for f in fitted.findings if f.code is Code.FLIGHT_UNMATCHED]
    return f"named: {', '.join(named)}; the others: {worst(job, fitted)}"


TRIALS = {trial.__name__: trial for trial in (reference, starts, mass, clock, noise)}


def trial(name: str, _report: Report) -> str:
    """Return a trial's row."""
    return f"| `python examples/search_trials.py {name}` | {TRIALS[name]()} |"


def main(words: list[str]) -> None:
    """Run the named trials, or all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--cluster")
    parser.add_argument("names", nargs="*", choices=[[], *TRIALS])
    asked = parser.parse_args(words)
    with engine_for(asked.workers, asked.cluster) as engine:
        for row in engine.stream(trial, asked.names or list(TRIALS)):
            print(row, flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
