"""Linear regression as a predictor: accelerations as linear functions of state and inputs.

What a data-driven user would try first: body-frame acceleration and angular acceleration regressed
by least squares on body-frame velocity, gravity's direction, body rate and the inputs of the last
samples; position and attitude follow by kinematics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tuner.core.numerics import Array
from tuner.evaluate.prediction import Predictions, errors_of
from tuner.recordings.flight import Flight
from tuner.recordings.states import States, local_parabolas, states_at

MEMORY = 4
"""Samples of the inputs that are regressors."""


@dataclass(frozen=True)
class Regression:
    """A linear model of the accelerations.

    Attributes
    ----------
    weights
        (features, 6): m/s² and rad/s², body axes.
    """

    signal: str
    weights: Array

    @staticmethod
    def of(flights: Sequence[Flight], signal: str) -> Regression:
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
        return Regression(signal, np.linalg.lstsq(matrix, target, rcond=None)[0])

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
