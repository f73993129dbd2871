"""RotorPy's parameters: a Python module with ``quad_params``."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from tuner.core.numerics import Array
from tuner.core.yaml_section import commented
from tuner.exporters import laws
from tuner.exporters.external_simulator import flier_of
from tuner.exporters.simulators import Simulator, entries
from tuner.exporters.target import Target, module_assignments, numbers_draft
from tuner.vehicle import VehicleFile


def quad_params(vehicle: VehicleFile) -> dict[str, Any]:
    """Return RotorPy's parameters of a vehicle by its laws, arrays as lists.

    Its commands are rotor speeds; a command 0..1 asks for ``input_scaling``·u +
    ``zero_position_armed`` of them.
    """
    inertia, motor, aero = vehicle.inertia, vehicle.motor, vehicle.aerodynamics
    drag = vehicle.effects.get("fuselage_drag", 0.0)
    return {
        "mass": vehicle.mass,
        "Ixx": inertia.xx, "Iyy": inertia.yy, "Izz": inertia.zz,
        "Ixy": 0.0, "Ixz": 0.0, "Iyz": 0.0,
        "num_rotors": len(vehicle.rotors),
        "rotor_pos": {f"r{i + 1}": list(r.position) for i, r in enumerate(vehicle.rotors)},
        "rotor_directions": [-1 if rotor.spin == "ccw" else 1 for rotor in vehicle.rotors],
        "rI": [0.0, 0.0, 0.0],
        "c_Dx": drag, "c_Dy": drag, "c_Dz": drag,
        "k_eta": aero.motor_constant,
        "k_m": aero.motor_constant * aero.moment_constant,
        "k_d": aero.rotor_drag_coefficient,
        "k_z": vehicle.effects.get("thrust_inflow_coefficient", 0.0),
        "k_h": 0.0,
        "k_flap": vehicle.effects.get("flapping_moment_coefficient", 0.0),
        "tau_m": motor.time_constant_up,
        "rotor_speed_min": laws.rotor_speed(vehicle, 0.0),
        "rotor_speed_max": laws.rotor_speed(vehicle, 1.0),
        "motor_noise_std": 0.0,
    }  # fmt: skip


def module_text(vehicle: VehicleFile, provenance: str) -> str:
    """Return a Python module that RotorPy's ``Multirotor`` takes ``quad_params`` from."""
    lines = "".join(f"    {name!r}: {value!r},\n" for name, value in quad_params(vehicle).items())
    return (
        f"{commented(provenance)}import numpy as np\n\n_P = {{\n{lines}}}\nquad_params = {{\n"
        "    **_P,\n    'rotor_pos': {name: np.array(r) for name, r in _P['rotor_pos'].items()},\n"
        "    'rotor_directions': np.array(_P['rotor_directions']),\n"
        "    'rI': np.array(_P['rI']),\n}\n"
    )


def _flier(vehicle: VehicleFile) -> Callable[..., Any] | None:
    """Return the flier of a vehicle in RotorPy; None if that is not installed."""
    try:
        from rotorpy.vehicles.multirotor import Multirotor  # noqa: PLC0415
    except ImportError:
        return None
    params = quad_params(vehicle)
    arrays = params | {
        "rotor_pos": {name: np.array(place) for name, place in params["rotor_pos"].items()},
        "rotor_directions": np.array(params["rotor_directions"]),
        "rotor_speed_min": 0.0,
        "rotor_speed_max": 10.0 * params["rotor_speed_max"],  # what is asked for is in its range
    }

    class RotorPyBody:
        """As of `tuner.exporters.external_simulator.ExternalBody`."""

        def __init__(self, step: float) -> None:
            self.vehicle, self.period = Multirotor(arrays), step
            self.state: dict[str, Array] = {}

        def begin(self, state: Array, rotor_speed: Array) -> None:
            x, v, q, w = state[:3], state[3:6], state[[7, 8, 9, 6]], state[10:13]
            wind = np.zeros(3)
            self.state = {"x": x, "v": v, "q": q, "w": w, "wind": wind, "rotor_speeds": rotor_speed}

        def step(self, asked: Array) -> tuple[Array, Array]:
            control = {"cmd_motor_speeds": asked}
            self.state = self.vehicle.step(self.state, control, self.period)
            x, v, q, w = (self.state[key] for key in "xvqw")
            return np.concatenate([x, v, q[[3, 0, 1, 2]], w]), self.state["rotor_speeds"]

    return flier_of(RotorPyBody)


ROTORPY = Simulator(
    name="rotorpy",
    title="RotorPy",
    version="RotorPy 3.0.0",
    source="rotorpy/vehicles/multirotor.py",
    deviations=("one time constant, up and down",),
    entry=entries(
        "RotorPy",
        time_constant_up="tau_m",
        time_constant_down="tau_m",
        motor_constant="k_eta",
        moment_constant="k_m",
        rotor_drag_coefficient="k_d",
        thrust_inflow_coefficient="k_z",
        fuselage_drag="c_Dx, c_Dy, c_Dz",
        flapping_moment_coefficient="k_flap",
        **laws.CENTRE,
    ),
    laws=(laws.about_centre_of_mass, laws.with_mean_lag),
    ties=(("time_constant_up", "time_constant_down"),),
)
TARGET = Target(
    "rotorpy",
    "_params.py",
    numbers_draft(
        quad_params,
        module_text,
        lambda path: module_assignments(path).get("_P", {}),
        flier=_flier,
    ),
    ROTORPY,
)
