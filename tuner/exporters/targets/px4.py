"""PX4 parameters of a vehicle, in PX4's frame (forward-right-down) and units.

Control allocation (``CA_ROTOR*``), simulation in hardware (``SIH_*``), the bridge to gz-sim
(``SIM_GZ_EC_*``) and hover thrust; names and definitions as in PX4's parameter reference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import jax.numpy as jnp

from sim_jax.motor import reference_speed
from sim_jax.numeric import GRAVITY
from sim_jax.vehicle import Motor
from tuner.config import VehicleFile
from tuner.errors import ExportError
from tuner.exporters.draft import Draft, read_file
from tuner.exporters.target import Choices, Target, registered
from tuner.yaml_files.document import commented

#: MAVLink's numbers of parameter types, as ground stations write them.
INT32, FLOAT = 6, 9
#: To how many digits a file holds a number.
DIGITS = 1e-8
#: Range of ``MPC_THR_HOVER``.
HOVER_RANGE = (0.1, 0.8)


@dataclass(frozen=True)
class Parameter:
    """A PX4 parameter: an int is an INT32, a float a FLOAT."""

    name: str
    value: float | int


def rotor_speed(vehicle: VehicleFile, command: float) -> float:
    """Return the steady rotor speed in rad/s at a command 0..1."""
    return float(reference_speed(Motor(**vehicle.motor.model_dump()), jnp.asarray(command, float)))


def hover_speed(vehicle: VehicleFile) -> float:
    """Return the rotor speed in rad/s at which the rotors carry the vehicle."""
    lift = len(vehicle.rotors) * vehicle.aerodynamics.motor_constant
    return math.sqrt(vehicle.mass * GRAVITY / lift)


def hover_command(vehicle: VehicleFile) -> float | None:
    """Return the command 0..1 at which the vehicle hovers; None if full command does not do."""
    wanted = hover_speed(vehicle)
    low, high = 0.0, 1.0
    if not rotor_speed(vehicle, low) < wanted < rotor_speed(vehicle, high):
        return None
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rotor_speed(vehicle, middle) < wanted else (low, middle)
    return 0.5 * (low + high)


def parameters(vehicle: VehicleFile) -> tuple[Parameter, ...]:
    """Return the vehicle's parameters.

    Raises
    ------
    ExportError
        The vehicle cannot hover.
    """
    hover = hover_command(vehicle)
    if hover is None:
        raise ExportError(
            vehicle.name,
            f"cannot hover: it needs {hover_speed(vehicle):.0f} rad/s, its rotors turn at "
            f"{rotor_speed(vehicle, 0):.0f} to {rotor_speed(vehicle, 1):.0f}",
            "check mass, motor_constant and input_scaling",
        )
    return (*_allocation(vehicle), *_sih(vehicle), *_gz(vehicle), Parameter("MPC_THR_HOVER", hover))


def _allocation(vehicle: VehicleFile) -> list[Parameter]:
    """Return where the rotors are and what they give: thrust = CT·u², torque = KM·thrust."""
    allocation: list[Parameter] = [Parameter("CA_ROTOR_COUNT", len(vehicle.rotors))]
    for index, rotor in enumerate(vehicle.rotors):
        x, y, z = rotor.position
        sign = 1.0 if rotor.spin == "ccw" else -1.0
        values = {
            "CT": _full_thrust(vehicle),
            "KM": sign * vehicle.aerodynamics.moment_constant,
            "PX": x,
            "PY": -y,
            "PZ": -z,
        }
        allocation += [Parameter(f"CA_ROTOR{index}_{key}", value) for key, value in values.items()]
    return allocation


def _sih(vehicle: VehicleFile) -> list[Parameter]:
    """Return mass, inertia, full thrust and torque, arms, drag and lag of PX4's own simulator.

    Its drag is -KDV·v in all directions; here it is the rotors' in-plane drag at hover speed.
    Its single lag is the mean of the two.
    """
    inertia, motor, aero = vehicle.inertia, vehicle.motor, vehicle.aerodynamics
    full = _full_thrust(vehicle)
    arms = [max(abs(rotor.position[axis]) for rotor in vehicle.rotors) for axis in (1, 0)]
    values = {
        "SIH_MASS": vehicle.mass,
        "SIH_IXX": inertia.xx,
        "SIH_IYY": inertia.yy,
        "SIH_IZZ": inertia.zz,
        "SIH_IXY": 0.0,
        "SIH_IXZ": 0.0,
        "SIH_IYZ": 0.0,
        "SIH_T_MAX": full,
        "SIH_Q_MAX": full * aero.moment_constant,
        "SIH_L_ROLL": arms[0],
        "SIH_L_PITCH": arms[1],
        "SIH_KDV": len(vehicle.rotors) * hover_speed(vehicle) * aero.rotor_drag_coefficient,
        "SIH_T_TAU": (motor.time_constant_up + motor.time_constant_down) / 2,
    }
    return [Parameter(name, value) for name, value in values.items()]


def _gz(vehicle: VehicleFile) -> list[Parameter]:
    """Return the rotor speeds in whole rad/s between which the gz-sim bridge maps commands."""
    low, high = rotor_speed(vehicle, 0.0), rotor_speed(vehicle, 1.0)
    numbers = range(1, len(vehicle.rotors) + 1)
    return [
        *(Parameter(f"SIM_GZ_EC_MIN{number}", round(low)) for number in numbers),
        *(Parameter(f"SIM_GZ_EC_MAX{number}", round(high)) for number in numbers),
    ]


def _full_thrust(vehicle: VehicleFile) -> float:
    """Return one rotor's thrust in N at full command."""
    return vehicle.aerodynamics.motor_constant * rotor_speed(vehicle, 1.0) ** 2


def px4_draft(vehicle: VehicleFile, provenance: str, _: Choices) -> Draft:
    """Return a ``.params`` file of a vehicle.

    Raises
    ------
    ExportError
        The vehicle cannot hover.
    """
    wanted = parameters(vehicle)
    notes = _notes(vehicle)

    def faults(path: Path) -> list[str]:
        there = {parameter.name: parameter.value for parameter in read_parameters(path)}
        return [
            f"{parameter.name} is {there.get(parameter.name)}, not {parameter.value}"
            for parameter in wanted
            if not math.isclose(
                there.get(parameter.name, math.nan), parameter.value, rel_tol=DIGITS
            )
        ]

    return Draft(_text(wanted, "\n".join((provenance, *notes))), vehicle, notes, faults)


def _notes(vehicle: VehicleFile) -> tuple[str, ...]:
    """Return what a reader of the parameters should know."""
    idle = rotor_speed(vehicle, 0.0)
    notes = [
        f"CA_ROTOR*_CT is thrust in N at full command (idle {idle:.0f} rad/s: not CT·u² below)",
        "MPC_THR_HOVER holds for THR_MDL_FAC 0",
        "the SIH model has one drag and one lag for all directions",
    ]
    hover = hover_command(vehicle)
    if hover is not None and not HOVER_RANGE[0] <= hover <= HOVER_RANGE[1]:
        notes.append(f"hover command {hover:.3f} lies outside what PX4 accepts {HOVER_RANGE}")
    return tuple(notes)


def _text(parameters: tuple[Parameter, ...], header: str) -> str:
    """Return a ``.params`` file as ground stations load it, floats with nine digits."""
    lines = [f"1\t1\t{p.name}\t{_value(p)}\t{_kind(p)}\n" for p in parameters]
    columns = commented("Vehicle-Id Component-Id Name Value Type")
    return commented(header) + columns + "".join(lines)


def read_parameters(path: Path) -> tuple[Parameter, ...]:
    """Read a ``.params`` file.

    Raises
    ------
    ExportError
        A line is no parameter.
    """
    parameters = []
    for line in read_file(path).splitlines():
        if line.strip() and not line.startswith("#"):
            try:
                _, _, name, value, kind = line.split()
                parameters.append(
                    Parameter(name, int(value) if int(kind) == INT32 else float(value))
                )
            except ValueError:
                raise ExportError(path, f"has the line '{line}'", "was it edited?") from None
    return tuple(parameters)


def _value(parameter: Parameter) -> str:
    return str(parameter.value) if _kind(parameter) == INT32 else format(parameter.value, ".9g")


def _kind(parameter: Parameter) -> int:
    return INT32 if isinstance(parameter.value, int) else FLOAT


TARGET = Target("px4", ".params", px4_draft, registered("px4"))
