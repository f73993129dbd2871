"""Open-loop prediction of real flights that were not fitted, against simpler predictors.

Every set of recordings in the folder of real flights is fitted by ``tune`` itself, two of its
flights held out; these are then predicted from every recorded state. No recording is stored here.

Where each flight of a set was flown with a build of its own, none can be predicted by the others,
whose mass, motors and propellers differ. So the first half of each is fitted, from the shipped
Crazyflie at the mass that was weighed, and the second half is held out.

Of a set without a pose the longest flight is fitted by `tune` without a pose, and the others are
predicted: body rate alone, by gyro and motor commands. Attitude is integrated from the gyro,
position and velocity are taken as none, which matters little to how a vehicle turns within half a
second.

The linear regression is what a data-driven user would try first: body-frame acceleration and
angular acceleration regressed by least squares on body-frame velocity, gravity's direction, body
rate and the inputs of the last samples; position and attitude follow by kinematics.
"""

from __future__ import annotations

import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.table import ResultSection, figure
from benchmarks.timing import REAL_FLIGHTS, ROOT
from tuner.config import InletName, JobFile, resolve_settings
from tuner.core.errors import InputError
from tuner.core.numerics import Array
from tuner.evaluate.prediction import (
    FedFlight,
    FlightPredictor,
    Predictions,
    TorqueObserver,
    errors_of,
    hold_state,
)
from tuner.findings.sentences import PREDICTED_UNITS
from tuner.job.run import run
from tuner.job.without_pose import fit_without_pose
from tuner.objective.inlets import INLETS
from tuner.options import Options
from tuner.recordings.flight import Flight, Series
from tuner.recordings.loader import InertialFlight
from tuner.recordings.states import States, initial_state, local_parabolas, states_at
from tuner.result import BEST_FIT_FILE
from tuner.search.job_flights import read_inertial_flights, read_recordings
from tuner.search.listener import Reporter
from tuner.search.problem import job_of
from tuner.search.progress import controller_flown, vehicle_fitted
from tuner.terms.selection import search_with_terms, with_first_terms
from tuner.uncertainty.identifiability import hold_undetermined
from tuner.vehicle import ControllerFile, VehicleFile, read_vehicle

COMPARED_STEPS = (10, 50)
"""Samples of 10 ms after which predictions are compared."""
STRIDE_S = 0.02
"""s from one prediction to the next."""
MEMORY = 4
"""Samples of the inputs that are regressors."""
INLET: InletName = "actuator"
"""Where each flight has its build, commands follow from commanded thrust and torque."""
CLOCK_HZ = 100.0
"""The clock on which flights without a pose are compared."""
JOBS: Mapping[str, str] = {"nanobench": "crazyflie"}
"""Set -> shipped job file, where it holds no ``tune.yaml`` of its own."""
HELD_OUT: Mapping[str, tuple[str, ...]] = {
    "nanobench": ("B2_circle_slow_rep1", "B3_figure8_medium_rep1")
}
"""Set -> flights that are held out; of another set the last two of four or more."""
REMARK = (
    "Without a pose body rate alone is compared, with the attitude from the gyro. Commands say the "
    "torque to some rad/s², differently in every flight (trim, battery, propellers), and an open "
    "loop adds that up, while the loop that flew kept the body rate small."
)


@dataclass(frozen=True)
class Contest:
    """A set of recordings, and each predictor's predictions of its held-out flights.

    Attributes
    ----------
    predictions
        Predictor -> its predictions, one a held-out flight.
    """

    held_out: tuple[str, ...]
    fitted: str
    seconds: float
    predictions: Mapping[str, Sequence[Predictions]]
    remark: str = ""


def measure() -> ResultSection:
    """Fit and predict every set that is there."""
    head = [
        "set",
        "predictor",
        "steps",
        *(f"{name} [{unit}]" for name, unit in PREDICTED_UNITS.items()),
    ]
    rows: list[list[str]] = []
    notes = []
    for folder in sorted(path for path in REAL_FLIGHTS.glob("*") if path.is_dir()):
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
    return ResultSection("Prediction of real flights", text + " ".join(notes), head, rows)


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


def predictions_by_all(
    unfitted: VehicleFile,
    fitted: VehicleFile,
    controller: ControllerFile,
    known: Sequence[FedFlight],
    held_out: Sequence[FedFlight],
) -> dict[str, list[Predictions]]:
    """Return each predictor's predictions of held-out flights: without physics, and of a vehicle.

    Parameters
    ----------
    unfitted, fitted, controller
        The vehicle before and after a fit; it is also predicted beside the torque that no input
        shows.
    known
        The flights of the fit.
    """
    observer = TorqueObserver.of(fitted, controller, known)
    predictors = [
        FlightPredictor(flight, inlet, stride=STRIDE_S, input_late=late)
        for flight, inlet, late in held_out
    ]
    signal = INLETS[held_out[0][1]].needs[0]
    regression = LinearRegression.of([flight for flight, *_ in known], signal)
    return {
        "hold": [hold_state(one.flight, one.begins, one.ahead) for one in predictors],
        "linear regression": [
            regression.predict(one.flight, one.begins, one.ahead) for one in predictors
        ],
        "unfitted": [one.predict(unfitted, controller) for one in predictors],
        "fitted": [one.predict(fitted, controller) for one in predictors],
        "fitted, observed": [one.predict(fitted, controller, observer) for one in predictors],
    }


def contest_of(folder: Path) -> Contest:
    """Fit a set and predict its held-out flights by all predictors.

    Raises
    ------
    InputError
        Its recordings cannot be fitted.
    """
    options = options_for_set(folder)
    recordings, _ = read_recordings(resolve_settings(options))
    held_out = [recording for recording in recordings if recording.holdout]
    if not held_out or any(INLETS[recording.inlet].closed_loop for recording in recordings):
        raise InputError(folder, "no flight of it can be held out and predicted open loop", "")
    with tempfile.TemporaryDirectory() as name:
        clock = time.perf_counter()
        out, result = run(options, out=Path(name) / "run")
        seconds = time.perf_counter() - clock
        best = read_vehicle(out / BEST_FIT_FILE)
    late = {flight.name: flight.input_late for flight in result.flights}
    known, others = (
        [(r.flight, r.inlet, late[r.flight.name]) for r in recordings if r.holdout is out]
        for out in (False, True)
    )
    controller = ControllerFile.model_validate(result.settings["controller"])
    return Contest(
        tuple(recording.flight.name for recording in held_out),
        f"{len(known)} flights",
        seconds,
        predictions_by_all(resolve_settings(options).vehicle, best, controller, known, others),
    )


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


def contest_of_builds(folder: Path) -> Contest:
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
    match = re.search(r"^mass: *([0-9.]+)", path.read_text(encoding="utf-8"), re.MULTILINE)
    if match is None:
        raise InputError(path, "holds no mass", "write it as mass: 0.03")
    return float(match[1])


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
        reporter = Reporter()
        selected = search_with_terms(job, Path(name), resume=False, reporter=reporter)
        fitted, _ = hold_undetermined(selected.job, selected.fitted, reporter)
    best = vehicle_fitted(selected.job, fitted)
    controller = controller_flown(selected.job, fitted)
    return predictions_by_all(
        settings.vehicle, best, controller, [(first, INLET, 0.0)], [(second, INLET, 0.0)]
    )


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


def contest_without_pose(folder: Path) -> Contest:
    """Fit the longest flight of a set and predict all others.

    Raises
    ------
    InputError
        Its recordings cannot be fitted.
    """
    paths = [str(path) for path in sorted(folder.glob("log*"))]
    settings = resolve_settings(Options(paths, vehicle="crazyflie"))
    flights = sorted(
        read_inertial_flights(settings)[0],
        key=lambda flight: max(end - begin for begin, end in flight.flying),
    )
    if len(flights) < 2:
        raise InputError(folder, "it holds fewer than two flights without a pose", "")
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        fit = fit_without_pose(settings, flights[-1:], out=Path(name) / "run")
        best = read_vehicle(fit.folder / BEST_FIT_FILE)
    seconds = time.perf_counter() - began
    *held_out, known = [(with_pose(flight), INLET, 0.0) for flight in flights]
    predictions = predictions_by_all(settings.vehicle, best, ControllerFile(), [known], held_out)
    return Contest(
        tuple(flight.name for flight in flights[:-1]),
        flights[-1].name,
        seconds,
        {
            label: [replace(p, errors={"body_rate": p.errors["body_rate"]}) for p in each]
            for label, each in predictions.items()
        },
        REMARK,
    )


def with_pose(flight: InertialFlight) -> Flight:
    """Return the longest stretch in the air with an attitude that the gyro integrates to."""
    begin, end = max(flight.flying, key=lambda span: span[1] - span[0])
    gyro = flight.series["body_rate"]
    inside = (gyro.time >= begin) & (gyro.time <= end)
    time_there, rate = gyro.time[inside] - begin, gyro.values[inside]
    turned, attitude = Rotation.identity(), [Rotation.identity()]
    for step, mean in zip(np.diff(time_there), 0.5 * (rate[1:] + rate[:-1]), strict=True):
        turned = turned * Rotation.from_rotvec(mean * step)
        attitude.append(turned)
    still = np.zeros((len(time_there), 3))
    command = flight.series["command"]
    fed = (command.time >= begin) & (command.time <= end)
    series = {
        "position": Series(time_there, still),
        "velocity": Series(time_there, still),
        "attitude": Series(time_there, Rotation.concatenate(attitude).as_quat(scalar_first=True)),
        "body_rate": Series(time_there, rate),
        "command": Series(command.time[fed] - begin, command.values[fed]),
    }
    clock = np.arange(0.0, time_there[-1], 1.0 / CLOCK_HZ)
    signals = {
        name: np.column_stack([np.interp(clock, s.time, column) for column in s.values.T])
        for name, s in series.items()
    }
    return Flight(
        flight.name, flight.path, "", CLOCK_HZ, clock, signals, series, initial_state(series)
    )


CONTESTS: Mapping[str, Callable[[Path], Contest]] = {
    "arplab": contest_without_pose,
    "crazyswarm": contest_of_builds,
}
"""Sets that have no pose, or a build for every flight."""


@dataclass(frozen=True)
class LinearRegression:
    """A linear model of the accelerations.

    Attributes
    ----------
    weights
        (features, 6): m/s² and rad/s², body axes.
    """

    signal: str
    weights: Array

    @staticmethod
    def of(flights: Sequence[Flight], signal: str) -> LinearRegression:
        """Fit it to some flights."""
        rows, targets = [], []
        for flight in flights:
            time = flight.time[MEMORY:-1]
            now, then = states_at(flight.series, time), states_at(flight.series, time + 1 / 100.0)
            turned = Rotation.from_quat(now.attitude, scalar_first=True)
            acceleration = turned.inv().apply((then.velocity - now.velocity) * 100.0)
            angular = (then.body_rate - now.body_rate) * 100.0
            row = features(turned, now.velocity, now.body_rate, inputs_at(flight, signal, time))
            target = np.hstack([acceleration, angular])
            known = np.isfinite(row).all(axis=1) & np.isfinite(target).all(axis=1)
            rows.append(row[known])
            targets.append(target[known])
        matrix, target = np.concatenate(rows), np.concatenate(targets)
        return LinearRegression(signal, np.linalg.lstsq(matrix, target, rcond=None)[0])

    def predict(self, flight: Flight, begins: Array, ahead: Array) -> Predictions:
        """Predict a flight from its recorded states at (n,) times, (S,) s ahead."""
        start = states_at(flight.series, begins)
        position, velocity, rate = start.position, start.velocity, start.body_rate
        turned = Rotation.from_quat(start.attitude, scalar_first=True)
        reached: dict[str, list[Array]] = {
            name: [] for name in ("position", "velocity", "attitude", "body_rate")
        }
        steps = np.diff(ahead, prepend=0.0)
        for begin, step in zip(ahead - steps, steps, strict=True):
            row = features(turned, velocity, rate, inputs_at(flight, self.signal, begins + begin))
            change = np.nan_to_num(row) @ self.weights
            faster = velocity + turned.apply(change[:, :3]) * step
            position = position + 0.5 * (velocity + faster) * step
            turning = rate + change[:, 3:] * step
            turned = turned * Rotation.from_rotvec(0.5 * (rate + turning) * step)
            velocity, rate = faster, turning
            for name, value in {
                "position": position,
                "velocity": velocity,
                "attitude": turned.as_quat(scalar_first=True),
                "body_rate": rate,
            }.items():
                reached[name].append(value)
        recorded: States = states_at(flight.series, (begins + ahead[:, None]).ravel())
        errors = errors_of(
            {name: np.stack(values) for name, values in reached.items()},
            recorded,
            (len(ahead), len(begins)),
        )
        return Predictions(begins, ahead, errors)


def features(turned: Rotation, velocity: Array, rate: Array, inputs: Array) -> Array:
    """Return the regressors (n, features) of n states."""
    down = turned.inv().apply(np.tile([0.0, 0.0, 1.0], (len(velocity), 1)))
    return np.hstack(
        [turned.inv().apply(velocity), down, rate, inputs, np.ones((len(velocity), 1))]
    )


def inputs_at(flight: Flight, signal: str, time: Array) -> Array:
    """Return the input's last samples (n, MEMORY k) before some times."""
    table = [local_parabolas(flight.series[signal], time - k / flight.rate) for k in range(MEMORY)]
    return np.hstack(table)
