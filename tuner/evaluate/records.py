"""Errors of flights as ``result.json`` holds them."""

from __future__ import annotations

from tuner.core.files import FiniteOrNone, Part

RMSE_UNITS = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
"""Axis -> unit of its RMSE."""


class AxesRmse(Part):
    """The thesis's six: position along world x, y, z in m; roll, pitch, yaw in degrees.

    None stands for a flight that crashed or an axis that was not recorded.
    """

    x: FiniteOrNone
    y: FiniteOrNone
    z: FiniteOrNone
    roll: FiniteOrNone
    pitch: FiniteOrNone
    yaw: FiniteOrNone


class PredictedErrors(Part):
    """How far open-loop predictions lie from the recording, ``seconds`` after they begin.

    Means over all predictions of a flight of the Euclidean distance in position (m), velocity (m/s)
    and body rate (rad/s), and of the angle between the attitudes (rad). Each begins at the recorded
    state, filtered within hundredths of a second (`tuner.recordings.states`); nothing is
    fitted to it.
    """

    seconds: float
    position: FiniteOrNone
    velocity: FiniteOrNone
    attitude: FiniteOrNone
    body_rate: FiniteOrNone
