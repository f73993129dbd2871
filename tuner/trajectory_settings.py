"""Which trajectory was or is to be flown: of a recording without its reference, or to simulate."""

from __future__ import annotations

from typing import Literal

from tuner.yaml_files.section import Number, Positive, Section

TrajectoryName = Literal["circle", "lemniscate", "straight", "diagonal", "yaw_spin", "hover"]


class TrajectorySettings(Section):
    """The trajectory of a recording that holds no reference; keys and units of ``tune simulate``.

    Attributes
    ----------
    name
        Which shape.
    radius
        m.
    omega
        rad/s.
    speed_scale
        The publisher's velocity scaler.
    yaw_rate
        rad/s, of a yaw spin.
    """

    name: TrajectoryName
    radius: Positive = 2.0
    omega: Positive = 0.7
    speed_scale: Positive = 2.1
    yaw_rate: Number = 2.0
