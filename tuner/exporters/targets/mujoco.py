"""MuJoCo's MJCF: a free body with an actuator for each rotor, and drag as actuators of velocity."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.core.phrases import printable
from tuner.exporters import laws
from tuner.exporters.external_simulator import flier_of
from tuner.exporters.simulators import MOTORS, Simulator, entries
from tuner.exporters.target import Target, numbers_draft, read_file, xml_comment
from tuner.vehicle import VehicleFile

Attributes: TypeAlias = dict[str, str | tuple[float, ...]]
"""Of an XML element: words, or numbers."""
NUMBERS = {
    "inertial": ("pos", "mass", "diaginertia"),
    "site": ("pos",),
    "general": ("gear", "dynprm", "gainprm", "biasprm", "ctrlrange"),
}
"""Tag -> its attributes that are numbers."""
_USE = """
  The first controls are the rotors' thrusts in N, which lag what is asked for; those named drag_
  and damping_ need none. A command 0..1 asks for motor_constant times its rotor speed squared.
"""


def elements(vehicle: VehicleFile) -> dict[str, list[Attributes]]:
    """Return tag -> attributes of each of its elements, of a vehicle by MuJoCo's laws."""
    inertia, motor, aero = vehicle.inertia, vehicle.motor, vehicle.aerodynamics
    thrusts = laws.thrust_at(vehicle, laws.rotor_speed(vehicle, 0.0)), laws.full_thrust(vehicle)
    sites: list[Attributes] = []
    actuators: list[Attributes] = []
    for number, rotor in enumerate(vehicle.rotors):
        name, turn = f"rotor_{number}", -1.0 if rotor.spin == "ccw" else 1.0
        sites.append({"name": name, "pos": rotor.position})
        actuators.append(
            {
                "name": name,
                "site": name,
                "gear": (0, 0, 1, 0, 0, turn * aero.moment_constant),
                "dyntype": "filterexact",
                "dynprm": (motor.time_constant_up,),
                "gainprm": (1,),
                "ctrlrange": thrusts,
            }
        )
    centre = np.mean([rotor.position for rotor in vehicle.rotors], axis=0)
    sites.append({"name": "hub", "pos": tuple(centre.tolist())})
    names = [f"{kind}_{axis}" for kind in ("drag", "damping") for axis in "xyz"]
    for number, value in enumerate((*laws.drag_at_hover(vehicle), *_damping(vehicle))):
        if value:
            actuators.append(
                {
                    "name": names[number],
                    "site": "hub",
                    "gear": tuple(int(number == direction) for direction in range(6)),
                    "gainprm": (0,),
                    "biastype": "affine",
                    "biasprm": (0, 0, -value),
                    "ctrlrange": (0, 0),
                }
            )
    moments = (inertia.xx, inertia.yy, inertia.zz)
    body: Attributes = {"pos": (0, 0, 0), "mass": (vehicle.mass,), "diaginertia": moments}
    return {"inertial": [body], "site": sites, "general": actuators}


def mjcf(vehicle: VehicleFile, provenance: str) -> str:
    """Return the model of a vehicle by MuJoCo's laws."""
    written = {
        tag: [f"<{tag} {' '.join(map(_attribute, found, found.values()))}/>" for found in of_tag]
        for tag, of_tag in elements(vehicle).items()
    }
    size = " ".join(repr(max(abs(r.position[axis]) for r in vehicle.rotors)) for axis in (0, 1))
    comment = xml_comment(provenance) + _USE
    return f"""<mujoco model={quoteattr(printable(vehicle.name))}>
  <!-- {comment.strip()} -->
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.0025" integrator="RK4" gravity="0 0 -9.81" density="0" viscosity="0"/>
  <worldbody>
    <body name="vehicle" pos="0 0 1">
      <freejoint name="free"/>
      {written["inertial"][0]}
      <geom name="frame" type="box" size="{size} 0.02" mass="0" contype="0" conaffinity="0"/>
      {(chr(10) + "      ").join(written["site"])}
    </body>
  </worldbody>
  <actuator>
    {(chr(10) + "    ").join(written["general"])}
  </actuator>
</mujoco>
"""


def _attribute(key: str, value: str | tuple[float, ...]) -> str:
    return f'{key}="{value if isinstance(value, str) else " ".join(map(repr, value))}"'


def _damping(vehicle: VehicleFile) -> tuple[float, float, float]:
    """Return the damping of rotation, N m s/rad; about z with that of rotor drag."""
    x, y, z = (vehicle.effects.get(f"angular_drag_{axis}", 0.0) for axis in "xyz")
    arms = np.mean([np.square(rotor.position[:2]) for rotor in vehicle.rotors], axis=0)
    drag = laws.drag_at_hover(vehicle)
    body = [vehicle.effects.get(f"linear_drag_{axis}", 0.0) for axis in "xy"]
    return x, y, z + float((drag[0] - body[0]) * arms[1] + (drag[1] - body[1]) * arms[0])


def numbers_of(vehicle: VehicleFile) -> dict[str, list[float]]:
    """Return name of an element and of an attribute -> its numbers."""
    return {
        f"{found.get('name', '')} {key}".strip(): [*value]
        for of_tag in elements(vehicle).values()
        for found in of_tag
        for key, value in found.items()
        if not isinstance(value, str)
    }


def read_mjcf(path: Path) -> dict[str, list[float]]:
    """Return the numbers of a model by this target, as of `numbers_of`."""
    root = ElementTree.fromstring(read_file(path))
    return {
        f"{found.get('name', '')} {key}".strip(): [
            float(word) for word in found.get(key, "").split()
        ]
        for tag, keys in NUMBERS.items()
        for found in root.iter(tag)
        for key in keys
    }


def _flier(vehicle: VehicleFile) -> Callable[..., Any] | None:
    """Return the flier of a vehicle in MuJoCo; None if that is not installed."""
    try:
        import mujoco  # noqa: PLC0415 (an extra)
    except ImportError:
        return None
    try:
        model = mujoco.MjModel.from_xml_string(mjcf(vehicle, ""))
    except ValueError as error:
        raise ExportError(
            vehicle.name, f"MuJoCo does not take it ({error})", "report this"
        ) from None
    count, constant = len(vehicle.rotors), vehicle.aerodynamics.motor_constant

    class MujocoBody:
        """As of `tuner.exporters.external_simulator.ExternalBody`."""

        def __init__(self, step: float) -> None:
            model.opt.timestep = step
            self.data = mujoco.MjData(model)

        def begin(self, state: Array, rotor_speed: Array) -> None:
            self.data.qpos[:] = np.concatenate([state[:3], state[6:10]])
            self.data.qvel[:] = np.concatenate([state[3:6], state[10:13]])
            self.data.act[:count] = constant * rotor_speed
            mujoco.mj_forward(model, self.data)

        def step(self, asked: Array) -> tuple[Array, Array]:
            self.data.ctrl[:count] = constant * asked
            mujoco.mj_step(model, self.data)
            qpos, qvel = self.data.qpos, self.data.qvel
            state = np.concatenate([qpos[:3], qvel[:3], qpos[3:7], qvel[3:6]])
            return state, self.data.act[:count] / constant

    return flier_of(MujocoBody)


MUJOCO = Simulator(
    name="mujoco",
    title="MuJoCo",
    version="MuJoCo 3.3 to 4.0",
    source="mujoco.readthedocs.io, XMLreference: actuator/general, dyntype filterexact",
    deviations=(
        "each rotor's thrust is an actuator's, which lags the control in N by one time constant",
        "drag is linear in the velocity of the rotors' centre, at the hover's rotor speed",
    ),
    entry=entries(
        "MuJoCo",
        laws.LINEAR_DRAG,
        laws.ANGULAR_DRAG,
        time_constant_up="dynprm",
        time_constant_down="dynprm",
        motor_constant="gainprm, ctrlrange",
        moment_constant="gear",
        rotor_drag_coefficient="biasprm",
        thrust_inflow_coefficient="biasprm",
        rotor_drag_ratio_y="biasprm",
        **laws.CENTRE,
    ),
    laws=(
        laws.about_centre_of_mass,
        laws.with_mean_lag,
        partial(laws.with_linear_thrust, idle=True),
    ),
    fixed=(*MOTORS, "time_constant_up", "time_constant_down"),
)
TARGET = Target("mujoco", ".xml", numbers_draft(numbers_of, mjcf, read_mjcf, flier=_flier), MUJOCO)
