"""Parameters of drone-models and crazyflow: a table of their ``params.toml``."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from statistics import fmean
from typing import Any

import numpy as np

from sim_jax.constants import GRAVITY, RAD_S_PER_RPM
from tuner.core.disk import file_name
from tuner.core.numerics import Array
from tuner.core.yaml_section import commented
from tuner.exporters import laws
from tuner.exporters.external_simulator import flier_of
from tuner.exporters.simulators import Simulator, entries
from tuner.exporters.target import PLACE_TOLERANCE_M, Target, numbers_draft, read_file
from tuner.result import Gate
from tuner.vehicle import VehicleFile

ORDER = [0, 1, 2, 7, 8, 9, 6, 3, 4, 5, 10, 11, 12]
"""Swaps velocity and attitude, whose scalar its state has last; rotor speeds in rpm follow."""


def params(vehicle: VehicleFile) -> dict[str, Any]:
    """Return the parameters of the first-principles model of a vehicle by its laws."""
    aero, motor, inertia = vehicle.aerodynamics, vehicle.motor, vehicle.inertia
    thrust = aero.motor_constant * RAD_S_PER_RPM**2
    x, y = ([math.copysign(1.0, r.position[axis]) for r in vehicle.rotors] for axis in (0, 1))
    drag = [-vehicle.effects.get(f"linear_drag_{axis}", 0.0) for axis in "xyz"]
    return {
        "gravity_vec": [0.0, 0.0, -GRAVITY],
        "mass": vehicle.mass,
        "L": abs(vehicle.rotors[0].position[0]),
        "J": np.diag([inertia.xx, inertia.yy, inertia.zz]).tolist(),
        "rpm2thrust": [0.0, 0.0, thrust],
        "rpm2torque": [0.0, 0.0, thrust * aero.moment_constant],
        "thrust2torque": aero.moment_constant,
        "rotor_dyn_coef": [1 / motor.time_constant_up, 0.0, 1 / motor.time_constant_down, 0.0],
        "mixing_matrix": [
            y,
            [-side for side in x],
            [-1.0 if rotor.spin == "ccw" else 1.0 for rotor in vehicle.rotors],
        ],
        "drag_matrix": np.diag(drag).tolist(),
        "thrust_min": laws.thrust_at(vehicle, laws.rotor_speed(vehicle, 0.0)),
        "thrust_max": laws.thrust_at(vehicle, laws.rotor_speed(vehicle, 1.0)),
        "prop_inertia": vehicle.effects.get("rotor_inertia", 0.0),
    }


_USE = """
drone-models: into data/params.toml; into first_principles/params.toml the name in brackets alone.
crazyflow: into dynamics/first_principles/params.toml; drones/ needs a Drone and an MJCF so called.
"""


def table(vehicle: VehicleFile, provenance: str) -> str:
    """Return a table to put into drone-models' or crazyflow's ``params.toml``."""
    lines = "".join(f"{name} = {value!r}\n" for name, value in params(vehicle).items())
    return f'{commented(provenance + _USE.rstrip())}["{file_name(vehicle.name, "")}"]\n{lines}'


def _rotor_gates(vehicle: VehicleFile) -> tuple[Gate, ...]:
    arms = [abs(r.position[axis]) for r in vehicle.rotors for axis in (0, 1)]
    objections = (
        ()
        if vehicle.is_quad
        else (f"the vehicle has {len(vehicle.rotors)} rotors, the simulator four",)
    )
    if max(arms) - min(arms) > PLACE_TOLERANCE_M:
        objections = (f"its rotors sit in no square: arms of {min(arms):g} to {max(arms):g} m",)
    return (Gate("the simulator has such rotors", objections),)


def _with_square_rotors(vehicle: VehicleFile) -> VehicleFile:
    """Return a vehicle with rotors in a square around the centre of mass, at its height."""
    arm = fmean(abs(rotor.position[axis]) for rotor in vehicle.rotors for axis in (0, 1))

    def side(x: float) -> float:
        return arm if x > 0 else -arm

    rotors = tuple(
        rotor.replace(position=(side(rotor.position[0]), side(rotor.position[1]), 0.0))
        for rotor in vehicle.rotors
    )
    return laws.with_body_torque(vehicle.replace(rotors=rotors))


def _flier(vehicle: VehicleFile) -> Callable[..., Any] | None:
    """Return the flier of drone-models' dynamics; None if that is not installed.

    It needs the environment variable SCIPY_ARRAY_API=1. It has derivatives only: a step is one of
    the classic Runge-Kutta method.
    """
    try:
        from drone_models.first_principles import dynamics  # noqa: PLC0415
    except (ImportError, RuntimeError):  # it wants SCIPY_ARRAY_API=1 from the start
        return None
    content = params(vehicle)
    names = ("mass", "L", "prop_inertia", "gravity_vec", "J", "rpm2thrust", "rpm2torque")
    arrays = {
        name: np.asarray(content[name])
        for name in (*names, "mixing_matrix", "drag_matrix", "rotor_dyn_coef")
    }
    inverse = np.linalg.inv(arrays["J"])

    class DroneModelsBody:
        """As of `tuner.exporters.external_simulator.ExternalBody`."""

        def __init__(self, step: float) -> None:
            self.period, self.state = step, np.zeros(17)

        def begin(self, state: Array, rotor_speed: Array) -> None:
            self.state = np.concatenate([state[ORDER], rotor_speed / RAD_S_PER_RPM])

        def step(self, asked: Array) -> tuple[Array, Array]:
            def change(s: Array) -> Array:
                found = [
                    *dynamics(
                        s[:3],
                        s[3:7],
                        s[7:10],
                        s[10:13],
                        asked / RAD_S_PER_RPM,
                        s[13:],
                        J_inv=inverse,
                        **arrays,
                    )
                ]
                rate, vector, scalar = s[10:13], s[3:6], s[6]  # its own change of attitude is wrong
                turn = scalar * rate + np.cross(vector, rate)
                found[1] = 0.5 * np.append(turn, -vector @ rate)
                return np.concatenate(found)

            state, period = self.state, self.period
            first = change(state)
            second = change(state + 0.5 * period * first)
            third = change(state + 0.5 * period * second)
            fourth = change(state + period * third)
            state = state + period / 6 * (first + 2 * second + 2 * third + fourth)
            state[3:7] /= np.linalg.norm(state[3:7])
            self.state = state
            return state[ORDER], state[13:] * RAD_S_PER_RPM

    return flier_of(DroneModelsBody)


DRONE_MODELS = Simulator(
    name="drone-models",
    title="crazyflow (drone-models)",
    version="drone-models 0.1.0, crazyflow 0.4.0",
    source="drone_models/first_principles/model.py",
    deviations=(
        "drag is linear in the body's velocity, at the centre of mass",
        "rotors sit in a square at the height of the centre of mass",
        "the gyroscopic moment about forward has the other sign (not in crazyflow)",
    ),
    entry=entries(
        "drone-models",
        laws.LINEAR_DRAG,
        time_constant_up="rotor_dyn_coef",
        time_constant_down="rotor_dyn_coef",
        motor_constant="rpm2thrust",
        moment_constant="rpm2torque",
        rotor_drag_coefficient="drag_matrix",
        rotor_inertia="prop_inertia",
    ),
    laws=(laws.with_linear_drag, _with_square_rotors),
    free=("linear_drag_x", "linear_drag_y"),
)
TARGET = Target(
    "drone-models",
    ".toml",
    numbers_draft(
        params,
        table,
        lambda path: next(iter(tomllib.loads(read_file(path)).values())),
        gates=_rotor_gates,
        flier=_flier,
    ),
    DRONE_MODELS,
)
