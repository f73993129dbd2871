"""A vehicle, its controllers and flights that several test files share."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from sim_jax.control.gains import Controller, Filters, MixerSettings
from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import ActuatorInlet
from sim_jax.rigid_body import Motion
from sim_jax.rollout import Rollout, rollout
from sim_jax.schedule import Schedule
from sim_jax.state import Start, hover
from sim_jax.trajectory import publish, shapes
from sim_jax.vehicle import Vehicle
from tests.golden_check.coefficients import golden_vehicle
from tests.golden_check.controllers import golden_controller

_compiled = eqx.filter_jit(rollout)


def compiled_rollout(*given: object, **named: object) -> Rollout:
    """Fly; a number that was Python's is of the kind of all others, and shares their program."""

    def strong(leaf: object) -> object:
        return jnp.asarray(leaf, leaf.dtype) if isinstance(leaf, Array) else leaf

    return _compiled(*jax.tree.map(strong, given), **jax.tree.map(strong, named))  # type: ignore[no-any-return]


def vehicle() -> Vehicle:
    """Return the thesis's updated vehicle, rotors 6 cm above the centre of mass."""
    return golden_vehicle("new", rotor_height=0.06)


def without_losses(craft: Vehicle) -> Vehicle:
    """Return the vehicle in an air that takes nothing away."""
    return eqx.tree_at(  # type: ignore[no-any-return]
        lambda v: (v.aerodynamics.rotor_drag_coefficient, v.aerodynamics.max_relative_airspeed),
        craft,
        (jnp.asarray(0.0), jnp.asarray(1e12)),
    )


def controller(*, filters: bool = True, **mixer: object) -> Controller:
    """Return the airframe's controllers, with PX4's default gyro filters."""
    cutoffs = Filters(jnp.asarray(40.0), jnp.asarray(20.0)) if filters else Filters(None, None)
    return golden_controller(cutoffs, MixerSettings(**mixer))  # type: ignore[arg-type]


def vec(x: float, y: float, z: float) -> Vec3:
    return Vec3(*(jnp.asarray(value, float) for value in (x, y, z)))


def quaternion(w: float, x: float, y: float, z: float) -> Quaternion:
    values = np.asarray([w, x, y, z], float) / np.linalg.norm([w, x, y, z])
    return Quaternion(*(jnp.asarray(value) for value in values))


def moving_start(craft: Vehicle) -> Start:
    """Return a vehicle in the midst of a manoeuvre."""
    level = hover(craft, vec(0.3, -0.2, 5.0))
    motion = Motion(
        vec(0.3, -0.2, 5.0), vec(1.5, -0.7, 0.4), quaternion(1.0, 0.1, -0.2, 0.4), vec(0.5, -0.8, 1)
    )
    return Start(motion, level.rotor_speed, level.command, level.rate_integral)


def wobble(craft: Vehicle, steps: int) -> ActuatorInlet:
    """Return commands around hover, each rotor to a rhythm of its own."""
    level = hover(craft, vec(0.0, 0.0, 1.0)).command[0]
    time = jnp.arange(steps) * 0.01
    a, b, c, d = (
        level + 0.02 * jnp.sin(frequency * time + phase)
        for frequency, phase in ((3.0, 0.0), (4.1, 1.0), (5.3, 2.0), (2.2, 3.0))
    )
    return ActuatorInlet((a, b, c, d))


def reference(name: str, *, ticks: int, velocity_scaler: float = 2.1) -> ReferencePoint:
    return publish(shapes()[name](), ticks=ticks, velocity_scaler=velocity_scaler).points


def at_first_point(craft: Vehicle, points: ReferencePoint) -> Start:
    return hover(craft, jax.tree.map(lambda leaf: leaf[0], points.position))


def open_loop(craft: Vehicle, inlet: ActuatorInlet, start: Start, **schedule: object) -> Rollout:
    """Fly motor commands at 400 Hz physics for a second, logging every step."""
    rates: dict[str, object] = {"log_rate": 400} | schedule
    return compiled_rollout(  # type: ignore[no-any-return]
        craft,
        controller(),
        Schedule(**rates),
        inlet,
        start,
        samples=400,  # type: ignore[arg-type]
    )


def apart(a: object, b: object) -> float:
    """Return the largest difference between two pytrees of numbers."""
    pairs = zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    return max(float(np.max(np.abs(np.asarray(x) - np.asarray(y)))) for x, y in pairs)


def finite(tree: object) -> bool:
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def scaled(craft: Vehicle, factor: float | Array) -> Vehicle:
    """Scale everything that has mass in its unit: no motion may change."""

    def of(v: Vehicle) -> list[Array]:
        return [
            v.body.mass,
            v.body.inertia_xx,
            v.body.inertia_yy,
            v.body.inertia_zz,
            v.aerodynamics.motor_constant,
            v.aerodynamics.rotor_drag_coefficient,
            v.aerodynamics.rolling_moment_coefficient,
        ]

    return eqx.tree_at(of, craft, [value * factor for value in of(craft)])  # type: ignore[no-any-return]
