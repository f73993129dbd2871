"""The publisher's references: five shapes, a wind-up, and laps, one tick every 10 ms.

Everything the publisher does is kept, the odd things too: the velocity scaler runs time faster but
leaves the velocity and acceleration references alone, and some shapes have none.
"""

from __future__ import annotations

from typing import Literal, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import ArrayLike
from jaxtyping import Array, Int

from sim_jax.control.position import ReferencePoint
from sim_jax.numeric import Scalar
from sim_jax.vector import Vec3

ShapeName: TypeAlias = Literal["circle", "lemniscate", "straight", "diagonal", "stationary"]

TICK_RATE = 100
"""Hz at which the publisher ticks."""
WINDUP_STEP = 0.001
"""Wind-up per tick, from 0 to 1 in ten seconds."""
PUBLISHER_PI = 3.14
"""The publisher's own π, by which it counts laps."""
LEVEL = 1.0
"""m, the height that is written into the straight and the diagonal."""


def _number(value: ArrayLike) -> Scalar:
    return jnp.asarray(value, dtype=float)


class Shape(eqx.Module):
    """A closed curve, run through by an angle θ = omega·t."""

    name: ShapeName = eqx.field(static=True)
    radius: Scalar = eqx.field(converter=_number, default=2.0)
    """m."""
    omega: Scalar = eqx.field(converter=_number, default=0.7)
    """rad/s of the angle while time runs at its own pace."""
    origin: Vec3 = eqx.field(default_factory=lambda: Vec3(_number(0.0), _number(0.0), _number(1.0)))
    """m, centre of circle and lemniscate, place of the stationary reference. The straight and the
    diagonal do not look at it: they lie about (0, 0, 1)."""

    def at(self, time: Scalar) -> ReferencePoint:
        """Return position, velocity and acceleration reference at the shape's own time in s.

        Circle: r(cos θ, sin θ); velocity is omega·z × position taken from the world's origin, not
        the circle's, and acceleration omega·z × velocity. Lemniscate: r(cos θ, sin θ cos θ) with
        its velocity, no acceleration. Straight: r(cos θ, 0). Diagonal: r(cos θ, cos θ). Neither has
        velocity or acceleration.
        """
        angle = self.omega * time
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        still = Vec3.zeros(angle)
        zero, level = still.x, jnp.full_like(angle, LEVEL)
        along, turn = self.radius * cosine, self.omega
        if self.name == "straight":
            return ReferencePoint(Vec3(along, zero, level), still, still)
        if self.name == "diagonal":
            return ReferencePoint(Vec3(along, along, level), still, still)
        if self.name == "stationary":
            return ReferencePoint(still + self.origin, still, still)
        if self.name == "circle":
            position = Vec3(along, self.radius * sine, zero) + self.origin
            velocity = Vec3(-turn * position.y, turn * position.x, zero)
            return ReferencePoint(
                position, velocity, Vec3(-turn * velocity.y, turn * velocity.x, zero)
            )
        speed = self.radius * turn
        return ReferencePoint(
            Vec3(along, along * sine, zero) + self.origin,
            Vec3(-speed * sine, speed * (cosine * cosine - sine * sine), zero),
            still,
        )


class Publication(eqx.Module):
    """What the publisher sent at a tick; from `publish`, leaves are (ticks, \\*batch)."""

    points: ReferencePoint
    shape_time: Scalar
    """s, the time at which the shape was asked."""
    windup: Scalar
    """0..1."""
    lap: Int[Array, "*#batch"]
    """Laps completed."""


def publish(
    shape: Shape, *, ticks: int, velocity_scaler: Scalar | float = 1.0, start_tick: int = 0
) -> Publication:
    """Run the publisher from rest.

    Each tick: time moves on by 0.01 s · wind-up · velocity scaler with the old wind-up, a lap is
    counted when omega·time passes (lap + 1)·2·3.14, the wind-up grows, and velocity and
    acceleration are multiplied by the new wind-up.

    Parameters
    ----------
    shape
        Its numbers may be traced or carry a batch.
    ticks
        How many ticks of 10 ms, the first at time 0.
    velocity_scaler
        How much faster than its own pace the shape's time runs; may be traced or carry a batch.
    start_tick
        The tick from which time may run; before, the shape's first point is published at rest.
    """
    scaler = jnp.asarray(velocity_scaler, dtype=float)
    batch = jnp.broadcast_shapes(*(jnp.shape(leaf) for leaf in jax.tree.leaves((shape, scaler))))
    pace = jnp.broadcast_to(scaler / TICK_RATE, batch)
    lap_angle = 2.0 * PUBLISHER_PI

    def tick(
        carry: tuple[Scalar, Scalar, Array], number: Int[Array, ""]
    ) -> tuple[tuple[Scalar, Scalar, Array], Publication]:
        time, windup, lap = carry
        started = number >= start_tick
        time = time + jnp.where(started, windup * pace, 0.0)
        lap = lap + (shape.omega * time > (lap + 1) * lap_angle)
        windup = windup + jnp.where(started & (windup < 1), WINDUP_STEP, 0.0)
        point = shape.at(time)
        point = ReferencePoint(point.position, point.velocity * windup, point.acceleration * windup)
        return (time, windup, lap), Publication(point, time, windup, lap)

    rest = jnp.zeros(batch, pace.dtype)
    first = (rest, rest, jnp.zeros(batch, int))
    publication: Publication = jax.lax.scan(tick, first, jnp.arange(ticks))[1]
    return publication
