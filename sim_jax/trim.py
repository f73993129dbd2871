"""A vehicle in trim: the level hover in which nothing pushes or turns it.

An offset centre of mass, uneven rotors or a steady moment ask different rotors for different
speeds, which the rate controller's integrator has found long before a mission starts. And the
commands that are on their way to the motors then are those that hold these speeds: the first that
is recorded may answer the mission's first set-point already.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TypeAlias

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from sim_jax.constants import GRAVITY
from sim_jax.control.gains import Controller
from sim_jax.control.mixer import ROTORS, torque_of
from sim_jax.environment import Air
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import command_of
from sim_jax.numeric import Array, Scalar, where
from sim_jax.rigid_body import Motion
from sim_jax.state import Start, hover_speed
from sim_jax.terms import total_wrench
from sim_jax.vehicle import PerRotor, Vehicle

_Row: TypeAlias = list[Scalar]


def trimmed_start(
    vehicle: Vehicle,
    controller: Controller,
    start: Start,
    resting: Bool[Array, "*batch"],
    *,
    speed_factor: Scalar | None = None,
) -> Start:
    """Return a start whose rotors and integrator are in trim where the vehicle rests.

    Parameters
    ----------
    vehicle, controller
        Of the flight. One without four rotors starts as it would without this.
    start
        Level where it rests.
    resting
        Where the vehicle hovers.
    speed_factor
        The battery's factor on reference rotor speeds at the start; None for one.
    """
    if len(vehicle.rotors) != ROTORS:
        return start
    speeds = trim_speeds(vehicle)
    asked = speeds if speed_factor is None else tuple(speed / speed_factor for speed in speeds)
    commands = tuple(command_of(vehicle.motor, speed) for speed in asked)
    integral = torque_of(controller.mixer, commands)
    recorded = start.rotor_speed, start.command, start.rate_integral
    return Start(start.motion, *where(resting, (speeds, commands, integral), recorded))


def trim_speeds(vehicle: Vehicle) -> PerRotor:
    """Return the speeds in rad/s at which four rotors carry the weight and all moments cancel.

    At rest in still air every force and moment is linear in what the motor constant multiplies, the
    squares of the rotor speeds, so that four of these follow from Newton's and Euler's equations in
    equilibrium. With another ``thrust_exponent`` they are those of other speeds.
    """
    exponent = vehicle.effects.get("thrust_exponent")
    if exponent is not None:
        others = {name: e for name, e in vehicle.effects.items() if name != "thrust_exponent"}
        squares = trim_speeds(replace(vehicle, effects=others))
        hovering = hover_speed(vehicle)
        return tuple(speed * (speed / hovering) ** (2.0 / exponent - 1.0) for speed in squares)
    rest = Vec3.zeros(vehicle.body.mass)
    motion = Motion(rest, rest, Quaternion.identity(rest.x), rest)
    air = Air.around(vehicle, motion, rotor_acceleration=(rest.x,) * ROTORS)

    def lift_and_moments(speeds: Float[Array, " 4"]) -> tuple[Scalar, ...]:
        wrench = total_wrench(vehicle, motion, tuple(unit * speed for speed in speeds), air)
        return wrench.force.z, wrench.moment.x, wrench.moment.y, wrench.moment.z

    unit = jnp.ones_like(rest.x)
    # one after the other, so that what acts is compiled once
    none, *columns = zip(*lax.map(lift_and_moments, np.eye(1 + ROTORS, ROTORS, -1)), strict=True)
    weight = vehicle.body.mass * GRAVITY
    wanted = [weight - none[0], -none[1], -none[2], -none[3]]
    rows = [
        [*(column[axis] - none[axis] for column in columns), wanted[axis]] for axis in range(ROTORS)
    ]
    return tuple(jnp.sqrt(jnp.maximum(square, 1.0)) for square in _solve_rows(rows))


def _solve_rows(rows: list[_Row]) -> _Row:
    """Return the solution of rows (matrix | right side), by elimination in their order.

    That order never divides by zero for a quad X: lift, roll, pitch and yaw of rotors front right,
    rear left, front left, rear right.
    """
    rows = [list(row) for row in rows]
    for pivot in range(len(rows)):
        for below in range(pivot + 1, len(rows)):
            share = rows[below][pivot] / rows[pivot][pivot]
            rows[below] = [b - share * p for b, p in zip(rows[below], rows[pivot], strict=True)]
    solution: _Row = []
    for row in reversed(rows):
        known = row[-1 - len(solution) : -1]
        rest = row[-1] - sum((a * x for a, x in zip(known, solution, strict=True)), 0.0 * row[-1])
        solution.insert(0, rest / row[-2 - len(solution)])
    return solution
