"""Open-loop prediction of real flights that were not fitted, against simpler predictors.

Every set of recordings in the folder of real flights is fitted by ``tune`` itself, two of its
flights held out; these are then predicted from every recorded state. No recording is stored here.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks import builds, without_pose
from benchmarks.contest import COMPARED_STEPS, STRIDE_S, Contest, rivals, simple_predictors
from benchmarks.table import Section, figure
from benchmarks.timing import ROOT
from tuner.config import Options, resolve_settings
from tuner.core.errors import InputError
from tuner.evaluate.prediction import Predictions, predict
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.job.run import run
from tuner.objective.inlets import INLETS
from tuner.result import BEST_FIT_FILE, RunResult
from tuner.search.job_flights import read_recordings
from tuner.vehicle import ControllerFile, read_vehicle

FLIGHTS = Path(os.environ.get("TUNE_REAL_FLIGHTS", ROOT.parent / "shared" / "flights"))
JOBS: Mapping[str, str] = {"nanobench": "crazyflie"}
"""Set -> shipped job file, where it holds no ``tune.yaml`` of its own."""
HELD_OUT: Mapping[str, tuple[str, ...]] = {
    "nanobench": ("B2_circle_slow_rep1", "B3_figure8_medium_rep1")
}
"""Set -> flights that are held out; of another set the last two of four or more."""


def measure() -> Section:
    """Fit and predict every set that is there."""
    head = [
        "set",
        "predictor",
        "steps",
        *(f"{name} [{unit}]" for name, unit in PREDICTED_UNITS.items()),
    ]
    rows: list[list[str]] = []
    notes = []
    for folder in sorted(path for path in FLIGHTS.glob("*") if path.is_dir()):
        try:
            contest = CONTESTS.get(folder.name, contest_of)(folder)
        except InputError as error:
            notes.append(f"{folder.name} takes no part: {error.what}.")
            continue
        held_out = " and ".join(contest.held_out)
        notes.append(
            f"{folder.name}: {contest.fitted} fitted in {contest.seconds:.0f} s, compiling "
            f"included; {held_out} held out. {contest.remark}".rstrip()
        )
        rows += list(_rows(folder.name, contest))
    text = (
        "Mean error of open-loop predictions of held-out flights, so many samples of 10 ms ahead, "
        f"begun every {1e3 * STRIDE_S:.0f} ms at the recorded state (filtered within 30 ms on "
        "either side): Euclidean distances, and for the attitude the angle between both. Nothing "
        "is fitted to these flights. *hold* lets the state be; *linear regression* fits "
        "accelerations to state and inputs of the fitted flights; *unfitted* is the vehicle file "
        "that the fit starts from; *observed* knows besides what turned the vehicle unseen in the "
        "last sample before. "
    )
    return Section("Prediction of real flights", text + " ".join(notes), head, rows)


def _rows(name: str, contest: Contest) -> Iterator[list[str]]:
    for predictor, predictions in contest.predictions.items():
        for steps in COMPARED_STEPS:
            means = summary(predictions, steps / 100.0)
            yield [name, predictor, str(steps), *(_cell(means[key]) for key in PREDICTED_UNITS)]


def summary(predictions: Sequence[Predictions], seconds: float) -> dict[str, float]:
    """Return each quantity's mean error so many s ahead, over all predictions of some flights."""
    counts = [len(p.begins) for p in predictions]
    means = [p.mean(seconds) for p in predictions]
    return {
        name: float(np.average([mean[name] for mean in means], weights=counts))
        for name in PREDICTED_UNITS
    }


def _cell(mean: float) -> str:
    return figure(mean) if np.isfinite(mean) else "–"


def contest_of(folder: Path) -> Contest:
    """Fit a set and predict its held-out flights by all predictors.

    Raises
    ------
    InputError
        Its recordings cannot be fitted.
    """
    options = options_for_set(folder)
    recordings, _ = read_recordings(resolve_settings(options))
    fitted = [recording.flight for recording in recordings if not recording.holdout]
    held_out = [recording for recording in recordings if recording.holdout]
    if not held_out or any(INLETS[recording.inlet].closed_loop for recording in recordings):
        raise InputError(folder, "no flight of it can be held out and predicted open loop", "")
    with tempfile.TemporaryDirectory() as name:
        clock = time.perf_counter()
        out, result = run(options, out=Path(name) / "run")
        seconds = time.perf_counter() - clock
        best = read_vehicle(out / BEST_FIT_FILE)
    settings = resolve_settings(options)
    late = {flight.name: flight.input_late for flight in result.flights}
    controller = controller_of(result)
    known = [(r.flight, r.inlet, late[r.flight.name]) for r in recordings if not r.holdout]
    signal = INLETS[held_out[0].inlet].needs[0]
    predictions: dict[str, list[Predictions]] = {
        label: [
            predict(
                vehicle,
                controller,
                recording.flight,
                recording.inlet,
                stride=STRIDE_S,
                input_late=late[recording.flight.name],
                observer=observer,
            )
            for recording in held_out
        ]
        for label, vehicle, observer in rivals(settings.vehicle, best, controller, known)
    }
    return Contest(
        tuple(recording.flight.name for recording in held_out),
        f"{len(fitted)} flights",
        seconds,
        {**simple_predictors(fitted, [r.flight for r in held_out], signal, predictions["fitted"])}
        | predictions,
    )


CONTESTS: Mapping[str, Callable[[Path], Contest]] = {
    "arplab": without_pose.contest_of,
    "crazyswarm": builds.contest_of,
}
"""Sets that have no pose, or a build for every flight."""


def controller_of(result: RunResult) -> ControllerFile:
    """Return the controller file of a run."""
    return ControllerFile.model_validate(result.settings["controller"])


def options_for_set(folder: Path) -> Options:
    """Return the options of ``tune`` for a set."""
    files = sorted(
        path
        for path in folder.iterdir()
        if path.is_file() and path.suffix not in (".md", ".yaml") and path.name != "LICENSE"
    )
    if not files:
        raise InputError(folder, "it holds no recording", "")
    own, job = folder / "tune.yaml", JOBS.get(folder.name)
    config = str(own) if own.exists() else None
    if config is None and job is not None:
        config = str(ROOT / "configs" / "jobs" / f"{job}.yaml")
    held_out = HELD_OUT.get(folder.name, tuple(path.stem for path in files[-2:]))
    names = None if own.exists() or len(files) < 4 else list(held_out)
    return Options([str(path) for path in files], config=config, holdout=names)
