"""Errors of flights as ``result.json`` holds them."""

from __future__ import annotations

import math

from tuner.core.files import FiniteOrNone, Part

RMSE_UNITS = {"x": "m", "y": "m", "z": "m", "roll": "deg", "pitch": "deg", "yaw": "deg"}
"""Axis -> unit of its RMSE."""
AXES = {"position": ("x", "y", "z"), "attitude": ("roll", "pitch", "yaw")}
"""Signal -> its axes."""


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

    def together(self, signal: str) -> float | None:
        """Return the RMSE over the axes of position or attitude; None if one has none."""
        parts = [getattr(self, axis) for axis in AXES[signal]]
        return None if None in parts else math.hypot(*parts)


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
