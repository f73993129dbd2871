"""Vectors, and unit quaternions (w, x, y, z) from body to world, each component over the batch.

A component is an array of its own, so that the batch stays last in memory.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from sim_jax.numeric import Array, Scalar, safe_divide, safe_sqrt


class Vec3(eqx.Module):
    """A vector in three-space, component by component.

    Attributes
    ----------
    x, y, z
        Components, each of shape (\\*batch).
    """

    x: Scalar
    y: Scalar
    z: Scalar

    def __add__(self, other: Vec3) -> Vec3:
        return Vec3(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vec3) -> Vec3:
        return Vec3(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> Vec3:
        return Vec3(-self.x, -self.y, -self.z)

    def __mul__(self, factor: Scalar | float) -> Vec3:
        return Vec3(self.x * factor, self.y * factor, self.z * factor)

    __rmul__ = __mul__

    def scaled_by(self, other: Vec3) -> Vec3:
        """Multiply component by component."""
        return Vec3(self.x * other.x, self.y * other.y, self.z * other.z)

    def dot(self, other: Vec3) -> Scalar:
        """Return the inner product, shape (\\*batch)."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vec3) -> Vec3:
        """Return the cross product self × other."""
        return Vec3(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def norm(self) -> Scalar:
        """Return the length, with derivative zero at the zero vector."""
        return safe_sqrt(self.dot(self))

    def stacked(self) -> Float[Array, "3 *batch"]:
        """Return the components as one array, axis first."""
        return jnp.stack(jnp.broadcast_arrays(self.x, self.y, self.z))

    @staticmethod
    def zeros(like: Scalar) -> Vec3:
        """Return the zero vector in the shape and precision of a scalar."""
        zero = jnp.zeros_like(like)
        return Vec3(zero, zero, zero)

    @staticmethod
    def upward(like: Scalar, length: float = 1.0) -> Vec3:
        """Return the vector along z of a given length, shape and precision of a scalar."""
        zero = jnp.zeros_like(like)
        return Vec3(zero, zero, jnp.full_like(like, length))

    @staticmethod
    def of(values: Float[Array, "3 *batch"]) -> Vec3:
        """Take the components from the first axis of an array."""
        return Vec3(values[0], values[1], values[2])


SMALL_ANGLE = 1e-6
"""rad² below which sin(a)/a is its series."""


class Quaternion(eqx.Module):
    """A rotation from body to world.

    Attributes
    ----------
    w, x, y, z
        Scalar part first; each of shape (\\*batch).
    """

    w: Scalar
    x: Scalar
    y: Scalar
    z: Scalar

    def product(self, other: Quaternion) -> Quaternion:
        """Return the Hamilton product self ⊗ other: first other, then self."""
        return Quaternion(
            self.w * other.w - self.x * other.x - self.y * other.y - self.z * other.z,
            self.w * other.x + self.x * other.w + self.y * other.z - self.z * other.y,
            self.w * other.y - self.x * other.z + self.y * other.w + self.z * other.x,
            self.w * other.z + self.x * other.y - self.y * other.x + self.z * other.w,
        )

    def times_vector(self, vector: Vec3) -> Quaternion:
        """Return self ⊗ (0, v); with v = ½ω this is the derivative q̇ at body rate ω."""
        return Quaternion(
            -(self.x * vector.x + self.y * vector.y + self.z * vector.z),
            self.w * vector.x + self.y * vector.z - self.z * vector.y,
            self.w * vector.y + self.z * vector.x - self.x * vector.z,
            self.w * vector.z + self.x * vector.y - self.y * vector.x,
        )

    def conjugate(self) -> Quaternion:
        """Return the inverse rotation."""
        return Quaternion(self.w, -self.x, -self.y, -self.z)

    def normalized(self) -> Quaternion:
        """Return the same rotation with unit norm."""
        inverse = 1.0 / jnp.sqrt(self.w**2 + self.x**2 + self.y**2 + self.z**2)
        return Quaternion(self.w * inverse, self.x * inverse, self.y * inverse, self.z * inverse)

    def advanced(self, along: Quaternion, body_rate: Vec3, duration: Scalar | float) -> Quaternion:
        """Return self + duration · ½ along ⊗ (0, ω), normalised: one step of q̇ = ½ q ⊗ ω.

        Parameters
        ----------
        along
            The rotation at which the derivative is taken.
        body_rate
            rad/s, body frame.
        duration
            s.
        """
        turn = along.times_vector(body_rate * (0.5 * duration))
        return Quaternion(
            self.w + turn.w, self.x + turn.x, self.y + turn.y, self.z + turn.z
        ).normalized()

    def to_world(self, body: Vec3) -> Vec3:
        """Turn a body vector into world coordinates: q ⊗ (0, v) ⊗ q⁻¹ as v + w t + u × t.

        u is the vector part and t = 2 u × v: the same work as through a matrix, in fewer pieces.
        """
        axis = Vec3(self.x, self.y, self.z)
        twice = axis.cross(body) * 2.0
        return body + twice * self.w + axis.cross(twice)

    def to_body(self, world: Vec3) -> Vec3:
        """Turn a world vector into body coordinates: q⁻¹ ⊗ (0, v) ⊗ q."""
        return self.conjugate().to_world(world)

    def world_up(self) -> Vec3:
        """Return the world's z axis in body coordinates."""
        return Vec3(
            2.0 * (self.x * self.z - self.w * self.y),
            2.0 * (self.y * self.z + self.w * self.x),
            1.0 - 2.0 * (self.x * self.x + self.y * self.y),
        )

    def z_axis(self) -> Vec3:
        """Return the body's z axis in world coordinates."""
        return Vec3(
            2.0 * (self.x * self.z + self.w * self.y),
            2.0 * (self.y * self.z - self.w * self.x),
            1.0 - 2.0 * (self.x * self.x + self.y * self.y),
        )

    def heading(self) -> Vec3:
        """Return the body's x axis, seen from above: (cos ψ, sin ψ, 0) in world coordinates."""
        east = 1.0 - 2.0 * (self.y * self.y + self.z * self.z)
        north = 2.0 * (self.w * self.z + self.x * self.y)
        length = safe_sqrt(east * east + north * north)
        upright = length > 0
        zero = jnp.zeros_like(length)
        return Vec3(
            jnp.where(upright, safe_divide(east, length), 1.0), safe_divide(north, length), zero
        )

    def rotation_vector_to(self, other: Quaternion) -> Vec3:
        """Return the small rotation from self to other as a body vector in rad.

        Twice the vector part of the error quaternion: exact to third order, with a derivative
        everywhere, which the exact logarithm has not at the identity.
        """
        error = self.conjugate().product(other)
        sign = jnp.where(error.w < 0, -2.0, 2.0)
        return Vec3(sign * error.x, sign * error.y, sign * error.z)

    def stacked(self) -> Float[Array, "4 *batch"]:
        """Return the components as one array, axis first."""
        return jnp.stack(jnp.broadcast_arrays(self.w, self.x, self.y, self.z))

    @staticmethod
    def of(values: Float[Array, "4 *batch"]) -> Quaternion:
        """Take the components from the first axis of an array."""
        return Quaternion(values[0], values[1], values[2], values[3])

    @staticmethod
    def identity(like: Scalar) -> Quaternion:
        """Return the rotation that does nothing, in the shape and precision of a scalar."""
        zero = jnp.zeros_like(like)
        return Quaternion(jnp.ones_like(like), zero, zero, zero)


def rotation(vector: Vec3) -> Quaternion:
    """Return the rotation by a vector in rad, exp(vector / 2), with its derivative at zero."""
    square = 0.25 * vector.dot(vector)
    small = square < SMALL_ANGLE
    half = safe_sqrt(jnp.where(small, 1.0, square))
    cosine = jnp.where(small, 1.0 - square / 2.0, jnp.cos(half))
    scale = 0.5 * jnp.where(small, 1.0 - square / 6.0, jnp.sin(half) / half)
    turn = vector * scale
    return Quaternion(cosine, turn.x, turn.y, turn.z)
