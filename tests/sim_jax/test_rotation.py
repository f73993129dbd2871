"""Rotations form a group, and every view of one agrees with the others."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from jax import Array

from sim_jax.geometry import Quaternion, Vec3
from tests.sim_jax.derivatives import assert_derivatives

product, to_world, to_body, rotation_vector = map(
    jax.jit,
    (Quaternion.product, Quaternion.to_world, Quaternion.to_body, Quaternion.rotation_vector_to),
)
component = st.floats(-1.0, 1.0, allow_subnormal=False)


@st.composite
def rotations(draw: st.DrawFn) -> Quaternion:
    four = np.array([draw(component) for _ in range(4)])
    norm = float(np.linalg.norm(four))
    four = four / norm if norm > 1e-3 else np.array([1.0, 0.0, 0.0, 0.0])
    return Quaternion.of(jnp.asarray(four))


@st.composite
def vectors(draw: st.DrawFn) -> Vec3:
    return Vec3.of(jnp.asarray([10.0 * draw(component) for _ in range(3)]))


@jax.jit
def difference(a: Quaternion | Vec3, b: Quaternion | Vec3) -> Array:
    return jnp.abs(a.stacked() - b.stacked()).max()


def apart(a: Quaternion | Vec3, b: Quaternion | Vec3) -> float:
    return float(difference(a, b))


@given(rotations(), rotations(), rotations())
def test_product_is_associative_and_keeps_the_norm(
    a: Quaternion, b: Quaternion, c: Quaternion
) -> None:
    assert apart(product(product(a, b), c), product(a, product(b, c))) < 1e-14
    assert abs(float(jnp.sum(product(a, b).stacked() ** 2)) - 1.0) < 1e-14


@given(rotations())
def test_identity_and_inverse(a: Quaternion) -> None:
    identity = Quaternion.identity(a.w)
    assert apart(product(a, identity), a) == 0.0
    assert apart(product(a, a.conjugate()), identity) < 1e-15


@given(rotations(), rotations(), vectors())
def test_a_product_turns_first_by_the_second(a: Quaternion, b: Quaternion, v: Vec3) -> None:
    assert apart(to_world(product(a, b), v), to_world(a, to_world(b, v))) < 1e-13


@given(rotations(), vectors())
def test_to_body_undoes_to_world_and_lengths_stay(a: Quaternion, v: Vec3) -> None:
    turned = to_world(a, v)
    assert apart(to_body(a, turned), v) < 1e-13
    assert abs(float(turned.norm() - v.norm())) < 1e-13


@given(rotations(), vectors())
def test_turning_a_vector_is_the_sandwich_product(a: Quaternion, v: Vec3) -> None:
    sandwich = product(a.times_vector(v), a.conjugate())
    assert abs(float(sandwich.w)) < 1e-13
    assert apart(Vec3(sandwich.x, sandwich.y, sandwich.z), to_world(a, v)) < 1e-13


@given(rotations())
def test_axes_are_those_of_what_is_turned(a: Quaternion) -> None:
    up = Vec3.upward(a.w)
    assert apart(a.z_axis(), to_world(a, up)) < 1e-15
    assert apart(a.world_up(), to_body(a, up)) < 1e-15


def of_angles(roll: float, pitch: float, yaw: float) -> Quaternion:
    def about(angle: float, axis: str) -> Quaternion:
        parts = dict.fromkeys("xyz", jnp.asarray(0.0)) | {axis: jnp.asarray(np.sin(angle / 2))}
        return Quaternion(jnp.asarray(np.cos(angle / 2)), **parts)

    return about(yaw, "z").product(about(pitch, "y")).product(about(roll, "x"))


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_the_heading_is_the_yaw_angle(roll: float, pitch: float, yaw: float) -> None:
    attitude = of_angles(roll, pitch, yaw)
    wanted = Vec3.of(jnp.asarray([np.cos(yaw), np.sin(yaw), 0.0]))
    assert apart(attitude.heading(), wanted) < 1e-12


def test_the_heading_has_derivatives_even_where_the_nose_points_up() -> None:
    assert_derivatives(lambda q: Quaternion.of(q).heading(), jnp.asarray([0.9, 0.1, -0.2, 0.4]))
    upright = jnp.sqrt(jnp.asarray([0.5, 0.0, 0.5, 0.0]))
    slope = jax.jacfwd(lambda q: Quaternion.of(q).heading().stacked())(upright)
    assert np.isfinite(slope).all()


@given(rotations(), vectors())
def test_rotation_vector_leads_from_one_to_the_other(a: Quaternion, v: Vec3) -> None:
    small = v * 1e-4
    half = small.norm() / 2
    scale = float(jnp.sinc(half / jnp.pi)) / 2
    turn = Quaternion(jnp.cos(half), small.x * scale, small.y * scale, small.z * scale)
    after = product(a, turn)
    assert apart(rotation_vector(a, after), small) < 1e-9
    assert apart(rotation_vector(a, Quaternion.of(-after.stacked())), small) < 1e-9


@given(rotations(), vectors())
def test_advanced_keeps_the_norm_and_follows_the_rate(a: Quaternion, rate: Vec3) -> None:
    step = 1e-4
    after = a.advanced(a, rate, step)
    assert abs(float(jnp.sum(after.stacked() ** 2)) - 1.0) < 1e-14
    assert apart(rotation_vector(a, after), rate * step) < 1e-8


def test_a_quarter_turns_forward_to_the_left_and_left_to_the_back() -> None:
    quarter = Quaternion.of(jnp.asarray([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))
    forward, left = Vec3.of(jnp.asarray([1.0, 0.0, 0.0])), Vec3.of(jnp.asarray([0.0, 1.0, 0.0]))
    assert apart(quarter.to_world(forward), left) < 1e-15
    assert apart(quarter.to_world(left), forward * -1.0) < 1e-15
