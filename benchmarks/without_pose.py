"""Prediction of flights without a pose: body rate alone, by gyro and motor commands.

The first flight's neighbours are held out: one is fitted by `tune` without a pose, the others are
predicted. Attitude is integrated from the gyro, position and velocity are taken as none, which
matters little to how a vehicle turns within half a second.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.contest import STRIDE_S, Contest, rivals, simple_predictors
from tuner.config import Options, resolve_settings
from tuner.config.job import InletName
from tuner.core.errors import InputError
from tuner.evaluate.prediction import Predictions, predict
from tuner.job.without_pose import fit_without_pose
from tuner.recordings.flight import Flight, Series
from tuner.recordings.loader import InertialFlight
from tuner.recordings.states import initial_state
from tuner.result import BEST_FIT_FILE
from tuner.search.job_flights import read_inertial_flights
from tuner.vehicle import ControllerFile, read_vehicle

INLET: InletName = "actuator"
RATE = 100.0
"""Hz of the clock on which flights are compared."""
REMARK = (
    "Without a pose body rate alone is compared, with the attitude from the gyro. Commands say the "
    "torque to some rad/s², differently in every flight (trim, battery, propellers), and an open "
    "loop adds that up, while the loop that flew kept the body rate small."
)


def contest_of(folder: Path) -> Contest:
    """Fit the longest flight of a set and predict all others.

    Raises
    ------
    InputError
        Its recordings cannot be fitted.
    """
    paths = [str(path) for path in sorted(folder.glob("log*"))]
    settings = resolve_settings(Options(paths, vehicle="crazyflie"))
    flights = sorted(read_inertial_flights(settings)[0], key=_flown)
    if len(flights) < 2:
        raise InputError(folder, "it holds fewer than two flights without a pose", "")
    began = time.perf_counter()
    with tempfile.TemporaryDirectory() as name:
        fit = fit_without_pose(settings, flights[-1:], out=Path(name) / "run")
        best = read_vehicle(fit.folder / BEST_FIT_FILE)
    seconds = time.perf_counter() - began
    fitted, held_out = with_pose(flights[-1]), [with_pose(flight) for flight in flights[:-1]]
    controller = ControllerFile()
    predictions = {
        label: [
            _rates(predict(vehicle, controller, flight, INLET, stride=STRIDE_S, observer=observer))
            for flight in held_out
        ]
        for label, vehicle, observer in rivals(
            settings.vehicle, best, controller, [(fitted, INLET, 0.0)]
        )
    }
    others = simple_predictors([fitted], held_out, "command", predictions["fitted"])
    return Contest(
        tuple(flight.name for flight in held_out),
        flights[-1].name,
        seconds,
        {label: [_rates(p) for p in each] for label, each in others.items()} | predictions,
        REMARK,
    )


def _flown(flight: InertialFlight) -> float:
    return max(end - begin for begin, end in flight.flying)


def _rates(predictions: Predictions) -> Predictions:
    return replace(predictions, errors={"body_rate": predictions.errors["body_rate"]})


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
    clock = np.arange(0.0, time_there[-1], 1.0 / RATE)
    signals = {
        name: np.column_stack([np.interp(clock, s.time, column) for column in s.values.T])
        for name, s in series.items()
    }
    return Flight(flight.name, flight.path, "", RATE, clock, signals, series, initial_state(series))
