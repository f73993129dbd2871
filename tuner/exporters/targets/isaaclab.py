"""Isaac Lab's multirotor: a Python module with keyword arguments of its configuration classes."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

from tuner.core.yaml_section import commented
from tuner.exporters import laws
from tuner.exporters.simulators import Simulator, entries
from tuner.exporters.target import Target, module_assignments, numbers_draft
from tuner.vehicle import VehicleFile

RAD_PER_TURN = 2 * math.pi
"""Isaac Lab has rotor speeds in turns per second."""
_USE = """
# from isaaclab_contrib.actuators import ThrusterCfg
# from isaaclab_contrib.assets import MultirotorCfg
# thruster = ThrusterCfg(dt=SIMULATION_STEP, thruster_names_expr=[PROPELLER_JOINTS], **THRUSTER)
# cfg = MultirotorCfg(actuators={"thrusters": thruster}, **MULTIROTOR)
# mass and inertia go into the USD's MassAPI, RIGID_PROPS into RigidBodyPropertiesCfg
"""


def configuration(vehicle: VehicleFile) -> dict[str, dict[str, Any]]:
    """Return section -> arguments of Isaac Lab's configuration of a vehicle by its laws.

    Both ends of a sampled range are equal; ``--draws`` gives wider ones.
    """
    motor, aero, inertia = vehicle.motor, vehicle.aerodynamics, vehicle.inertia
    constant = aero.motor_constant * RAD_PER_TURN**2
    spins = [1.0 if rotor.spin == "ccw" else -1.0 for rotor in vehicle.rotors]
    x, y = ([rotor.position[axis] for rotor in vehicle.rotors] for axis in (0, 1))
    none = [0.0] * len(vehicle.rotors)
    return {
        "THRUSTER": {
            "thrust_range": [
                laws.thrust_at(vehicle, laws.rotor_speed(vehicle, command))
                for command in (0.0, 1.0)
            ],
            "thrust_const_range": [constant, constant],
            "tau_inc_range": [motor.time_constant_up] * 2,
            "tau_dec_range": [motor.time_constant_down] * 2,
            "torque_to_thrust_ratio": aero.moment_constant,
            "use_discrete_approximation": False,
            "integration_scheme": "rk4",
        },
        "MULTIROTOR": {
            "rotor_directions": [int(-spin) for spin in spins],
            "allocation_matrix": [
                none,
                none,
                [1.0] * len(vehicle.rotors),
                y,
                [-arm for arm in x],
                [-spin * aero.moment_constant for spin in spins],
            ],
        },
        "RIGID_PROPS": {
            # PhysX damps v' = -damping v, in 1/s
            "linear_damping": vehicle.effects.get("linear_drag_x", 0.0) / vehicle.mass,
            "angular_damping": vehicle.effects.get("angular_drag_x", 0.0) / inertia.xx,
        },
        "BODY": {
            "mass": vehicle.mass,
            "diagonal_inertia": [inertia.xx, inertia.yy, inertia.zz],
            "hover_rps": laws.hover_speed(vehicle) / RAD_PER_TURN,
        },
    }


def isaaclab_text(content: dict[str, dict[str, Any]], provenance: str) -> str:
    """Return the module."""
    pieces = []
    for section, values in content.items():
        lines = "".join(f"    {name!r}: {value!r},\n" for name, value in values.items())
        pieces.append(f"{section} = {{\n{lines}}}\n")
    return commented(provenance) + "\n".join(pieces) + _USE


ISAAC_LAB = Simulator(
    name="isaaclab",
    title="Isaac Lab",
    version="Isaac Lab 2.3 to 3.0 (1ab6d6cf)",
    source="isaaclab_contrib/actuators/thruster.py, assets/multirotor",
    deviations=(
        "one drag in all directions, linear in the velocity and at the centre of mass",
        "one damping of rotation about all axes, by which body rates decay equally",
    ),
    entry=entries(
        "Isaac Lab",
        laws.LINEAR_DRAG,
        laws.ANGULAR_DRAG,
        time_constant_up="tau_inc_range",
        time_constant_down="tau_dec_range",
        motor_constant="thrust_const_range",
        moment_constant="torque_to_thrust_ratio",
        rotor_drag_coefficient="linear_damping",
        **laws.CENTRE,
    ),
    laws=(
        laws.about_centre_of_mass,
        laws.with_one_drag,
        partial(laws.with_one_damping, of_rate=True),
    ),
    free=laws.LINEAR_DRAG,
    ties=(laws.LINEAR_DRAG,),
)
TARGET = Target(
    "isaaclab",
    "_isaaclab.py",
    numbers_draft(
        configuration,
        lambda vehicle, provenance: isaaclab_text(configuration(vehicle), provenance),
        module_assignments,
    ),
    ISAAC_LAB,
)
