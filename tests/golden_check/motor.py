"""Motor and rotor against the Gazebo motor model: the thesis's branch (hg) and upstream (up)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import Array

from sim_jax.environment import Air
from sim_jax.geometry import Vec3
from sim_jax.motor import Lag, reference_speed
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.terms import total_wrench
from sim_jax.vehicle import Aerodynamics, Body, Motor, Rotor, Setup, Vehicle
from tests.golden_check.table import Deviation, Table, deviation, merged

EXACT = 1e-12
SINGLE = 1e-6
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
    got = tuple(reference_speed(motor, command) for command in table.four("ctl"))
    limited = [
        jnp.minimum(table.column(f"ref{rotor}"), table.column("max_rot_vel")) for rotor in range(4)
    ]
    single = [table.column(f"ref{rotor}_f32_min") for rotor in range(4)]
    return [
        deviation("reference speed", got, limited, SINGLE),
        deviation("reference speed, single precision", got, single, SINGLE),
    ]


def rotor_filter(table: Table) -> list[Deviation]:
    return merged([_filter_sequence(part) for part in table.split("seq")])


def _filter_sequence(table: Table) -> list[Deviation]:
    motor = _motor(
        time_constant_up=jnp.asarray(table.only("tau_up")),
        time_constant_down=jnp.asarray(table.only("tau_down")),
    )
    lag = Lag.over(motor, table.only("dt"))

    def step(speed: Array, command: Array) -> tuple[Array, Array]:
        speed, _ = lag.advance(speed, command)
        return speed, speed

    _, speeds = jax.lax.scan(step, jnp.zeros(()), table.column("cmd"))
    return [deviation("rotor speed", speeds, table.column("state"), EXACT)]


def motor_model(table: Table) -> list[Deviation]:
    return merged([_motor_model(part) for part in table.split("variant", "dir")])


def _motor_model(table: Table) -> list[Deviation]:
    spin = int(table.only("dir"))
    attitude = table.quaternion("rotor_q")
    through_air = table.vector("v") - table.vector("wind_")
    speed = table.column("omega_signed")
    # A reversible rotor pushes the other way when it turns backwards; all else is the same.
    backwards = table.flag("reversible") & (speed < 0)
    thrust = jnp.where(backwards, -1.0, 1.0) * table.column("motor_constant")
    zero = jnp.zeros_like(speed)

    def wrench(**coefficients: Array) -> Wrench:
        names = (
            "motor_constant",
            "moment_constant",
            "rotor_drag_coefficient",
            "rolling_moment_coefficient",
        )
        axis = "world" if table.frame["variant"].iloc[0] == "hg" else "body"
        aerodynamics = Aerodynamics(
            *(coefficients.get(name, zero) for name in names), reaction_torque=axis
        )
        centre = Vec3.zeros(zero)
        vehicle = Vehicle(BODY, (Rotor(centre, spin),), _motor(), aerodynamics, Setup())
        motion = Motion(centre, through_air, attitude, centre)
        return total_wrench(vehicle, motion, (jnp.abs(speed),), Air.around(vehicle, motion))

    drag = {"rotor_drag_coefficient": table.column("rotor_drag")}
    rolling = {"rolling_moment_coefficient": table.column("rolling_moment")}
    push = {"motor_constant": thrust, "moment_constant": table.column("moment_constant")}
    pushed, dragged = wrench(**push), wrench(**drag)
    rolled, everything = wrench(**rolling), wrench(**push, **drag, **rolling)
    lag = Lag.over(
        _motor(
            time_constant_up=table.column("tau_up"), time_constant_down=table.column("tau_down")
        ),
        table.column("dt"),
    )
    after, _ = lag.advance(table.column("filter_prev"), table.column("cmd_f32_clamped"))

    return [
        deviation("thrust, rotor axes", pushed.force, table.vector("rel_force_"), EXACT),
        deviation("thrust", attitude.to_world(pushed.force), table.vector("thrust_world_"), EXACT),
        deviation(
            "rotor drag", attitude.to_world(dragged.force), table.vector("drag_world_"), EXACT
        ),
        deviation(
            "rolling moment",
            attitude.to_world(rolled.moment),
            table.vector("rolling_world_"),
            EXACT,
        ),
        deviation(
            "all moments",
            attitude.to_world(everything.moment),
            table.vector("torque_world_total_"),
            EXACT,
        ),
        deviation("rotor speed after the step", after, table.column("filter_new"), EXACT),
        deviation(
            "joint speed",
            spin * after / table.column("slowdown"),
            table.column("joint_vel_new"),
            EXACT,
        ),
    ]


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
