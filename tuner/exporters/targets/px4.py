"""PX4 parameters of a vehicle, in PX4's frame (forward-right-down) and units, for one simulator.

Control allocation (``CA_ROTOR*``) and hover thrust, with simulation in hardware (``SIH_*``) or the
bridge to gz-sim (``SIM_GZ_EC_*``); names and definitions as in PX4's parameter reference. The two
simulators hover at different throttles, so that each has a file of its own, as ground stations
write them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path

from sim_jax.constants import GRAVITY
from tuner.core.errors import ExportError
from tuner.core.yaml_section import commented
from tuner.exporters import laws
from tuner.exporters.simulators import GZ_SIM, Simulator, registry_entries
from tuner.exporters.target import PLACE_TOLERANCE_M, Draft, Target, differences, read_file
from tuner.result import Gate
from tuner.vehicle import VehicleFile

INT32, FLOAT = 6, 9
"""MAVLink's numbers of parameter types, as ground stations write them."""


def with_linear_hover(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle whose thrust is linear in the command, with the same hover throttle.

    Its moments of inertia are scaled like the slope of thrust over command in the hover, so that it
    turns like the vehicle.
    """
    hover, step = laws.hover_command(vehicle), 1e-4
    if hover is None or vehicle.aerodynamics.thrust_law == "linear":
        return laws.with_linear_thrust(vehicle, idle=False)
    slope = [
        laws.thrust_at(vehicle, laws.rotor_speed(vehicle, hover + sign * step)) for sign in (-1, 1)
    ]
    thrust = vehicle.mass * GRAVITY / len(vehicle.rotors)
    ratio = (slope[1] - slope[0]) / (2 * step) / (thrust / hover)
    linear, inertia = laws.with_linear_thrust(vehicle, idle=False), vehicle.inertia
    full = laws.hover_speed(vehicle) / hover
    return linear.replace(
        inertia=inertia.replace(**{axes: value / ratio for axes, value in inertia}),
        motor=linear.motor.replace(input_scaling=full, max_rotor_velocity=full),
    )


SIH = Simulator(
    name="sih",
    title="PX4's SIH",
    version="PX4 1.16 (039af95d)",
    source="src/modules/simulation/simulator_sih/sih.cpp",
    deviations=(
        "thrust is linear in the command, and zero without one",
        "the command lags, by one time constant",
        "one drag in all directions, linear in the velocity and at the centre of mass",
        "one damping of rotation about all axes",
    ),
    entry=registry_entries("px4"),
    laws=(
        laws.with_body_torque,
        partial(laws.with_linear_thrust, idle=False),
        laws.with_mean_lag,
        laws.with_one_drag,
        laws.with_one_damping,
    ),
    free=laws.LINEAR_DRAG,
    ties=(laws.LINEAR_DRAG,),
    fixed=("input_scaling", "zero_position_armed", "time_constant_up", "time_constant_down"),
    start=with_linear_hover,
)


def parameters(vehicle: VehicleFile, simulator: Simulator) -> dict[str, float | int]:
    """Return the vehicle's parameters for a simulator that reads them: an int is an INT32.

    Floats have nine digits, as a file holds them.

    Raises
    ------
    ExportError
        The vehicle cannot hover.
    """
    flown = simulator.flown(vehicle)
    hover = laws.hover_command(flown)
    if hover is None:
        raise ExportError(
            vehicle.name,
            f"cannot hover: it needs {laws.hover_speed(flown):.4g} rad/s, its rotors turn at "
            f"{laws.rotor_speed(flown, 0):.0f} to {laws.rotor_speed(flown, 1):.0f}",
            "check mass, motor_constant and input_scaling",
        )
    own = _sih(flown) if simulator is SIH else _gz_speeds(flown)
    exact = {**_allocation(flown), **own, "MPC_THR_HOVER": hover}
    return {n: v if isinstance(v, int) else float(f"{v:.9g}") for n, v in exact.items()}


def _allocation(vehicle: VehicleFile) -> dict[str, float | int]:
    """Return where the rotors are and what they give: thrust = CT·u², torque = KM·thrust."""
    allocation: dict[str, float | int] = {"CA_ROTOR_COUNT": len(vehicle.rotors)}
    for index, rotor in enumerate(vehicle.rotors):
        x, y, z = rotor.position
        name, sign = f"CA_ROTOR{index}", 1.0 if rotor.spin == "ccw" else -1.0
        allocation |= {
            f"{name}_CT": laws.full_thrust(vehicle),
            f"{name}_KM": sign * vehicle.aerodynamics.moment_constant,
            f"{name}_PX": x,
            f"{name}_PY": -y,
            f"{name}_PZ": -z,
        }
    return allocation


def _sih(vehicle: VehicleFile) -> dict[str, float | int]:
    """Return mass, inertia, full thrust and torque, arms, drag and lag of PX4's own simulator.

    ``vehicle`` is as it flies it. Its drag is -KDV·v in all directions, its damping -KDW·ω.
    """
    inertia, full = vehicle.inertia, laws.full_thrust(vehicle)
    arms = [max(abs(rotor.position[axis]) for rotor in vehicle.rotors) for axis in (1, 0)]
    return {
        "SIH_MASS": vehicle.mass,
        "SIH_IXX": inertia.xx,
        "SIH_IYY": inertia.yy,
        "SIH_IZZ": inertia.zz,
        "SIH_IXY": 0.0,
        "SIH_IXZ": 0.0,
        "SIH_IYZ": 0.0,
        "SIH_T_MAX": full,
        "SIH_Q_MAX": full * vehicle.aerodynamics.moment_constant,
        "SIH_L_ROLL": arms[0],
        "SIH_L_PITCH": arms[1],
        "SIH_KDV": laws.drag_at_hover(vehicle)[0],
        "SIH_KDW": vehicle.effects.get("angular_drag_x", 0.0),
        "SIH_T_TAU": vehicle.motor.time_constant_up,
    }


def _gz_speeds(vehicle: VehicleFile) -> dict[str, float | int]:
    """Return the rotor speeds in whole rad/s between which the gz-sim bridge maps commands."""
    unit, numbers = laws.gz_speed_unit(vehicle), range(1, len(vehicle.rotors) + 1)
    low, high = (round(unit * laws.rotor_speed(vehicle, command)) for command in (0.0, 1.0))
    return {
        **{f"SIM_GZ_EC_MIN{number}": low for number in numbers},
        **{f"SIM_GZ_EC_MAX{number}": high for number in numbers},
    }


def px4_draft(vehicle: VehicleFile, provenance: str, simulator: Simulator, *_: object) -> Draft:
    """Return a ``.params`` file of a vehicle.

    Raises
    ------
    ExportError
        The vehicle cannot hover.
    """
    flown = simulator.flown(vehicle)
    wanted = parameters(vehicle, simulator)
    notes = tuple(_notes(vehicle, flown, simulator))
    header = f"{provenance}\nfor {simulator.title} ({simulator.version})"
    return Draft(
        parameters_text(wanted, "\n".join((header, *notes))),
        flown,
        notes,
        lambda path, _: differences(wanted, read_parameters(path)),
        gates=(
            Gate("PX4 accepts every parameter", tuple(outside_range(wanted))),
            Gate("the simulator has such rotors", tuple(_rotor_faults(vehicle, simulator))),
        ),
    )


def _rotor_faults(vehicle: VehicleFile, simulator: Simulator) -> Iterator[str]:
    """Yield how the rotors of the SIH, a symmetric quad X or a hexacopter X, are others."""
    if simulator is SIH and not vehicle.is_quad:
        yield f"the vehicle has {len(vehicle.rotors)} rotors, what is written is a quad X's"
    elif simulator is SIH:
        for axis, arm in enumerate(("SIH_L_PITCH", "SIH_L_ROLL")):
            arms = [abs(rotor.position[axis]) for rotor in vehicle.rotors]
            if max(arms) - min(arms) > PLACE_TOLERANCE_M:
                yield (
                    f"rotors sit {min(arms):g} to {max(arms):g} m off along {'xy'[axis]}, and "
                    f"{arm} is one number"
                )


def _notes(vehicle: VehicleFile, flown: VehicleFile, simulator: Simulator) -> Iterator[str]:
    """Yield remarks for a reader of the parameters."""
    hover, there = laws.hover_command(vehicle), laws.hover_command(flown)
    if simulator is not SIH:
        idle = laws.rotor_speed(vehicle, 0.0)
        yield (
            f"CA_ROTOR*_CT is thrust in N at full command (idle {idle:.0f} rad/s: not CT·u² below)"
        )
        if laws.gz_speed_unit(flown) < 1:
            scaled = laws.scaling_in_words(laws.rotor_speed(flown, 1.0))
            yield f"{scaled}, as the gz-sim export scales its model"
    if hover is not None and there is not None and abs(hover - there) > 0.005:
        yield (
            f"MPC_THR_HOVER {there:.3f} is the hover of {simulator.title}; with the squared "
            f"thrust of rotors (gz-sim, the vehicle) it is {hover:.3f}"
        )
    yield "MPC_THR_HOVER holds for THR_MDL_FAC 0"


RANGES = {
    r"CA_ROTOR_COUNT": (0, 12),
    r"CA_ROTOR\d+_P[XYZ]": (-100.0, 100.0),
    r"CA_ROTOR\d+_CT": (0.0, 100.0),
    r"CA_ROTOR\d+_KM": (-1.0, 1.0),
    r"MPC_THR_HOVER": (0.1, 0.8),
    r"SIH_(MASS|IXX|IYY|IZZ|T_MAX|Q_MAX|L_ROLL|L_PITCH|KDV|KDW)": (0.0, math.inf),
    r"SIM_GZ_EC_(MIN|MAX)\d+": (0, 1000),
}
"""Parameter -> the range that PX4 accepts.

Source: module.yaml of control_allocator, mc_pos_control, simulator_sih and gz_bridge, PX4 1.16.
"""


def outside_range(parameters: Mapping[str, float | int]) -> Iterator[str]:
    """Yield a clause for each parameter that PX4 does not accept."""
    for name, value in parameters.items():
        for pattern, (low, high) in RANGES.items():
            if re.fullmatch(pattern, name) and not low <= value <= high:
                limit = f"{low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
                yield f"{name} {value:.4g}: PX4 accepts {limit}"


def parameters_text(parameters: Mapping[str, float | int], header: str) -> str:
    """Return a ``.params`` file as ground stations load it, floats with nine digits."""
    lines = [
        f"1\t1\t{name}\t{value}\t{INT32}\n"
        if isinstance(value, int)
        else f"1\t1\t{name}\t{value:.9g}\t{FLOAT}\n"
        for name, value in parameters.items()
    ]
    columns = commented("Vehicle-Id Component-Id Name Value Type")
    return commented(header) + columns + "".join(lines)


def read_parameters(path: Path) -> dict[str, float | int]:
    """Read a ``.params`` file.

    Raises
    ------
    ExportError
        A line is no parameter.
    """
    parameters: dict[str, float | int] = {}
    for line in read_file(path).splitlines():
        if line.strip() and not line.startswith("#"):
            try:
                _, _, name, value, kind = line.split()
                parameters[name] = int(value) if int(kind) == INT32 else float(value)
            except ValueError:
                raise ExportError(path, f"has the line '{line}'", "was it edited?") from None
    return parameters


TARGET = Target("px4", ".params", px4_draft, SIH, others=(GZ_SIM,))
