"""Three components, each an array over the batch: the batch stays last in memory."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Float

from sim_jax.numeric import Array, Scalar, safe_sqrt


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
