"""The publisher's references: shapes, a wind-up, and laps, one tick every 10 ms.

Everything the publisher does is kept, the odd things too: the velocity scaler runs time faster but
leaves the velocity and acceleration references alone, and some shapes have none.
"""

from __future__ import annotations

import abc
import math
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Int

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.numeric import Array, Scalar

TICK_RATE = 100
"""Hz at which the publisher ticks."""
WINDUP_STEP = 0.001
"""Wind-up per tick, from 0 to 1 in ten seconds."""
PUBLISHER_PI = 3.14
"""The publisher's own π, by which it counts laps."""
FLIGHT_HEIGHT = 1.0
"""m, the height that is written into the straight and the diagonal."""


def _number(value: ArrayLike) -> Scalar:
    return jnp.asarray(value, float) if isinstance(value, jax.Array) else np.asarray(value, float)


class Shape(eqx.Module):
    """A closed curve, run through by an angle θ = omega·t; each subclass is one trajectory.

    A subclass needs nothing beside itself: `shapes` finds it, a configuration may name it, ``tune
    simulate`` flies it, and the design of next flights proposes it where it moves or spins.
    """

    name: ClassVar[str]
    """Its name in configuration files."""
    peak_speed: ClassVar[float] = 0.0
    """Largest speed of the curve, in radius·omega; 0 for a place."""
    peak_acceleration: ClassVar[float] = 0.0
    """Largest acceleration of the curve, in peak speed²/radius; 0 for a place."""
    extent: ClassVar[tuple[float, float]] = (0.0, 0.0)
    """Half of what the curve spans along x and along y, in radius."""
    spins: ClassVar[bool] = False
    """Whether the vehicle is commanded a constant yaw rate instead of the position reference."""

    radius: Scalar = eqx.field(converter=_number, default=2.0)
    """m."""
    omega: Scalar = eqx.field(converter=_number, default=0.7)
    """rad/s of the angle while time runs at its own pace."""
    origin: Vec3 = eqx.field(default_factory=lambda: Vec3(_number(0.0), _number(0.0), _number(1.0)))
    """m, centre of circle and lemniscate, place of hover and yaw spin. The straight and the
    diagonal do not look at it: they lie about (0, 0, 1)."""

    @abc.abstractmethod
    def position(self, angle: Scalar) -> Vec3:
        """Return the position reference, m."""

    def velocity(self, angle: Scalar) -> Vec3:
        """Return the velocity reference that the publisher sends, m/s; for most shapes none."""
        return Vec3.zeros(angle)

    def acceleration(self, angle: Scalar) -> Vec3:
        """Return the acceleration reference that the publisher sends, m/s²; for most none."""
        return Vec3.zeros(angle)

    def at(self, time: Scalar) -> ReferencePoint:
        """Return position, velocity and acceleration reference at the shape's own time in s."""
        angle = self.omega * time
        return ReferencePoint(self.position(angle), self.velocity(angle), self.acceleration(angle))


class Circle(Shape):
    """A circle, whose velocity and acceleration turn about the world's origin, not its own."""

    name = "circle"
    peak_speed = 1.0
    peak_acceleration = 1.0
    extent = (1.0, 1.0)

    def position(self, angle: Scalar) -> Vec3:
        """Return origin + r(cos θ, sin θ)."""
        still = jnp.zeros_like(angle)
        circle = Vec3(self.radius * jnp.cos(angle), self.radius * jnp.sin(angle), still)
        return circle + self.origin

    def velocity(self, angle: Scalar) -> Vec3:
        """Return omega·z × position."""
        return self._turned(self.position(angle))

    def acceleration(self, angle: Scalar) -> Vec3:
        """Return omega·z × velocity."""
        return self._turned(self.velocity(angle))

    def _turned(self, vector: Vec3) -> Vec3:
        """Return omega·z × vector."""
        return Vec3(-self.omega * vector.y, self.omega * vector.x, jnp.zeros_like(vector.z))


class Lemniscate(Shape):
    """A lemniscate of Gerono; the publisher sends no acceleration."""

    name = "lemniscate"
    peak_speed = math.sqrt(2)
    peak_acceleration = 1.1
    extent = (1.0, 0.5)

    def position(self, angle: Scalar) -> Vec3:
        """Return origin + r(cos θ, sin θ cos θ)."""
        along = self.radius * jnp.cos(angle)
        return Vec3(along, along * jnp.sin(angle), jnp.zeros_like(angle)) + self.origin

    def velocity(self, angle: Scalar) -> Vec3:
        """Return the derivative of the position while time runs at its own pace."""
        speed = self.radius * self.omega
        cosine, sine = jnp.cos(angle), jnp.sin(angle)
        across = speed * (cosine * cosine - sine * sine)
        return Vec3(-speed * sine, across, jnp.zeros_like(angle))


class Straight(Shape):
    """A line along x."""

    name = "straight"
    peak_speed = 1.0
    peak_acceleration = 1.0
    extent = (1.0, 0.0)

    def position(self, angle: Scalar) -> Vec3:
        """Return (0, 0, 1) + r(cos θ, 0)."""
        still = jnp.zeros_like(angle)
        return Vec3(self.radius * jnp.cos(angle), still, jnp.full_like(angle, FLIGHT_HEIGHT))


class Diagonal(Shape):
    """A line along x = y."""

    name = "diagonal"
    peak_speed = math.sqrt(2)
    peak_acceleration = 0.71
    extent = (1.0, 1.0)

    def position(self, angle: Scalar) -> Vec3:
        """Return (0, 0, 1) + r(cos θ, cos θ)."""
        along = self.radius * jnp.cos(angle)
        return Vec3(along, along, jnp.full_like(angle, FLIGHT_HEIGHT))


class Hover(Shape):
    """A place."""

    name = "hover"

    def position(self, angle: Scalar) -> Vec3:
        """Return the origin."""
        return Vec3.zeros(angle) + self.origin


class YawSpin(Shape):
    """A place at which the vehicle is commanded a constant yaw rate."""

    name = "yaw_spin"
    spins = True

    def position(self, angle: Scalar) -> Vec3:
        """Return the origin."""
        return Vec3.zeros(angle) + self.origin


def shapes() -> dict[str, type[Shape]]:
    """Return every trajectory by its name, in the order of their definition."""
    return {shape.name: shape for shape in Shape.__subclasses__()}


class Publication(eqx.Module):
    """The published reference at a tick; from `publish`, leaves are (ticks, \\*batch)."""

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
    return _published(shape, jnp.broadcast_to(scaler / TICK_RATE, batch), ticks, start_tick)


@eqx.filter_jit
def _published(shape: Shape, pace: Scalar, ticks: int, start_tick: int) -> Publication:
    """Run the publisher at a pace in seconds of the shape per tick, compiled once per shape."""
    batch = pace.shape
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
    publication: Publication = jax.lax.scan(tick, first, jnp.arange(ticks))[1]  # type: ignore[arg-type]
    return publication
