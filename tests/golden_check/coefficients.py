"""The two sets of coefficients that the golden plants and flights were computed with."""

from __future__ import annotations

from math import sqrt

import jax.numpy as jnp

from sim_jax.geometry import Vec3
from sim_jax.vehicle import Aerodynamics, Body, Motor, Rotor, Setup, Vehicle

ARM = 0.25
"""m, from the centre of mass to a rotor's axis."""

GOLDEN_GRAVITY = 9.8066
"""m/s², of PX4's Gazebo worlds, in which the golden plant and flights were computed."""

BODIES = {
    "old": Body(2.079, 0.021, 0.021, 0.040),
    "new": Body(2.243, 0.028, 0.033, 0.038),
}
MOTORS = {
    "old": {"input_scaling": 1000.0},
    "new": {"input_scaling": 950.0},
}
AERODYNAMICS = {
    "old": {"motor_constant": 8.55e-6, "moment_constant": 0.06, "rotor_drag_coefficient": 8.06e-4},
    "new": {"motor_constant": 1.45e-5, "moment_constant": 0.033, "rotor_drag_coefficient": 1.45e-4},
}


def golden_vehicle(name: str, *, rotor_height: float = 0.0, world_torque: bool = False) -> Vehicle:
    """Return the thesis's original (``old``) or updated (``new``) vehicle, rotors in m above it."""
    side = ARM / sqrt(2.0)
    places = [(side, -side, 1), (-side, side, 1), (side, side, -1), (-side, -side, -1)]
    rotors = tuple(
        Rotor(Vec3(jnp.asarray(x), jnp.asarray(y), jnp.asarray(rotor_height)), spin)  # type: ignore[arg-type]
        for x, y, spin in places
    )
    return Vehicle(
        body=BODIES[name],
        rotors=rotors,  # type: ignore[arg-type]
        motor=Motor(
            zero_position_armed=100.0,
            max_rotor_velocity=1100.0,
            time_constant_up=0.0125,
            time_constant_down=0.025,
            **MOTORS[name],  # type: ignore[arg-type]
        ),
        aerodynamics=Aerodynamics(
            rolling_moment_coefficient=1e-6,
            reaction_torque="world" if world_torque else "body",
            **AERODYNAMICS[name],  # type: ignore[arg-type]
        ),
        setup=Setup(),
    )
