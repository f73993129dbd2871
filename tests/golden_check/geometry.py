"""Rotations, attitude laws and the position controller against mavros_controllers."""

from __future__ import annotations

import jax.numpy as jnp

from sim_jax.control import geometric
from sim_jax.control.gains import AttitudeGains, PositionGains
from sim_jax.geometry import Quaternion, Vec3
from tests.golden_check.table import Deviation, Table, deviation, merged

EXACT = 1e-12
SINGLE = 1e-6


def quaternion_operations(table: Table) -> list[Deviation]:
    q, p = table.quaternion("q"), table.quaternion("p")
    rows = [Vec3(*(table.column(f"R{row}{column}") for column in range(3))) for row in range(3)]
    columns = [Vec3(*(getattr(row, axis) for row in rows)) for axis in "xyz"]
    # Ours is made for unit quaternions; the original's grows with the squared norm of others.
    square = q.w**2 + q.x**2 + q.y**2 + q.z**2
    zero, one = jnp.zeros_like(q.w), jnp.ones_like(q.w)
    axes = Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one)
    scaled = [q.normalized().to_world(axis) * square for axis in axes]
    return [
        deviation("product", q.product(p), table.quaternion("qp"), EXACT),
        deviation("matrix", scaled, columns, EXACT),
    ]


def attitude_of_acceleration(table: Table) -> list[Deviation]:
    yaw = table.column("yaw")
    heading = Vec3(jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw))
    got = geometric.attitude_from_acceleration(table.vector("a"), heading)
    wanted = table.quaternion("q")
    return [deviation("attitude", _signed_as(wanted, got), wanted, EXACT)]


def _signed_as(wanted: Quaternion, got: Quaternion) -> Quaternion:
    """Return a rotation with the sign, which means nothing, that another has."""
    along = wanted.w * got.w + wanted.x * got.x + wanted.y * got.y + wanted.z * got.z
    return Quaternion.of(got.stacked() * jnp.where(along < 0, -1.0, 1.0))


def attitude_laws(table: Table) -> list[Deviation]:
    now, wanted = table.quaternion("q"), table.quaternion("ref")
    constant = table.column("attctrl_tau")
    thrust = geometric.thrust_setpoint(_attitude_gains(table), table.vector("acc_"), now)
    return [
        deviation(
            "quaternion law",
            geometric.quaternion_law(now, wanted, constant),
            table.vector("bres_w"),
            EXACT,
        ),
        deviation(
            "rotation-matrix law",
            geometric.rotation_matrix_law(now, wanted, constant),
            table.vector("lee_w"),
            EXACT,
        ),
        deviation("thrust", thrust, table.column("bres_thrust"), EXACT),
    ]


def position_controller(table: Table) -> list[Deviation]:
    return merged([_position_controller(part) for part in table.split("velocity_yaw")])


def _position_controller(table: Table) -> list[Deviation]:
    follows_velocity = bool(table.only("velocity_yaw"))
    gains = PositionGains(
        kp=table.vector("Kp_"),
        kv=table.vector("Kv_"),
        max_feedback_acceleration=table.column("max_acc"),
        reference_drag=table.vector("drag_"),
        velocity_yaw=follows_velocity,
    )
    reference = geometric.ReferencePoint(
        table.vector("tp_"), table.vector("tv_"), table.vector("ta_")
    )
    place, velocity, now = table.vector("p_"), table.vector("v_"), table.quaternion("q")
    yaw = table.column("yaw_in")
    given = Vec3(jnp.cos(yaw), jnp.sin(yaw), jnp.zeros_like(yaw))
    heading = geometric.heading_of(gains, velocity) if follows_velocity else given
    used = table.column("yaw_used")
    feedback = geometric.feedback_acceleration(gains, reference, place, velocity)
    wanted = geometric.acceleration_setpoint(gains, reference, place, velocity, heading)
    goal = geometric.attitude_from_acceleration(wanted, heading)
    attitude_gains = _attitude_gains(table)
    constant = attitude_gains.time_constant
    thrust = geometric.thrust_setpoint(attitude_gains, wanted, now)
    return [
        deviation("heading", [heading.x, heading.y], [jnp.cos(used), jnp.sin(used)], EXACT),
        deviation("feedback acceleration", feedback, table.vector("afb_"), EXACT),
        deviation("wanted acceleration", wanted, table.vector("ades_"), EXACT),
        deviation(
            "wanted attitude",
            _signed_as(table.quaternion("qdes_"), goal),
            table.quaternion("qdes_"),
            EXACT,
        ),
        deviation(
            "rate, quaternion law",
            geometric.quaternion_law(now, goal, constant),
            table.vector("bres_w"),
            EXACT,
        ),
        deviation(
            "rate, rotation-matrix law",
            geometric.rotation_matrix_law(now, goal, constant),
            table.vector("lee_w"),
            EXACT,
        ),
        deviation("thrust", thrust, table.column("bres_thrust"), EXACT),
        deviation("published thrust", thrust, table.column("pub_thrust_f32"), SINGLE),
    ]


def _attitude_gains(table: Table) -> AttitudeGains:
    return AttitudeGains(
        time_constant=table.column("attctrl_tau"),
        normalized_constant=table.column("thrust_const"),
        normalized_offset=table.column("thrust_offset"),
    )
