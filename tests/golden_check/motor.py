"""Motor and rotor against the Gazebo motor model: the thesis's branch (hg) and upstream (up)."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from sim_jax.environment import Air
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import Lag, reference_speed
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.terms import total_wrench
from sim_jax.vehicle import Aerodynamics, Body, Motor, PerRotor, Rotor, Setup, Vehicle
from tests.golden_check.table import Deviation, Table, deviation, merged

EXACT = 1e-12
SINGLE = 1e-6
COLUMNS = (
    "omega_signed",
    "reversible",
    "motor_constant",
    "moment_constant",
    "rotor_drag",
    "rolling_moment",
)
BODY = Body(1.0, 1.0, 1.0, 1.0)
"""Any: what acts on it does not depend on its mass."""


def command_map(table: Table) -> list[Deviation]:
    table = table.where(table.frame["armed"] > 0)  # the simulated motors are always armed
    motor = _motor(
        input_scaling=table.column("scaling"),
        zero_position_armed=table.column("zero_armed"),
        max_rotor_velocity=table.column("max_rot_vel"),
        input_offset=table.column("offset"),
    )
    got = _reference_speeds(motor, table.four("ctl"))
    limited = [
        jnp.minimum(table.column(f"ref{rotor}"), table.column("max_rot_vel")) for rotor in range(4)
    ]
    single = [table.column(f"ref{rotor}_f32_min") for rotor in range(4)]
    return [
        deviation("reference speed", got, limited, SINGLE),
        deviation("reference speed, single precision", got, single, SINGLE),
    ]


@jax.jit
def _reference_speeds(motor: Motor, commands: PerRotor) -> PerRotor:
    return tuple(reference_speed(motor, command) for command in commands)


def rotor_filter(table: Table) -> list[Deviation]:
    return merged([_filter_sequence(part) for part in table.split("seq")])


def _filter_sequence(table: Table) -> list[Deviation]:
    motor = _motor(
        time_constant_up=jnp.asarray(table.only("tau_up")),
        time_constant_down=jnp.asarray(table.only("tau_down")),
    )
    speeds = _followed(motor, jnp.asarray(table.only("dt")), table.column("cmd"))
    return [deviation("rotor speed", speeds, table.column("state"), EXACT)]


@jax.jit
def _followed(motor: Motor, dt: Array, commands: Array) -> Array:
    """Return the rotor speed after each command."""
    lag = Lag.over(motor, dt)

    def step(speed: Array, command: Array) -> tuple[Array, Array]:
        speed, _ = lag.advance(speed, command)
        return speed, speed

    return jax.lax.scan(step, jnp.zeros(()), commands)[1]


def motor_model(table: Table) -> list[Deviation]:
    return merged([_motor_model(part) for part in table.split("variant", "dir")])


def _motor_model(table: Table) -> list[Deviation]:
    spin = int(table.only("dir"))
    axis = "world" if table.frame["variant"].iloc[0] == "hg" else "body"
    pushed, thrust, drag, rolling, moments = _acting(
        spin,
        axis,
        table.quaternion("rotor_q"),
        table.vector("v") - table.vector("wind_"),
        {name: table.column(name) for name in COLUMNS},
    )
    after = _after_a_step(
        _motor(
            time_constant_up=table.column("tau_up"), time_constant_down=table.column("tau_down")
        ),
        table.column("dt"),
        table.column("filter_prev"),
        table.column("cmd_f32_clamped"),
    )
    return [
        deviation("thrust, rotor axes", pushed, table.vector("rel_force_"), EXACT),
        deviation("thrust", thrust, table.vector("thrust_world_"), EXACT),
        deviation("rotor drag", drag, table.vector("drag_world_"), EXACT),
        deviation("rolling moment", rolling, table.vector("rolling_world_"), EXACT),
        deviation("all moments", moments, table.vector("torque_world_total_"), EXACT),
        deviation("rotor speed after the step", after, table.column("filter_new"), EXACT),
        deviation(
            "joint speed",
            spin * after / table.column("slowdown"),
            table.column("joint_vel_new"),
            EXACT,
        ),
    ]


@eqx.filter_jit
def _acting(
    spin: int,
    axis: Literal["world", "body"],
    attitude: Quaternion,
    through_air: Vec3,
    known: dict[str, Array],
) -> tuple[Vec3, Vec3, Vec3, Vec3, Vec3]:
    """Return thrust in rotor and in world axes, and there drag, rolling moment and all moments."""
    speed = known["omega_signed"]
    # A reversible rotor pushes the other way when it turns backwards; all else is the same.
    constant = (
        jnp.where((known["reversible"] > 0) & (speed < 0), -1.0, 1.0) * known["motor_constant"]
    )
    zero = jnp.zeros_like(speed)

    def wrench(**coefficients: Array) -> Wrench:
        names = (
            "motor_constant",
            "moment_constant",
            "rotor_drag_coefficient",
            "rolling_moment_coefficient",
        )
        aerodynamics = Aerodynamics(
            *(coefficients.get(name, zero) for name in names), reaction_torque=axis
        )
        centre = Vec3.zeros(zero)
        vehicle = Vehicle(BODY, (Rotor(centre, spin),), _motor(), aerodynamics, Setup())
        motion = Motion(centre, through_air, attitude, centre)
        return total_wrench(vehicle, motion, (jnp.abs(speed),), Air.around(vehicle, motion))

    drag = {"rotor_drag_coefficient": known["rotor_drag"]}
    rolling = {"rolling_moment_coefficient": known["rolling_moment"]}
    push = {"motor_constant": constant, "moment_constant": known["moment_constant"]}
    thrust = wrench(**push).force
    return (
        thrust,
        attitude.to_world(thrust),
        attitude.to_world(wrench(**drag).force),
        attitude.to_world(wrench(**rolling).moment),
        attitude.to_world(wrench(**push, **drag, **rolling).moment),
    )


@jax.jit
def _after_a_step(motor: Motor, dt: Array, speed: Array, command: Array) -> Array:
    return Lag.over(motor, dt).advance(speed, command)[0]


def _motor(**known: Array) -> Motor:
    zero = jnp.zeros(())
    names = (
        "input_scaling",
        "zero_position_armed",
        "max_rotor_velocity",
        "time_constant_up",
        "time_constant_down",
    )
    return Motor(**dict.fromkeys(names, zero) | known)
