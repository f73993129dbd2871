"""Flights that could be flown next inside an arena: the simulator's reference and a name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tuner.config import TrajectorySettings
from tuner.errors import InputError
from tuner.simulation.trajectory import at_speed

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

#: Shape -> half its extent along x and y for a radius of 1.
EXTENT = {
    "circle": (1.0, 1.0),
    "lemniscate": (1.0, 0.5),
    "straight": (1.0, 0.0),
    "diagonal": (1.0, 1.0),
}
#: Shape -> the most that its reference is accelerated at a peak speed v and radius r, in v²/r.
BEND = {"circle": 1.0, "lemniscate": 1.1, "straight": 1.0, "diagonal": 0.71}


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
    """Return every shape in two sizes and several speeds, and yaw spins."""
    flights = []
    for shape, (along_x, along_y) in EXTENT.items():
        widest = (arena.x / 2 - CLEARANCE) / along_x
        if along_y:
            widest = min(widest, (arena.y / 2 - CLEARANCE) / along_y)
        for radius in dict.fromkeys(max(widest * share, SMALLEST) for share in (1.0, 0.5)):
            flights += [
                _shape(shape, round(radius, 2), speed)
                for speed in SPEEDS
                if BEND[shape] * speed**2 / radius <= HARDEST
            ]
    flights += [
        Candidate(
            f"a yaw spin at {rate:g} rad/s", TrajectorySettings(name="yaw_spin", yaw_rate=rate)
        )
        for rate in YAW_RATES
    ]
    return tuple(flights)


def _shape(shape: str, radius: float, speed: float) -> Candidate:
    name = {
        "circle": f"a circle of {radius:g} m radius",
        "lemniscate": f"a lemniscate of {2 * radius:g} m length",
        "straight": f"a straight line of {2 * radius:g} m",
        "diagonal": f"a diagonal across {2 * radius:g} m",
    }[shape]
    settings = TrajectorySettings.model_validate({"name": shape, "radius": radius})
    return Candidate(f"{name} at {speed:g} m/s", at_speed(settings, speed))
