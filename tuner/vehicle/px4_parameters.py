"""What a PX4 log's own parameters say of the controllers that flew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from tuner.vehicle.controller import ControllerFile

FASTEST = 1000.0
"""Hz of a simulated rate loop, at most: a quicker one turns a vehicle alike."""
AXES = {"roll": "MC_ROLLRATE", "pitch": "MC_PITCHRATE", "yaw": "MC_YAWRATE"}
GAINS = {"p": "P", "i": "I", "d": "D", "ff": "FF", "k": "K"}
#: Place in a controller file -> parameter.
PLACES: Mapping[tuple[str, ...], str] = {
    **{
        ("rate", axis, gain): f"{prefix}_{letter}"
        for axis, prefix in AXES.items()
        for gain, letter in GAINS.items()
    },
    ("rate", "integrator_limit"): "MC_RR_INT_LIM",
    ("rate", "rate"): "IMU_GYRO_RATEMAX",
    ("filters", "gyro_cutoff"): "IMU_GYRO_CUTOFF",
    ("filters", "dgyro_cutoff"): "IMU_DGYRO_CUTOFF",
    ("mixer", "airmode"): "MC_AIRMODE",
    ("mixer", "thrust_factor"): "THR_MDL_FAC",
}
#: Digits to which a parameter, a 32-bit number, is its file's.
DIGITS = 6


@dataclass(frozen=True)
class Change:
    """A setting that a log's parameters have otherwise than a controller file.

    Attributes
    ----------
    place
        In the controller file, as ``rate.roll.p``.
    parameter
        Its name in PX4.
    before, after
        In the file and in the log; None is no filter.
    """

    place: str
    parameter: str
    before: float | None
    after: float | None

    def __str__(self) -> str:
        """Return it as a clause."""
        before = "no filter" if self.before is None else f"{self.before:g}"
        after = "no filter" if self.after is None else f"{self.after:g}"
        return f"{self.place} {after} ({self.parameter}; the file has {before})"


def with_parameters(
    controller: ControllerFile, parameters: Mapping[str, float]
) -> tuple[ControllerFile, tuple[Change, ...]]:
    """Return a controller file with the rate loop, filters and mixer that a log's parameters tell.

    Parameters
    ----------
    controller
        With what no parameter tells.
    parameters
        Of the log.

    Returns
    -------
    tuple
        The controller, and what has changed; as it was where the parameters make no sense together.
    """
    data: dict[str, Any] = controller.model_dump()
    changes = []
    for place, parameter in PLACES.items():
        if parameter not in parameters:
            continue
        section = data
        for key in place[:-1]:
            section = section[key]
        before, after = section[place[-1]], _told(place, parameters[parameter])
        if before != after:
            section[place[-1]] = after
            changes.append(Change(".".join(place), parameter, before, after))
    data["physics"]["rate"] = max(data["physics"]["rate"], data["rate"]["rate"])
    try:
        return ControllerFile.model_validate(data), tuple(changes)
    except ValidationError:
        return controller, ()


def _told(place: tuple[str, ...], value: float) -> float | None:
    if place[0] == "filters":
        return round(value, DIGITS) if value > 0 else None
    if place == ("rate", "rate"):
        return min(value, FASTEST) if value > 0 else 400.0
    return int(value) if place == ("mixer", "airmode") else round(value, DIGITS)
