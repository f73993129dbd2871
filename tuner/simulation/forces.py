"""What acted along a simulated flight: the force and moment of each term of the simulator.

The thesis draws them so (Fig. 8.2), to see which effect matters in which flight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array as JaxArray
from jaxtyping import Float

from sim_jax.environment import NOTHING_AROUND, Environment
from sim_jax.numeric import GRAVITY
from sim_jax.rigid_body import Motion
from sim_jax.rotation import Quaternion
from sim_jax.terms.air import Air
from sim_jax.terms.total import TERMS, wrench_of_each_term
from sim_jax.vector import Vec3
from sim_jax.vehicle import PerRotor, Vehicle
from tuner.flights.flight import Array

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Force in N and moment in N m, about the centre of mass in body axes."""
WEIGHT = "gravity"
T = TypeVar("T")


@dataclass(frozen=True)
class Forces:
    """Force and moment of each term along a flight.

    Together the forces are mass times acceleration, the moments the rate of change of the angular
    momentum.

    Attributes
    ----------
    time
        (n,) s since the flight's start.
    of_term
        Term -> (n, 6) in N and N m, body axes; see `COMPONENTS`. Gravity is one of them.
    """

    time: Array
    of_term: Mapping[str, Array]

    def before(self, end: float) -> Forces:
        """Return what acted until a time in s."""
        inside = self.time < end
        return Forces(self.time[inside], {n: v[inside] for n, v in self.of_term.items()})


def acting(
    vehicle: Vehicle,
    motion: Motion,
    rotor_speed: PerRotor,
    environment: Environment = NOTHING_AROUND,
    *,
    rate: float,
) -> dict[str, Float[JaxArray, "n 6 *batch"]]:
    """Return term -> what acted at each sample of a log, as in `Forces`.

    Parameters
    ----------
    vehicle
        What flew.
    motion, rotor_speed
        The log, leaves (n, \\*batch).
    environment
        What surrounded the flight.
    rate
        Hz of the log. A rotor's acceleration is the central difference of its logged speed.
    """
    accelerations = tuple(rate * jnp.asarray(jnp.gradient(s, axis=0)) for s in rotor_speed)
    air = Air.around(vehicle, motion, environment, accelerations)
    shape = jnp.broadcast_shapes(motion.velocity.x.shape, jnp.shape(vehicle.body.mass))
    wrenches = wrench_of_each_term(vehicle, motion, rotor_speed, air)
    parts = {
        name: (*_components(wrench.force), *_components(wrench.moment))
        for name, wrench in wrenches.items()
    }
    pull = air.up * (-GRAVITY * vehicle.body.mass)
    none = jnp.zeros(())
    parts[WEIGHT] = (*_components(pull), none, none, none)
    return {
        name: jnp.stack([jnp.broadcast_to(value, shape) for value in values], axis=1)
        for name, values in parts.items()
    }


def forces_of(vehicle: Vehicle, time: Array, signals: Mapping[str, Array]) -> Forces:
    """Return what acted along a simulated flight.

    Parameters
    ----------
    vehicle
        What flew.
    time, signals
        Of a `tuner.simulation.simulate.Simulation`.
    """
    columns = {
        name: tuple(jnp.asarray(column) for column in np.asarray(signals[name]).T)
        for name in ("position", "velocity", "attitude", "body_rate", "rotor_speed")
    }
    motion = Motion(
        position=Vec3(*columns["position"]),
        velocity=Vec3(*columns["velocity"]),
        attitude=Quaternion(*columns["attitude"]),
        body_rate=Vec3(*columns["body_rate"]),
    )
    rate = (len(time) - 1) / (time[-1] - time[0])
    parts = _acting_alone(vehicle, motion, columns["rotor_speed"], rate)
    return Forces(time, in_order({name: np.asarray(part) for name, part in parts.items()}))


def in_order(parts: Mapping[str, T]) -> dict[str, T]:
    """Return term -> what belongs to it, in the order of the simulator's terms, gravity last."""
    names = (*(term.__name__ for term in TERMS), WEIGHT)
    return {name: parts[name] for name in names if name in parts}


@jax.jit
def _acting_alone(
    vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, rate: float
) -> dict[str, JaxArray]:
    return acting(vehicle, motion, rotor_speed, rate=rate)


def _components(vector: Vec3) -> tuple[JaxArray, JaxArray, JaxArray]:
    return vector.x, vector.y, vector.z
