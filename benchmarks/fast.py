"""Fast flights, half of whose turning neither rotor speeds nor commands show: what is found.

Each vehicle of `benchmarks.fast_flights` is fitted from what scaling laws say of it. Seeds on which
nothing was chosen begin at 10.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from benchmarks import fast_flights
from benchmarks.table import Section, figure
from tuner.config import Options, resolve_settings
from tuner.equation_error.recorded_accelerations import Steps, steps_of
from tuner.equation_error.regression import convolved, summing
from tuner.job.run import run
from tuner.recordings.flight import Flight
from tuner.result import RunResult
from tuner.search.inlet_choice import regressors
from tuner.search.job_flights import read_recordings
from tuner.vehicle import VehicleFile

LABS: tuple[tuple[int, float, fast_flights.Fed], ...] = (
    (10, 400.0, "rotor_speed"),
    (11, 100.0, "rotor_speed"),
    (12, 400.0, "command"),
)
"""Seeds, and what is recorded of the rotors at how many Hz."""
SECONDS = 10.0
"""s of each flight."""
PHYSICAL = ("inertia_xx", "inertia_yy", "inertia_zz", "motor_constant", "moment_constant")
AHEAD = (0.1, 0.5)
"""s."""


def measure() -> Section:
    """Fit every laboratory, and hold what is found and predicted against the truth."""
    head = ["seed", "rotors", "fit", *PHYSICAL, "intervals that hold"]
    head += [
        f"{what} after {ahead:g} s" for ahead in AHEAD for what in ("fit", "regression", "hold")
    ]
    rows = []
    for seed, rate, fed in LABS:
        with tempfile.TemporaryDirectory() as name:
            cells = _row(seed, rate, fed, Path(name))
            rows.append([str(seed), f"{fed.replace('_', ' ')}, {rate:.0f} Hz", *cells])
    text = (
        "Coefficients over the truth, with half their 95 % interval; how many whose truth is known "
        "lie within theirs; and the mean error of body rate in rad/s of the two flights held "
        "out, predicted open loop from recorded states. *regression* is one line of least squares "
        "of angular acceleration on rotor torque, airspeed and rate times the rotors' speeds, and "
        "a steady part, added up along the recorded motion, where rotor speeds were recorded; "
        "*hold* lets the rate be."
    )
    return Section("Fast flights by rotor speed or command", text, head, rows)


def _row(seed: int, rate: float, fed: fast_flights.Fed, folder: Path) -> Iterator[str]:
    racer = fast_flights.drawn(seed)
    flown = fast_flights.fly(racer, seed=seed, seconds=SECONDS)
    paths = fast_flights.write(racer, flown, folder, seed=seed, rotor_rate=rate, fed=fed)
    options = Options([str(path) for path in paths], config=str(folder / "tune.yaml"))
    clock = time.perf_counter()
    _, result = run(options, out=folder / "run")
    yield f"{time.perf_counter() - clock:.0f} s"
    inside = []
    for name, truth in racer.values.items():
        found = result.coefficients.get(name)
        if found is None:  # a term that the flights do not call for
            continue
        if found.ci95 is not None:
            inside.append(found.ci95[0] <= truth <= found.ci95[1])
        if name in PHYSICAL:
            low, high = found.ci95 or (np.nan, np.nan)
            yield f"{found.best / truth:.3f} ± {0.5 * (high - low) / truth:.3f}"
    yield f"{sum(inside)} of {len(inside)}"
    recordings, _ = read_recordings(resolve_settings(options))
    fitted, held_out = ([r.flight for r in recordings if r.holdout is out] for out in (False, True))
    vehicle = resolve_settings(options).vehicle
    for ahead in AHEAD:
        yield figure(_predicted(result, "predicted_best", ahead))
        yield figure(_regression(fitted, held_out, vehicle, ahead)) if fed == "rotor_speed" else "–"
        yield figure(_predicted(result, "predicted_holding", ahead))


def _predicted(result: RunResult, which: str, ahead: float) -> float:
    """Return the mean error of held-out flights' body rate, rad/s."""
    errors = [
        predicted.body_rate
        for flight in result.flights
        for predicted in getattr(flight, which)
        if flight.split == "holdout" and predicted.seconds == ahead
    ]
    return float(np.mean(errors))


def _regression(
    fitted: list[Flight], held_out: list[Flight], vehicle: VehicleFile, ahead: float
) -> float:
    """Return the mean error of a plain regression's body rate, rad/s."""
    known, asked = (
        [part for flight in flights if (part := steps_of(flight)) is not None]
        for flights in (fitted, held_out)
    )
    errors = []
    for part in asked:
        left = [
            part.accelerations[:, 3 + axis]
            - regressors(part, vehicle)[axis] @ _weights(known, vehicle, axis)
            for axis in range(3)
        ]
        table = np.stack(left, axis=1)
        off = convolved(table, part.known, summing(part.step, ahead))
        errors.append(float(np.linalg.norm(off, axis=1).mean()))
    return float(np.mean(errors))


def _weights(known: list[Steps], vehicle: VehicleFile, axis: int) -> fast_flights.Numbers:
    columns = np.concatenate([regressors(part, vehicle)[axis][part.known] for part in known])
    turning = np.concatenate([part.accelerations[part.known, 3 + axis] for part in known])
    return np.asarray(np.linalg.lstsq(columns, turning, rcond=None)[0])
