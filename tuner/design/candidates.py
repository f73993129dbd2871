"""Flights that could be flown next inside an arena: the simulator's reference and a name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from sim_jax.trajectory import Shape, shapes
from tuner.config import TrajectorySettings
from tuner.core.errors import InputError
from tuner.objective.trajectory import at_speed

CLEARANCE = 0.5
"""Distance that a reference keeps from the walls, from which a vehicle may stray, m."""
LEVEL = 1.0
"""Height above the ground at which the publisher's shapes are flown, m."""
SPEEDS = (1.5, 3.0, 4.5, 6.0)
"""Peak speeds of the reference, m/s."""
YAW_RATES = (1.0, 2.0, 4.0, 6.0)
"""Yaw rates of the spins, rad/s."""
SMALLEST = 0.5
"""Radius of a shape below which it is not worth flying, m."""
HARDEST = 9.0
"""Acceleration of the reference beyond which it is not proposed, some 45° of tilt; m/s²."""


@dataclass(frozen=True)
class Arena:
    """A box about the origin, from wall to wall along x and y and from the ground up; m."""

    x: float
    y: float
    z: float

    @staticmethod
    def of(numbers: Sequence[float]) -> Arena:
        """Return an arena from its three lengths.

        Raises
        ------
        InputError
            They are not three, or too small to fly in.
        """
        if len(numbers) != 3:
            raise InputError("--arena", "needs three lengths in m", "write it as 8,6,3")
        arena = Arena(*numbers)
        smallest = 2 * CLEARANCE + 2 * SMALLEST
        if min(arena.x, arena.y) < smallest or arena.z < LEVEL + CLEARANCE:
            raise InputError(
                "--arena",
                f"{arena.x:g} by {arena.y:g} by {arena.z:g} m is too small to fly in",
                f"give at least {smallest:g},{smallest:g},{LEVEL + CLEARANCE:g}",
            )
        return arena


@dataclass(frozen=True)
class Candidate:
    """A flight that could be flown, and its name: shape, size and speed in words."""

    name: str
    trajectory: TrajectorySettings


def candidates(arena: Arena) -> tuple[Candidate, ...]:
    """Return every shape that moves in two sizes and several speeds, and the yaw spins."""
    flights: list[Candidate] = []
    for shape in shapes().values():
        flights += _spins(shape) if shape.spins else _moving(shape, arena)
    return tuple(flights)


def _moving(shape: type[Shape], arena: Arena) -> Iterator[Candidate]:
    walls = zip((arena.x, arena.y), shape.extent, strict=True)
    widest = [(wall / 2 - CLEARANCE) / extent for wall, extent in walls if extent]
    for share in (1.0, 0.5) if widest and shape.peak_speed else ():
        radius = max(min(widest) * share, SMALLEST)
        settings = TrajectorySettings(name=shape.name, radius=round(radius, 2))
        for speed in SPEEDS:
            if shape.peak_acceleration * speed**2 / radius <= HARDEST:
                name = f"{_noun(shape)} of {settings.radius:g} m radius at {speed:g} m/s"
                yield Candidate(name, at_speed(settings, speed))


def _spins(shape: type[Shape]) -> Iterator[Candidate]:
    for rate in YAW_RATES:
        settings = TrajectorySettings(name=shape.name, yaw_rate=rate)
        yield Candidate(f"{_noun(shape)} at {rate:g} rad/s", settings)


def _noun(shape: type[Shape]) -> str:
    return f"a {shape.name.replace('_', ' ')}"
