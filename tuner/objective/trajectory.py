"""A named trajectory as the simulator's reference, as the thesis's publisher would send it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache

import jax
import numpy as np
from numpy.typing import NDArray

from lanes import Argument, Program
from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.numeric import Array, Scalar
from sim_jax.trajectory import TICK_RATE, Shape, publish, shapes
from tuner.config import MAX_SPEED_SCALE, TrajectorySettings
from tuner.core.errors import InputError
from tuner.objective.criterion import picked
from tuner.objective.simulation import CODE
from tuner.recordings.flight import Flight


@dataclass(frozen=True)
class FlightReference:
    """A reference over a whole flight.

    Attributes
    ----------
    inlet
        The simulator's input, one point a control tick.
    lap
        (ticks,) laps completed at each control tick.
    """

    inlet: ReferenceInlet
    lap: NDArray[np.int64]

    @property
    def start(self) -> Vec3:
        """The first point, m."""
        return picked(self.inlet.points.position, 0)

    @property
    def signals(self) -> dict[str, NDArray[np.float64]]:
        """The reference at each control tick, (ticks, 3) each, in m, m/s and m/s²."""
        points = self.inlet.points
        parts = {
            "reference_position": points.position,
            "reference_velocity": points.velocity,
            "reference_acceleration": points.acceleration,
        }
        return {n: np.column_stack([v.x, v.y, v.z]).astype(float) for n, v in parts.items()}


def published(
    settings: TrajectorySettings, *, duration: float, control_rate: float
) -> FlightReference:
    """Return the reference of a trajectory from rest.

    Parameters
    ----------
    settings
        Shape and its numbers.
    duration
        s.
    control_rate
        Hz of the position controller, which sees the last of the publisher's 100 Hz ticks.
    """
    shape = shapes()[settings.name](
        radius=np.asarray(settings.radius), omega=np.asarray(settings.omega)
    )
    ticks = math.ceil(duration * TICK_RATE) + 1
    given = jax.tree.map(lambda number: np.reshape(number, 1), (shape, settings.speed_scale))
    *axes, lap = _publisher(type(shape))(given, lanes=1, turns=ticks).values
    count = math.ceil(duration * control_rate) + 1
    seen = np.minimum(np.floor(np.arange(count) * TICK_RATE / control_rate + 1e-9), ticks - 1)
    rows = seen.astype(int)
    seen_axes = [axis[0, rows] for axis in axes]
    points = ReferencePoint(*(Vec3(*seen_axes[first : first + 3]) for first in (0, 3, 6)))
    return FlightReference(
        ReferenceInlet(
            points,
            spins=np.asarray(shape.spins),
            yaw_rate=np.asarray(settings.yaw_rate if shape.spins else 0.0),
        ),
        lap[0, rows],
    )


@cache
def _publisher(shape: type[Shape]) -> Program:
    def sent(given: tuple[Shape, Scalar], lengths: Mapping[str, int]) -> list[Array]:
        publication = publish(given[0], ticks=lengths["turns"], velocity_scaler=given[1])
        return [*jax.tree.leaves(publication.points), publication.lap]

    number = Argument((), float, lanes=True)
    arguments = jax.tree.map(lambda _: number, (shape(), 1.0))
    return Program(sent, arguments, name=shape.name, made_of=shape, packages=CODE)


def build_publishers() -> None:
    """Have the kernels of all trajectories on disk."""
    for shape in shapes().values():
        _publisher(shape).build()


def with_named_reference(flight: Flight, settings: TrajectorySettings) -> Flight:
    """Return a recording without a reference with that of a named trajectory.

    The publisher is taken to have started with the mission.
    """
    sent = published(settings, duration=flight.duration, control_rate=flight.rate)
    reference = {name: values[: len(flight.time)] for name, values in sent.signals.items()}
    spins = shapes()[settings.name].spins
    spin = settings.yaw_rate if spins else flight.yaw_rate_setpoint
    return replace(flight, signals={**flight.signals, **reference}, yaw_rate_setpoint=spin)


def at_speed(settings: TrajectorySettings, speed: float) -> TrajectorySettings:
    """Return the trajectory with the velocity scaler at which its reference peaks at a speed.

    Parameters
    ----------
    settings
        Shape and its numbers.
    speed
        m/s.

    Raises
    ------
    InputError
        The trajectory stays in one place, or the speed is none.
    """
    peak = shapes()[settings.name].peak_speed
    if not peak:
        raise InputError("--speed", f"{settings.name} stays in one place", "leave it out")
    per_scale = peak * settings.radius * settings.omega
    if not 0 < speed <= MAX_SPEED_SCALE * per_scale:
        remedy = f"give m/s above zero, up to {MAX_SPEED_SCALE * per_scale:g}"
        raise InputError("--speed", f"{speed:g} m/s is no speed", remedy)
    return settings.replace(speed_scale=speed / per_scale)
