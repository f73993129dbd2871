"""The side-car: what a lab notes about one recording, in a YAML file of the same name beside it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from tuner.core.yaml_section import Number, Section, Whole, read_model
from tuner.vehicle.motor_orders import MotorOrder


class Sidecar(Section):
    """What the file beside a recording states about it.

    Attributes
    ----------
    trajectory
        What was flown, for recordings without the reference: name and numbers as in a
        `TrajectorySettings`, which are checked where the simulator's shapes are known.
    start, end
        Seconds since the first pose between which the mission lies, instead of those found.
    missions
        Numbers, from 1, of those missions that are fitted, of a recording that holds several; None
        for all, or of a long one for those that show most.
    topics
        The topic map of this recording: a file beside it, or a shipped map's name.
    namespace
        Prefix of its topics.
    motor_order
        In which its motors were recorded, as in a topic map.
    """

    trajectory: Mapping[str, str | Number] | None = None
    start: Number | None = None
    end: Number | None = None
    missions: tuple[Whole, ...] | None = None
    topics: str | None = None
    namespace: str = ""
    motor_order: MotorOrder | None = None


def sidecar_path(recording: Path) -> Path:
    """Return where the side-car of a recording lies, if there is one."""
    return recording / "flight.yaml" if recording.is_dir() else recording.with_suffix(".yaml")


def read_sidecar(recording: Path) -> Sidecar:
    """Read the side-car of a recording; an empty one where there is none.

    Raises
    ------
    ConfigError
        It is no valid side-car.
    """
    path = sidecar_path(recording)
    return read_model(Sidecar, path) if path.is_file() else Sidecar()
