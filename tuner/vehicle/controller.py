"""The controller file: gains, laws, loop rates and filters; what a PX4 log's parameters say of it.

Defaults are the HoverGames.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from annotated_types import Interval
from pydantic import ValidationError, model_validator

from tuner.core.yaml_section import (
    Flag,
    NonNegative,
    Number,
    Positive,
    Section,
    Vector,
    read_model,
    refuse,
)

Gains = tuple[NonNegative, NonNegative, NonNegative]
Rate = Annotated[Number, Interval(ge=1, le=10_000)]
"""Hz of a loop."""


class PositionControl(Section):
    """The geometric position controller, world axes east, north, up.

    Attributes
    ----------
    kp, kv
        1/s² and 1/s.
    max_feedback_acceleration
        m/s², the length beyond which the feedback is scaled back.
    rate
        Hz, of the attitude law too.
    velocity_yaw
        Point the nose along the velocity instead of along the world's x axis.
    reference_drag
        Rotor drag in the reference's body frame, 1/s.
    """

    kp: Gains = (10.0, 10.0, 20.0)
    kv: Gains = (5.0, 5.0, 10.0)
    max_feedback_acceleration: Positive = 10.0
    rate: Rate = 100.0
    velocity_yaw: Flag = False
    reference_drag: Vector = (0.0, 0.0, 0.0)


class AttitudeControl(Section):
    """From attitude error to rate set-point.

    Attributes
    ----------
    law
        ``quaternion`` error, or ``rotation_matrix`` error, which is twice as stiff at small angles.
    time_constant
        s.
    """

    law: Literal["quaternion", "rotation_matrix"] = "quaternion"
    time_constant: Positive = 0.3


class ThrustMap(Section):
    """Acceleration along body z (m/s²) to thrust set-point (0..1): constant (s²/m), offset."""

    normalized_constant: Positive = 0.06
    normalized_offset: Number = 0.1


class AxisGains(Section):
    """PX4's ``MC_ROLLRATE_P``, ``_I``, ``_D``, ``_FF`` and ``_K`` of roll or pitch."""

    p: NonNegative = 0.18
    i: NonNegative = 0.15
    d: NonNegative = 0.003
    ff: NonNegative = 0.0
    k: NonNegative = 1.0


class YawGains(AxisGains):
    """The same of yaw."""

    p: NonNegative = 0.2
    i: NonNegative = 0.1
    d: NonNegative = 0.0


class RateControl(Section):
    """PX4's body rate controller.

    Attributes
    ----------
    roll, pitch, yaw
        Gains, in the forward-right-down frame's signs as PX4 has them.
    integrator_limit
        ``MC_RR_INT_LIM``, as a fraction of the full torque command.
    rate
        Hz.
    """

    roll: AxisGains = AxisGains()
    pitch: AxisGains = AxisGains()
    yaw: YawGains = YawGains()
    integrator_limit: NonNegative = 0.3
    rate: Rate = 400.0


class FiltersSection(Section):
    """Low-pass filters of the gyro, Hz; None is no filter.

    Attributes
    ----------
    gyro_cutoff
        ``IMU_GYRO_CUTOFF``, two-pole Butterworth.
    dgyro_cutoff
        ``IMU_DGYRO_CUTOFF``, one pole, on the differentiated rate.
    """

    gyro_cutoff: Positive | None = 40.0
    dgyro_cutoff: Positive | None = 20.0


class Mixer(Section):
    """PX4's quad-X mixer.

    Attributes
    ----------
    airmode
        ``MC_AIRMODE``: 0 off, 1 roll and pitch, 2 yaw too.
    thrust_factor
        ``THR_MDL_FAC``.
    pwm_quantisation
        Truncate the output to whole microseconds of PWM, as PX4 does; stops gradients.
    saturation_feedback
        The mixer desaturates, and the rate integrator stops in a direction in which rotors are
        clipped low, as in PX4; else each rotor's command is clipped by itself, as simpler
        controllers do.
    """

    airmode: Literal[0, 1, 2] = 0
    thrust_factor: Annotated[Number, Interval(ge=0, le=1)] = 0.0
    pwm_quantisation: Flag = False
    saturation_feedback: Flag = True


class Physics(Section):
    """How the simulation steps: rate in Hz, and the integrator."""

    rate: Rate = 400.0
    integrator: Literal["midpoint", "semi_implicit"] = "midpoint"


class Sensing(Section):
    """What position and attitude control see.

    Attributes
    ----------
    pose_rate
        Hz at which poses arrive, each held until the next; None for all.
    sees_markers
        The estimator takes the motion capture's point and axes for the centre of mass and the
        body's axes, which matters where a vehicle has ``marker_offset`` and ``marker_tilt``; else
        it knows where the markers sit. A fit that finds them elsewhere tries both.
    """

    pose_rate: Rate | None = None
    sees_markers: Flag = False


class ControllerFile(Section):
    """Everything between the reference and the motor commands."""

    name: str = "hovergames"
    position: PositionControl = PositionControl()
    attitude: AttitudeControl = AttitudeControl()
    thrust: ThrustMap = ThrustMap()
    rate: RateControl = RateControl()
    filters: FiltersSection = FiltersSection()
    mixer: Mixer = Mixer()
    physics: Physics = Physics()
    sensing: Sensing = Sensing()

    @model_validator(mode="after")
    def _rates_fit_each_other(self) -> Self:
        for key, rate in (("rate", self.rate.rate), ("position", self.position.rate)):
            if rate > self.physics.rate:
                raise refuse(
                    f"{key}.rate is {rate:g} Hz, faster than physics.rate {self.physics.rate:g} Hz",
                    "raise physics.rate",
                )
        for key, cutoff in self.filters:
            if cutoff is not None and cutoff >= self.rate.rate / 2:
                raise refuse(
                    f"filters.{key} is {cutoff:g} Hz, not below half of rate.rate "
                    f"({self.rate.rate / 2:g} Hz)",
                    "lower it, or give null for no filter",
                )
        return self


def read_controller(path: str | Path) -> ControllerFile:
    """Read a controller file.

    Raises
    ------
    ConfigError
        In one line: the file, the key, its value, what it should be.
    """
    return read_model(ControllerFile, path)


MAX_RATE_HZ = 1000.0
"""Of a simulated rate loop: a faster one has the same effect."""
AXES = {"roll": "MC_ROLLRATE", "pitch": "MC_PITCHRATE", "yaw": "MC_YAWRATE"}
GAINS = {"p": "P", "i": "I", "d": "D", "ff": "FF", "k": "K"}
#: Path in a controller file -> PX4 parameter.
PARAMETER_OF: Mapping[tuple[str, ...], str] = {
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
#: Digits of a parameter, a 32-bit number.
PARAMETER_DIGITS = 6


def with_parameters(
    controller: ControllerFile, parameters: Mapping[str, float]
) -> tuple[ControllerFile, tuple[str, ...]]:
    """Return a controller file with the rate loop, filters and mixer of a log's parameters.

    Parameters
    ----------
    controller
        Gives the other settings.

    Returns
    -------
    tuple
        The controller, and its changes as clauses; unchanged if the parameters are not valid
        together.
    """
    data: dict[str, Any] = controller.model_dump()
    changes = []
    for place, parameter in PARAMETER_OF.items():
        if parameter not in parameters:
            continue
        section = data
        for key in place[:-1]:
            section = section[key]
        before, after = section[place[-1]], _setting_of(place, parameters[parameter])
        if before != after:
            section[place[-1]] = after
            was, now = ("no filter" if s is None else f"{s:g}" for s in (before, after))
            changes.append(f"{'.'.join(place)} {now} ({parameter}; the file has {was})")
    data["physics"]["rate"] = max(data["physics"]["rate"], data["rate"]["rate"])
    try:
        return ControllerFile.model_validate(data), tuple(changes)
    except ValidationError:
        return controller, ()


def _setting_of(place: tuple[str, ...], value: float) -> float | None:
    if place[0] == "filters":
        return round(value, PARAMETER_DIGITS) if value > 0 else None
    if place == ("rate", "rate"):
        return min(value, MAX_RATE_HZ) if value > 0 else 400.0
    return int(value) if place == ("mixer", "airmode") else round(value, PARAMETER_DIGITS)
