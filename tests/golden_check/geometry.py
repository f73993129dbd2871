"""Rotations, attitude laws and the position controller against mavros_controllers."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

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
    product, scaled = _product_and_columns(q, p)
    return [
        deviation("product", product, table.quaternion("qp"), EXACT),
        deviation("matrix", scaled, columns, EXACT),
    ]


@jax.jit
def _product_and_columns(q: Quaternion, p: Quaternion) -> tuple[Quaternion, list[Vec3]]:
    # Ours is made for unit quaternions; the original's grows with the squared norm of others.
    square = q.w**2 + q.x**2 + q.y**2 + q.z**2
    zero, one = jnp.zeros_like(q.w), jnp.ones_like(q.w)
    axes = Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one)
    return q.product(p), [q.normalized().to_world(axis) * square for axis in axes]


def attitude_of_acceleration(table: Table) -> list[Deviation]:
    wanted = table.quaternion("q")
    got = _attitude(table.vector("a"), _heading(table.column("yaw")))
    return [deviation("attitude", _signed_as(wanted, got), wanted, EXACT)]


_attitude = jax.jit(geometric.attitude_from_acceleration)


def _heading(yaw: Array) -> Vec3:
    return Vec3(*map(jnp.asarray, (np.cos(yaw), np.sin(yaw), np.zeros_like(yaw))))


@jax.jit
def _signed_as(wanted: Quaternion, got: Quaternion) -> Quaternion:
    """Return a rotation with the sign, which means nothing, that another has."""
    along = wanted.w * got.w + wanted.x * got.x + wanted.y * got.y + wanted.z * got.z
    return Quaternion.of(got.stacked() * jnp.where(along < 0, -1.0, 1.0))


def attitude_laws(table: Table) -> list[Deviation]:
    quaternion_law, matrix_law, thrust = _rates_and_thrust(
        _attitude_gains(table), table.vector("acc_"), table.quaternion("q"), table.quaternion("ref")
    )
    return [
        deviation("quaternion law", quaternion_law, table.vector("bres_w"), EXACT),
        deviation("rotation-matrix law", matrix_law, table.vector("lee_w"), EXACT),
        deviation("thrust", thrust, table.column("bres_thrust"), EXACT),
    ]


@eqx.filter_jit
def _rates_and_thrust(
    gains: AttitudeGains, acceleration: Vec3, now: Quaternion, wanted: Quaternion
) -> tuple[Vec3, Vec3, Array]:
    """Return the rates by the quaternion and by the rotation-matrix law, and the thrust."""
    constant = gains.time_constant
    return (
        geometric.quaternion_law(now, wanted, constant),
        geometric.rotation_matrix_law(now, wanted, constant),
        geometric.thrust_setpoint(gains, acceleration, now),
    )


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
    heading, feedback, wanted, goal = _wanted(
        gains, reference, place, velocity, _heading(table.column("yaw_in"))
    )
    used = _heading(table.column("yaw_used"))
    quaternion_law, matrix_law, thrust = _rates_and_thrust(
        _attitude_gains(table), wanted, now, goal
    )
    return [
        deviation("heading", [heading.x, heading.y], [used.x, used.y], EXACT),
        deviation("feedback acceleration", feedback, table.vector("afb_"), EXACT),
        deviation("wanted acceleration", wanted, table.vector("ades_"), EXACT),
        deviation(
            "wanted attitude",
            _signed_as(table.quaternion("qdes_"), goal),
            table.quaternion("qdes_"),
            EXACT,
        ),
        deviation("rate, quaternion law", quaternion_law, table.vector("bres_w"), EXACT),
        deviation("rate, rotation-matrix law", matrix_law, table.vector("lee_w"), EXACT),
        deviation("thrust", thrust, table.column("bres_thrust"), EXACT),
        deviation("published thrust", thrust, table.column("pub_thrust_f32"), SINGLE),
    ]


@eqx.filter_jit
def _wanted(
    gains: PositionGains,
    reference: geometric.ReferencePoint,
    place: Vec3,
    velocity: Vec3,
    given: Vec3,
) -> tuple[Vec3, Vec3, Vec3, Quaternion]:
    """Return heading, feedback and wanted acceleration, and the attitude that gives it."""
    heading = geometric.heading_of(gains, velocity) if gains.velocity_yaw else given
    feedback = geometric.feedback_acceleration(gains, reference, place, velocity)
    wanted = geometric.acceleration_setpoint(gains, reference, place, velocity, heading)
    return heading, feedback, wanted, geometric.attitude_from_acceleration(wanted, heading)


def _attitude_gains(table: Table) -> AttitudeGains:
    return AttitudeGains(
        time_constant=table.column("attctrl_tau"),
        normalized_constant=table.column("thrust_const"),
        normalized_offset=table.column("thrust_offset"),
    )
