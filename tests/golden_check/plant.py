"""The whole vehicle's wrench, its derivatives, and open-loop flights of a second."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from sim_jax.control.gains import Filters, MixerSettings
from sim_jax.environment import Air
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import ActuatorInlet
from sim_jax.rigid_body import Motion, acceleration, angular_acceleration
from sim_jax.rollout import rollout
from sim_jax.schedule import Schedule
from sim_jax.state import Start
from sim_jax.terms import total_wrench
from sim_jax.vehicle import PerRotor, Vehicle
from tests.golden_check.coefficients import GOLDEN_GRAVITY, golden_vehicle
from tests.golden_check.controllers import golden_controller
from tests.golden_check.runge_kutta import step_rk4
from tests.golden_check.table import Deviation, Table, deviation, merged

WRENCH = 1e-9
POSITION = 1e-4
"""m, against an independent integrator; the other quantities to the same share of their size."""
RATE = 1000
"""Hz of the integration."""
HELD = 20
"""Steps for which a reference speed is held."""
_rollout = eqx.filter_jit(rollout)

SETS = {0: "old", 1: "new"}
KINDS = ("param_set", "torque_frame_world", "z_rotor")


def _vehicle(table: Table) -> Vehicle:
    return golden_vehicle(
        SETS[int(table.only("param_set"))],
        rotor_height=table.only("z_rotor"),
        world_torque=bool(table.only("torque_frame_world")),
    )


def wrench(table: Table) -> list[Deviation]:
    return merged([_wrench(part) for part in table.split(*KINDS)])


def _wrench(table: Table) -> list[Deviation]:
    velocity = table.vector("v")
    motion = Motion(Vec3.zeros(velocity.x), velocity, table.quaternion("q"), table.vector("w"))
    force, moment, fall, turning, rolling = _moved(_vehicle(table), motion, table.four("Om"))
    return [
        deviation("force", force, table.vector("F"), WRENCH),
        deviation("moment", moment, table.vector("tau"), WRENCH),
        deviation("acceleration", fall, table.vector("dv"), WRENCH),
        deviation("attitude derivative", turning, table.quaternion("dq"), WRENCH),
        deviation("angular acceleration", rolling, table.vector("dw"), WRENCH),
    ]


@eqx.filter_jit
def _moved(
    vehicle: Vehicle, motion: Motion, speeds: PerRotor
) -> tuple[Vec3, Vec3, Vec3, Quaternion, Vec3]:
    """Return force and moment, world axes, and the derivatives of velocity, attitude and rate."""
    attitude, body_rate = motion.attitude, motion.body_rate
    acting = total_wrench(vehicle, motion, speeds, Air.around(vehicle, motion))
    now = jnp.zeros_like(body_rate.x)
    turning = jax.jvp(
        lambda time: attitude.advanced(attitude, body_rate, time), (now,), (jnp.ones_like(now),)
    )[1]
    return (
        attitude.to_world(acting.force),
        attitude.to_world(acting.moment),
        acceleration(vehicle.body, attitude, acting.force, gravity=GOLDEN_GRAVITY),
        turning,
        angular_acceleration(vehicle.body, body_rate, acting.moment),
    )


def open_loop(table: Table) -> list[Deviation]:
    return merged([_open_loop(part) for part in table.split("roll", *KINDS)])


def _open_loop(table: Table) -> list[Deviation]:
    vehicle = _vehicle(table)
    motor = vehicle.motor
    logged = table.frame["k"].to_numpy()
    held = np.arange(logged[-1] + 1) // HELD * HELD
    rows = np.searchsorted(logged, held)
    a, b, c, d = (
        (reference[rows] - motor.zero_position_armed) / motor.input_scaling
        for reference in table.four("ref")
    )
    there = Motion(table.vector("p"), table.vector("v"), table.quaternion("q"), table.vector("w"))
    motion, speeds = jax.tree.map(lambda leaf: leaf[0], (there, table.four("Om")))
    flown = _rollout(
        vehicle,
        golden_controller(Filters(None, None), MixerSettings()),
        Schedule(physics_rate=RATE, rate_control_rate=RATE, log_rate=RATE, integrator=step_rk4),
        ActuatorInlet((a, b, c, d)),
        Start(motion, speeds, (a[0], b[0], c[0], d[0]), Vec3.zeros(a[0])),
        samples=len(held),
        gravity=GOLDEN_GRAVITY,
    )
    at = jax.tree.map(lambda leaf: leaf[logged], flown.log)
    return [
        deviation("position", at.motion.position, there.position, POSITION, absolute=True),
        deviation("velocity", at.motion.velocity, there.velocity, POSITION),
        deviation("attitude", at.motion.attitude, there.attitude, POSITION),
        deviation("body rate", at.motion.body_rate, there.body_rate, POSITION),
        deviation("rotor speed", at.rotor_speed, table.four("Om"), WRENCH),
    ]
