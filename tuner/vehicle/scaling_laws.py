"""Scaling laws that give a starting vehicle from mass, size and propellers, with their errors.

The laws are crude: each coefficient comes with the standard deviation of its logarithm. They hold
for quadrotors from a palm's size to a metre. The command `tune new-vehicle` writes a vehicle file,
and a job file with priors of these widths.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sim_jax.constants import GRAVITY
from tuner.core.disk import check_file, write_text
from tuner.core.errors import OutputError
from tuner.core.runtime import PROGRAM, installed
from tuner.core.shipped import configs_folder
from tuner.core.yaml_section import commented, dump_yaml
from tuner.vehicle import (
    COEFFICIENTS,
    VehicleFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)

AIR_DENSITY = 1.225
"""kg/m³."""
INCH = 0.0254
"""m."""
HOVER_THROTTLE = 0.5
"""The default command in hover, for which vehicles are designed."""
IDLE_SPEED_RATIO = 0.15
"""Rotor speed at zero command over the speed gained from there to full command."""
CELL_VOLTAGE = 3.7
"""V of a cell under load."""


@dataclass(frozen=True)
class Airframe:
    """Visible properties of a quadrotor.

    Attributes
    ----------
    mass
        kg, ready to fly.
    wheelbase
        m between opposite motors.
    diameter, pitch
        Of the propeller, m.
    cells
        In series; a single one means brushed, coreless motors. None if not known.
    motor_kv
        rad/s per V, unloaded; None if not known.
    hover_throttle
        Command in hover, 0..1; None if not known.
    rotor_height
        m of the rotors above the centre of mass.
    """

    mass: float
    wheelbase: float
    diameter: float
    pitch: float
    cells: int | None = None
    motor_kv: float | None = None
    hover_throttle: float | None = None
    rotor_height: float = 0.0


@dataclass(frozen=True)
class ScaledEstimate:
    """A coefficient by a law: its value, the standard deviation of its logarithm, its source."""

    value: float
    error: float
    source: str


KNOWN_AIRFRAMES: Mapping[str, Airframe] = {
    "hovergames": Airframe(2.243, 0.5, 11 * INCH, 4.7 * INCH, 4, 920 * math.pi / 30, 0.54, 0.06),
    "crazyflie": Airframe(0.030, 0.092, 1.85 * INCH, 1.0 * INCH, 1, 14000 * math.pi / 30, 0.86),
}
"""Shipped vehicle -> its airframe."""


def scaled_coefficients(airframe: Airframe) -> dict[str, ScaledEstimate]:
    """Return name -> estimate of the coefficients that the laws know."""
    arm, radius = 0.5 * airframe.wheelbase, 0.5 * airframe.diameter
    ratio = airframe.pitch / airframe.diameter
    thrust = 0.05 + 0.14 * ratio
    power = 0.0135 + 0.115 * ratio
    motor_constant = thrust * AIR_DENSITY * airframe.diameter**4 / (2 * math.pi) ** 2
    moment_constant = power * airframe.diameter / (2 * math.pi * thrust)
    scaling, scaling_error, scaling_source = _input_scaling(airframe, motor_constant)
    gyration = airframe.mass * arm**2
    tables = "line through static tables of slow propellers (UIUC propeller data site)"
    mass_law = "a third of the mass at the motors, the rest near the centre"
    lag = "between a palm-sized coreless motor (0.05 s) and an 11 inch brushless one"
    flapping = "the thrust tilts by the advance ratio v/(ΩR): k/R"
    return {
        "inertia_xx": ScaledEstimate(0.19 * gyration, 0.4, f"0.19 m r²: {mass_law}"),
        "inertia_yy": ScaledEstimate(0.19 * gyration, 0.4, f"0.19 m r²: {mass_law}"),
        "inertia_zz": ScaledEstimate(0.33 * gyration, 0.4, f"0.33 m r²: {mass_law}"),
        "input_scaling": ScaledEstimate(scaling, scaling_error, scaling_source),
        "zero_position_armed": ScaledEstimate(
            IDLE_SPEED_RATIO * scaling, 0.6, f"{IDLE_SPEED_RATIO:g} of input_scaling, idling"
        ),
        "time_constant_up": ScaledEstimate(0.025, 0.7, lag),
        "time_constant_down": ScaledEstimate(0.035, 0.7, lag),
        "motor_constant": ScaledEstimate(
            motor_constant, 0.4, f"C_T ρ D⁴/(2π)² with C_T = 0.05 + 0.14 pitch/diameter: {tables}"
        ),
        "moment_constant": ScaledEstimate(
            moment_constant, 0.5, "C_P D/(2π C_T) with C_P = 0.0135 + 0.115 pitch/diameter: the "
            "same tables, a third higher as on vehicles",
        ),
        "rotor_drag_coefficient": ScaledEstimate(motor_constant / radius, 0.7, flapping),
        "rolling_moment_coefficient": ScaledEstimate(
            0.05 * motor_constant, 1.5, "0.05 of the motor constant, as of the HoverGames quad"
        ),
    }  # fmt: skip


def scaled_to_known(
    airframe: Airframe, like: str, known: Mapping[str, float]
) -> dict[str, ScaledEstimate]:
    """Return the laws' estimates, scaled so that they hold for a vehicle whose values are known.

    Parameters
    ----------
    like
        One of `KNOWN_AIRFRAMES`, similar to it.
    known
        Coefficient -> value of that one.
    """
    there = scaled_coefficients(KNOWN_AIRFRAMES[like])
    return {
        name: ScaledEstimate(
            estimate.value * known[name] / there[name].value,
            estimate.error / math.sqrt(2),
            f"{like}'s, scaled by: {estimate.source}",
        )
        for name, estimate in scaled_coefficients(airframe).items()
    }


def _input_scaling(airframe: Airframe, motor_constant: float) -> tuple[float, float, str]:
    """Return rad/s per unit of command, the error of its logarithm, and the source."""
    hover = math.sqrt(airframe.mass * GRAVITY / (4 * motor_constant))
    if airframe.hover_throttle is None and airframe.motor_kv and airframe.cells:
        loaded = 0.45 if airframe.cells == 1 else 0.75
        top = loaded * airframe.motor_kv * CELL_VOLTAGE * airframe.cells
        source = f"{loaded:g} of the unloaded speed at {CELL_VOLTAGE:g} V a cell, from kV and cells"
        return top / (1 + IDLE_SPEED_RATIO), 0.35, source
    throttle = airframe.hover_throttle or HOVER_THROTTLE
    error = 0.25 if airframe.hover_throttle else 0.4
    source = f"weight and motor_constant give the hover's speed at a command of {throttle:g}"
    return hover / (throttle + IDLE_SPEED_RATIO), error, source


SPINS = ("ccw", "ccw", "cw", "cw")
"""Of the quad X in PX4's order: front right, rear left, front left, rear right."""
SIDES = ((1, -1), (-1, 1), (1, 1), (-1, -1))
MAX_SPEED_HEADROOM = 2.5
"""Largest rotor speed over that of full command, which is known to a factor of two: a fit has to
reach what its vehicle flew at, and no command exceeds one."""
HEADER = """By scaling laws from what can be read off the vehicle: where a fit starts, not measured.
{priors} beside it holds a prior as wide as each law is crude:
tune --flights lab/*.bag --config {priors}"""


def new_vehicle(
    airframe: Airframe, out: Path, *, like: str | None = None
) -> dict[str, ScaledEstimate]:
    """Write a vehicle file and, beside it, a job file with priors; return the estimates.

    Parameters
    ----------
    out
        The vehicle file; the job file has the same name and ends in ``.job.yaml``.
    like
        A shipped vehicle of `tuner.vehicle.scaling_laws.KNOWN_AIRFRAMES` that the laws are to meet.

    Raises
    ------
    OutputError
        A file cannot be written, or is there already.
    """
    check_file(out)
    job = out.with_name(f"{out.stem}.job.yaml")
    check_file(job)
    for path in (out, job):
        if path.exists():
            raise OutputError(path, "is there already", "remove it, or give another --out")
    template = read_vehicle(configs_folder() / "vehicles" / "hovergames_updated.yaml")
    if like is None:
        estimates = scaled_coefficients(airframe)
    else:
        name = {"hovergames": "hovergames_updated"}.get(like, like)
        known = read_vehicle(configs_folder() / "vehicles" / f"{name}.yaml")
        estimates = scaled_to_known(airframe, like, values_of(known))
    vehicle = _vehicle(template, airframe, estimates, out.stem)
    write_vehicle(vehicle, out, header=HEADER.format(priors=job.name))
    text = dump_yaml(_job(out, airframe, estimates))
    write_text(job, commented(f"Priors of {out.name}.") + text)
    return estimates


def _vehicle(
    template: VehicleFile, airframe: Airframe, estimates: dict[str, ScaledEstimate], name: str
) -> VehicleFile:
    side = airframe.wheelbase / 2 / math.sqrt(2)
    rotors = [
        {"position": [round(x * side, 5), round(y * side, 5), airframe.rotor_height], "spin": spin}
        for (x, y), spin in zip(SIDES, SPINS, strict=True)
    ]
    full = estimates["input_scaling"].value + estimates["zero_position_armed"].value
    motor = template.motor.replace(max_rotor_velocity=_rounded(MAX_SPEED_HEADROOM * full))
    source = {"made_by": f"{PROGRAM} {installed()}", "method": "by scaling laws, not measured"}
    source |= {name: estimate.source for name, estimate in estimates.items()}
    vehicle = template.replace(
        name=name, mass=airframe.mass, rotors=rotors, motor=motor, source=source
    )
    return with_values(vehicle, {n: _rounded(e.value) for n, e in estimates.items()})


def _job(out: Path, airframe: Airframe, estimates: dict[str, ScaledEstimate]) -> dict[str, object]:
    """Return the content of the job file: the vehicle, its mass, bounds and priors."""
    settings: dict[str, object] = {}
    for name, estimate in estimates.items():
        if COEFFICIENTS[name].free:
            value, reach = _rounded(estimate.value), math.exp(4 * estimate.error)
            prior = {"mean": value, "sd": _rounded(estimate.error * value)}
            bounds = {"lower": _rounded(value / reach), "upper": _rounded(value * reach)}
            settings[name] = bounds | {"prior": prior}
    return {"vehicle": out.name, "mass": airframe.mass, "coefficients": settings}


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")
