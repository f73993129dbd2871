"""A pendulum's attitude as motion capture records it, into its angle about the hanging axis."""

from __future__ import annotations

import numpy as np

from tuner.bench.measurement import Array
from tuner.errors import RecordingError

AXES = ("x", "y", "z")
VERTICAL = 0.9
"""Least cosine between the body axis that hangs vertical and the vertical."""


def angle_of_attitude(path: str, quaternion: Array, axis: str) -> Array:
    """Return the angle (n,), rad, about the vertical, of a body that hangs by one of its axes.

    Parameters
    ----------
    path
        Of the recording.
    quaternion
        (n, 4) w, x, y, z: body to world, world z up; rows that are not finite give NaN.
    axis
        The body axis that ought to hang vertical.

    Raises
    ------
    RecordingError
        Another body axis, or none, hangs vertical.
    """
    norm = np.linalg.norm(quaternion, axis=1, keepdims=True)
    w, x, y, z = (quaternion / np.where(norm > 0.1, norm, np.nan)).T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])
    mean = np.nanmean(up, axis=1) if np.isfinite(w).any() else np.zeros(3)
    hanging = int(np.argmax(np.abs(mean)))
    if abs(mean[hanging]) < VERTICAL:
        raise RecordingError(path, "hangs by no body axis", "hang it by the axis to be measured")
    if AXES[hanging] != axis:
        what = f"hangs by its body axis {AXES[hanging]}, and axis says {axis}"
        raise RecordingError(path, what, "correct the axis, or hang it by the other one")
    # the heading of a body axis that lies level tells the turn about the vertical
    level = (hanging + 1) % 3
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z)),
        (2 * (x * z + w * y), 2 * (y * z - w * x)),
    )
    forward, left = columns[level]
    heading = np.arctan2(left, forward)
    known = np.isfinite(heading)
    angle = np.full(len(heading), np.nan)
    angle[known] = np.unwrap(heading[known])
    return np.asarray(angle - np.nanmean(angle))
