"""Prediction of flights that were each flown with a build of its own: later halves by earlier ones.

No flight of such a set can be held out and foretold by the others, whose mass, motors and
propellers differ. So the first half of each is fitted, from the shipped Crazyflie at the mass that
was weighed, and the second half is held out.
"""

from __future__ import annotations

import re
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from benchmarks.contest import STRIDE_S, Contest, rivals, simple_predictors
from tuner.config import Options, resolve_settings
from tuner.config.job import InletName, JobFile
from tuner.core.errors import InputError
from tuner.evaluate.prediction import Predictions, predict
from tuner.evaluate.validation import controller_flown, vehicle_fitted
from tuner.objective.inlets import INLETS
from tuner.recordings.flight import Flight, Series
from tuner.recordings.states import initial_state
from tuner.search.job_flights import read_recordings
from tuner.search.problem import job_of
from tuner.terms.selection import search_with_terms, with_first_terms
from tuner.uncertainty.identifiability import hold_undetermined

INLET: InletName = "actuator"
"""Motor commands follow from commanded thrust and torque."""


def contest_of(folder: Path) -> Contest:
    """Fit the first half of every flight of a set and predict the second.

    Raises
    ------
    InputError
        No flight of it can be used.
    """
    began = time.perf_counter()
    predictions: dict[str, list[Predictions]] = {}
    names, left_out = [], []
    for path in sorted(folder.glob("log*")):
        try:
            halves = _predicted(path, weighed_mass(path.with_name(f"info{path.stem[3:]}.yaml")))
        except InputError as error:
            left_out.append(f"{path.stem} takes no part: {error.what}.")
            continue
        names.append(path.stem)
        for predictor, of_flight in halves.items():
            predictions.setdefault(predictor, []).extend(of_flight)
    if not names:
        raise InputError(folder, " ".join(left_out) or "it holds no recording", "")
    return Contest(
        tuple(f"the second half of {name}" for name in names),
        f"the first halves of {len(names)} flights, each of a build of its own and by itself,",
        time.perf_counter() - began,
        predictions,
        " ".join(left_out),
    )


def weighed_mass(path: Path) -> float:
    """Return the mass in kg that stands beside a flight."""
    found = re.search(r"^mass: *([0-9.]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise InputError(path, "holds no mass", "write it as mass: 0.03")
    return float(found[1])


def _predicted(path: Path, mass: float) -> dict[str, list[Predictions]]:
    """Return each predictor's predictions of a flight's second half."""
    settings = resolve_settings(Options([str(path)], vehicle="crazyflie", mass=mass))
    settings = replace(settings, job=JobFile(inlet=INLET))
    (recording,), _ = read_recordings(settings)
    whole = recording.flight
    first, second = cut(whole, 0.0, 0.5), cut(whole, 0.5, 1.0)
    parts = (replace(recording, flight=first), replace(recording, flight=second, holdout=True))
    job = with_first_terms(job_of(settings, parts))
    with tempfile.TemporaryDirectory() as name:
        selected = search_with_terms(
            job, Path(name), resume=False, on_progress=lambda *_: None, on_message=lambda _: None
        )
        fitted, _ = hold_undetermined(
            selected.job, selected.fitted, lambda *_: None, lambda _: None
        )
    best = vehicle_fitted(selected.job, fitted)
    controller = controller_flown(selected.job, fitted)
    predictions = {
        label: [predict(vehicle, controller, second, INLET, stride=STRIDE_S, observer=observer)]
        for label, vehicle, observer in rivals(
            settings.vehicle, best, controller, [(first, INLET, 0.0)]
        )
    }
    signal = INLETS[INLET].needs[0]
    return simple_predictors([first], [second], signal, predictions["fitted"]) | predictions


def cut(flight: Flight, begin: float, end: float) -> Flight:
    """Return a stretch of a flight, from one share of its duration to another.

    Samples from up to two seconds before it are kept, as before a mission.
    """
    first, last = begin * flight.duration, end * flight.duration
    inside = (flight.time >= first) & (flight.time <= last)
    first = float(flight.time[inside][0])
    series = {}
    for name, recorded in flight.series.items():
        near = (recorded.time >= first - 2.0) & (recorded.time <= last)
        series[name] = Series(recorded.time[near] - first, recorded.values[near])
    return replace(
        flight,
        name=f"{flight.name}_{begin:g}_{end:g}",
        time=flight.time[inside] - first,
        signals={name: values[inside] for name, values in flight.signals.items()},
        series=series,
        initial=initial_state(series),
    )
