"""``bench.yaml``: the vehicle that is known already, and the experiments made with it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from annotated_types import Ge, Le, Len
from pydantic import Field, model_validator

from tuner.core.yaml_section import NonNegative, Number, Positive, Section, Whole, read_model

Mass = Annotated[Number, Ge(0.005), Le(500)]
"""kg."""
RotorSpeed = Annotated[Number, Ge(30), Le(4000)]
"""rad/s, within which rotors of multirotors turn."""
Length = Annotated[Number, Ge(0.005), Le(20)]
"""m."""
RotorCount = Annotated[Whole, Ge(1), Le(8)]
Text = Annotated[str, Len(1, 1000)]
MIN_SPIN_RATE, MAX_SPIN_RATE = 0.2, 50.0
"""rad/s of yaw within which a spin says something."""


class Bifilar(Section):
    """A bifilar pendulum about one body axis.

    Attributes
    ----------
    axis
        The body axis that hung vertical.
    mass, wire_distance, wire_length
        What hung, kg (default: the vehicle's mass), and the wires, m.
    recording
        ``time`` and ``angle`` (rad) or ``angle_deg``, or the attitude as ``qw, qx, qy, qz``.
    mass_error
        Relative standard error: by default that of a kitchen scale, 0.1 %.
    wire_distance_error, wire_length_error
        Standard errors in m: by default what a ruler leaves, 0.5 mm and 2 mm.
    """

    kind: Literal["bifilar"]
    axis: Literal["x", "y", "z"]
    mass: Mass | None = None
    wire_distance: Length
    wire_length: Length
    recording: Text
    mass_error: NonNegative = 0.001
    wire_distance_error: NonNegative = 0.0005
    wire_length_error: NonNegative = 0.002


class ThrustStand(Section):
    """A stand that reads a force while ``rotors`` turn; thrust is the force times ``lever_ratio``.

    ``recording`` has ``time``, ``rpm`` or ``rotor_speed``, and ``force`` in N. The ratio's relative
    standard error is by default 0.5 %, of arms that a ruler measured.
    """

    kind: Literal["thrust_stand"]
    recording: Text
    rotors: RotorCount
    lever_ratio: Positive = 1.0
    lever_ratio_error: NonNegative = 0.005


class TorqueStand(Section):
    """A stand that reads a force at ``lever_arm`` m from the axis about which ``rotors`` turn it.

    ``recording`` as of `ThrustStand`; the arm's relative standard error is by default 0.5 %.
    """

    kind: Literal["torque_stand"]
    recording: Text
    rotors: RotorCount
    lever_arm: Length
    lever_arm_error: NonNegative = 0.005


class RpmCurve(Section):
    """Command steps: ``time``, ``command`` 0..1, ``rpm`` or ``rotor_speed``, perhaps ``voltage``.

    ``reference_voltage`` in V is that at which the curve is wanted; by default the highest.
    """

    kind: Literal["rpm_curve"]
    recording: Text
    reference_voltage: Positive | None = None


class StepResponse(Section):
    """Command steps logged fast enough to show the lag: ``time``, ``command``, ``rpm``."""

    kind: Literal["step_response"]
    recording: Text


class HoverPoint(Section):
    """A steady hover: what was carried, kg, and the rotors' mean speed, rad/s, or a recording."""

    mass: Mass
    rotor_speed: RotorSpeed | None = None
    recording: Text | None = None

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        if (self.rotor_speed is None) == (self.recording is None):
            raise ValueError("it should have either rotor_speed or recording")
        return self


class HoverWeights(Section):
    """Hovers with weights.

    Attributes
    ----------
    mass_error
        Relative standard error of a mass, by default 0.1 %.
    rotor_speed_error
        Standard error of a speed, rad/s: by default 3, of a mean over a hover in still air.
    """

    kind: Literal["hover_weights"]
    points: Annotated[tuple[HoverPoint, ...], Len(1, 1000)]
    mass_error: NonNegative = 0.001
    rotor_speed_error: Positive = 3.0


class SpinPoint(Section):
    """A steady level spin: yaw rate and rotor speeds of both pairs, rad/s.

    Without ``rotor_speed_fast`` the fast pair follows from the weight. A ``recording`` has all.
    """

    yaw_rate: Number | None = None
    rotor_speed_slow: RotorSpeed | None = None
    rotor_speed_fast: RotorSpeed | None = None
    recording: Text | None = None

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        numbers = (self.yaw_rate, self.rotor_speed_slow)
        if self.recording is None and None in numbers:
            raise ValueError("it should have yaw_rate and rotor_speed_slow, or recording")
        if self.recording is not None and (*numbers, self.rotor_speed_fast) != (None,) * 3:
            raise ValueError("it should have numbers or recording, not both")
        if self.yaw_rate is not None and not MIN_SPIN_RATE <= abs(self.yaw_rate) <= MAX_SPIN_RATE:
            raise ValueError("it should have a yaw_rate of 0.2 to 50 rad/s")
        return self


class YawSpins(Section):
    """Steady yaw spins; ``rotor_speed_error`` is the standard error of each speed, rad/s."""

    kind: Literal["yaw_spin"]
    points: Annotated[tuple[SpinPoint, ...], Len(1, 1000)]
    rotor_speed_error: Positive = 1.0


class Propeller(Section):
    """A propeller's published coefficients: a static table (RPM, CT, CP), or the two numbers.

    ``diameter`` in m, ``air_density`` in kg/m³.
    """

    kind: Literal["propeller"]
    diameter: Annotated[Number, Ge(0.01), Le(2)]
    air_density: Annotated[Number, Ge(0.1), Le(3)] = 1.225
    table: Text | None = None
    thrust_coefficient: Annotated[Number, Ge(0.001), Le(1)] | None = None
    power_coefficient: Annotated[Number, Ge(0.001), Le(1)] | None = None

    @model_validator(mode="after")
    def _has_one_source(self) -> Self:
        pair = (self.thrust_coefficient, self.power_coefficient)
        if (self.table is None) == (None in pair):
            raise ValueError(
                "it should have either table, or thrust_coefficient and power_coefficient"
            )
        return self


Experiment = Annotated[
    Bifilar
    | ThrustStand
    | TorqueStand
    | RpmCurve
    | StepResponse
    | HoverWeights
    | YawSpins
    | Propeller,
    Field(discriminator="kind"),
]


class BenchFile(Section):
    """The content of ``bench.yaml``.

    Attributes
    ----------
    vehicle
        A vehicle file, relative to this file, or a shipped vehicle: geometry, and what the
        experiments do not measure.
    mass
        Weighed take-off mass, kg; see `weighed_mass` where it is left out.
    experiments
        In any order.
    """

    vehicle: Text = "hovergames"
    mass: Mass | None = None
    experiments: Annotated[tuple[Experiment, ...], Len(1, 200)]

    @property
    def weighed_mass(self) -> float | None:
        """The vehicle's mass, kg: as given, else what hung in a pendulum, else the lightest hover.

        None where no experiment knows it, so that the vehicle file's holds.
        """
        hung = [e.mass for e in self.experiments if isinstance(e, Bifilar) and e.mass is not None]
        flown = [p.mass for e in self.experiments if isinstance(e, HoverWeights) for p in e.points]
        return self.mass or (min(hung) if hung else min(flown, default=None))


def read_bench(path: str | Path) -> BenchFile:
    """Read ``bench.yaml``.

    Raises
    ------
    ConfigError
        In one line: the file, the line in it, the key, its value, what it should be.
    """
    return read_model(BenchFile, path)
