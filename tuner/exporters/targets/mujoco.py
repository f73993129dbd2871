"""MuJoCo's MJCF: a free body with an actuator for each rotor, and drag as actuators of velocity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from tuner.core.errors import ExportError
from tuner.core.numerics import Array
from tuner.core.phrases import printable
from tuner.exporters.external_simulator import flier_of
from tuner.exporters.simulators import MUJOCO, drag_at_hover, full_thrust, rotor_speed, thrust_at
from tuner.exporters.target import Draft, Target, differences, read_file, xml_comment
from tuner.vehicle import VehicleFile

_AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1"}
_USE = """
  The first controls are the rotors' thrusts in N, which lag what is asked for; those named drag_
  and damping_ need none. A command 0..1 asks for motor_constant times its rotor speed squared.
"""


def mjcf(vehicle: VehicleFile, provenance: str) -> str:
    """Return the model of a vehicle by MuJoCo's laws."""
    inertia, motor, aero = vehicle.inertia, vehicle.motor, vehicle.aerodynamics
    places = [" ".join(map(_number, rotor.position)) for rotor in vehicle.rotors]
    centre = np.mean([rotor.position for rotor in vehicle.rotors], axis=0)
    low, full = thrust_at(vehicle, rotor_speed(vehicle, 0.0)), full_thrust(vehicle)
    sites, actuators = [], []
    for number, (rotor, place) in enumerate(zip(vehicle.rotors, places, strict=True)):
        turn = (-1.0 if rotor.spin == "ccw" else 1.0) * aero.moment_constant
        sites.append(f'<site name="rotor_{number}" pos="{place}"/>')
        actuators.append(
            f'<general name="rotor_{number}" site="rotor_{number}" '
            f'gear="0 0 1 0 0 {_number(turn)}" '
            f'dyntype="filterexact" dynprm="{_number(motor.time_constant_up)}" gainprm="1" '
            f'ctrlrange="{_number(low)} {_number(full)}"/>'
        )
    sites.append(f'<site name="hub" pos="{" ".join(map(_number, centre.tolist()))}"/>')
    for kind, values in (("drag", drag_at_hover(vehicle)), ("damping", _damping(vehicle))):
        for (axis, direction), value in zip(_AXES.items(), values, strict=True):
            gear = f"{direction} 0 0 0" if kind == "drag" else f"0 0 0 {direction}"
            if value:
                actuators.append(
                    f'<general name="{kind}_{axis}" site="hub" gear="{gear}" gainprm="0" '
                    f'biastype="affine" biasprm="0 0 {_number(-value)}" ctrlrange="0 0"/>'
                )
    moments = " ".join(map(_number, (inertia.xx, inertia.yy, inertia.zz)))
    size = " ".join(_number(max(abs(r.position[axis]) for r in vehicle.rotors)) for axis in (0, 1))
    comment = xml_comment(provenance) + _USE
    return f"""<mujoco model={quoteattr(printable(vehicle.name))}>
  <!-- {comment.strip()} -->
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.0025" integrator="RK4" gravity="0 0 -9.81" density="0" viscosity="0"/>
  <worldbody>
    <body name="vehicle" pos="0 0 1">
      <freejoint name="free"/>
      <inertial pos="0 0 0" mass="{_number(vehicle.mass)}" diaginertia="{moments}"/>
      <geom name="frame" type="box" size="{size} 0.02" mass="0" contype="0" conaffinity="0"/>
      {(chr(10) + "      ").join(sites)}
    </body>
  </worldbody>
  <actuator>
    {(chr(10) + "    ").join(actuators)}
  </actuator>
</mujoco>
"""


def _damping(vehicle: VehicleFile) -> tuple[float, float, float]:
    """Return the damping of rotation, N m s/rad; about z with that of rotor drag."""
    x, y, z = (vehicle.effects.get(f"angular_drag_{axis}", 0.0) for axis in "xyz")
    arms = np.mean([np.square(rotor.position[:2]) for rotor in vehicle.rotors], axis=0)
    drag = drag_at_hover(vehicle)
    body = [vehicle.effects.get(f"linear_drag_{axis}", 0.0) for axis in "xy"]
    return x, y, z + float((drag[0] - body[0]) * arms[1] + (drag[1] - body[1]) * arms[0])


def _number(value: float) -> str:
    return repr(float(value))


def read_mjcf(path: Path) -> dict[str, float]:
    """Return name -> number of a model by this target."""
    root = ElementTree.fromstring(read_file(path))
    held: dict[str, float] = {}
    for element, keys in (
        ("inertial", ("mass", "diaginertia")),
        ("site", ("pos",)),
        ("general", ("gear", "dynprm", "biasprm", "ctrlrange")),
    ):
        for found in root.iter(element):
            for key in keys:
                for index, word in enumerate((found.get(key) or "").split()):
                    held[f"{found.get('name', '')} {key}[{index}]".strip()] = float(word)
    return held


def mujoco_draft(vehicle: VehicleFile, provenance: str, *_: object) -> Draft:
    """Return a model; the gate flies it in MuJoCo if that is installed."""
    flown = MUJOCO.flown(vehicle)
    inertia = flown.inertia
    wanted = {
        "mass[0]": flown.mass,
        **{f"diaginertia[{i}]": getattr(inertia, a) for i, a in enumerate(("xx", "yy", "zz"))},
    }
    for number, rotor in enumerate(flown.rotors):
        turn = (-1.0 if rotor.spin == "ccw" else 1.0) * flown.aerodynamics.moment_constant
        wanted |= {f"rotor_{number} pos[{i}]": at for i, at in enumerate(rotor.position)}
        wanted |= {
            f"rotor_{number} gear[5]": turn,
            f"rotor_{number} dynprm[0]": flown.motor.time_constant_up,
            f"rotor_{number} ctrlrange[1]": full_thrust(flown),
        }
    for axis, drag in zip("xyz", drag_at_hover(flown), strict=True):
        if drag:
            wanted[f"drag_{axis} biasprm[2]"] = -drag
    text = mjcf(flown, provenance)
    return Draft(
        text,
        flown,
        (),
        lambda path, _: differences(wanted, read_mjcf(path)),
        flier=_flier(text, flown),
    )


def _flier(text: str, vehicle: VehicleFile) -> Callable[..., Any] | None:
    """Return the flier of a model in MuJoCo; None if that is not installed."""
    try:
        import mujoco  # noqa: PLC0415 (an extra)
    except ImportError:
        return None
    try:
        model = mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ExportError(
            vehicle.name, f"MuJoCo does not take it ({error})", "report this"
        ) from None
    count, constant = len(vehicle.rotors), vehicle.aerodynamics.motor_constant

    class Flying:
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

    return flier_of(Flying)


TARGET = Target("mujoco", ".xml", mujoco_draft, MUJOCO)
