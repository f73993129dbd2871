"""Force and moment of each term of the simulator along a flight.

The thesis plots them (Fig. 8.2), to show which effect matters in which flight.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lanes import Argument, program_of
from sim_jax.constants import GRAVITY
from sim_jax.environment import Air, Environment
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import Array as JaxArray
from sim_jax.rigid_body import Motion
from sim_jax.terms import total
from sim_jax.terms.total import wrench_of_each_term
from sim_jax.vehicle import Vehicle
from tuner.core.numerics import Array
from tuner.objective.simulation import CODE

COMPONENTS = ("fx", "fy", "fz", "mx", "my", "mz")
"""Force in N and moment in N m, about the centre of mass in body axes."""
WEIGHT = "gravity"


@dataclass(frozen=True)
class Forces:
    """Force and moment of each term along a flight.

    The forces sum to mass times acceleration, the moments to the derivative of angular momentum.

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
        """Return the forces before a time in s."""
        inside = self.time < end
        return Forces(self.time[inside], {n: v[inside] for n, v in self.of_term.items()})


def forces_of_terms(
    vehicle: Vehicle,
    motion: Array,
    attitude: Array,
    rotor_speed: Array,
    *,
    rate: float,
    wind: tuple[Array, Array] | None = None,
    stride: int = 1,
) -> dict[str, Array]:
    """Return term -> (F, m, 6) force and moment at every ``stride``-th sample, as in `Forces`.

    The order is that of the simulator's terms, gravity last.

    Parameters
    ----------
    motion
        (F, n, 9) logged position, velocity (world) and body rate.
    attitude
        (F, n, 4) quaternion, body to world.
    rotor_speed
        (F, n, rotors) rad/s. A rotor's acceleration is the central difference of its logged speed.
    rate
        Hz of the log.
    wind
        (F,) m/s each, world x and y; None in still air.
    """
    accelerations = rate * np.gradient(rotor_speed, axis=1)
    logged = (motion, attitude, rotor_speed, accelerations)
    flights, samples = motion[:, ::stride].shape[:2]
    rows = [part[:, ::stride].reshape(flights * samples, -1).T for part in logged]
    calm = np.zeros(flights)
    air = [np.repeat(along, samples) for along in (*(wind or (calm, calm)), calm)]
    inputs = (jax.tree.map(np.asarray, vehicle), *rows, np.stack(air))
    of_vehicle, *of_lanes = inputs
    arguments = (
        jax.tree.map(partial(Argument.of, lanes=False), of_vehicle),
        *(Argument.of(rows, lanes=True) for rows in of_lanes),
    )
    program = program_of(
        _sample_forces, arguments, name="forces", made_of=total.TERMS, packages=CODE
    )
    acted: dict[str, Array] = program(inputs, lanes=flights * samples).values
    names = (*(term.__name__ for term in total.TERMS), WEIGHT)
    return {n: acted[n].reshape(flights, samples, 6) for n in names if n in acted}


def _sample_forces(inputs: Any, _: Mapping[str, int]) -> dict[str, JaxArray]:
    """Return term -> (6,) force and moment at one sample."""
    vehicle, motion, attitude, speeds, accelerations, wind = inputs
    rotors = len(vehicle.rotors)
    body_motion = Motion(
        Vec3.of(motion[0:3]), Vec3.of(motion[3:6]), Quaternion.of(attitude), Vec3.of(motion[6:9])
    )
    ambient = Environment(wind=Vec3.of(wind))
    rotor_speeds = tuple(speeds[i] for i in range(rotors))
    air = Air.around(vehicle, body_motion, ambient, tuple(accelerations[i] for i in range(rotors)))
    wrenches = wrench_of_each_term(vehicle, body_motion, rotor_speeds, air)
    parts = {
        name: (*_components(wrench.force), *_components(wrench.moment))
        for name, wrench in wrenches.items()
    }
    weight = air.up * (-GRAVITY * vehicle.body.mass)
    none = jnp.zeros(())
    parts[WEIGHT] = (*_components(weight), none, none, none)
    return {
        name: jnp.stack([jnp.broadcast_to(value, ()) for value in values])
        for name, values in parts.items()
    }


def forces_of(vehicle: Vehicle, time: Array, signals: Mapping[str, Array]) -> Forces:
    """Return force and moment of each term along a simulated flight.

    Parameters
    ----------
    time, signals
        Of a `tuner.evaluate.closed_loop.Simulation`.
    """
    rate = (len(time) - 1) / (time[-1] - time[0])
    names = ("position", "velocity", "body_rate")
    motion = np.concatenate([signals[name] for name in names], axis=1)
    logged = (motion, signals["attitude"], signals["rotor_speed"])
    parts = forces_of_terms(vehicle, *(np.asarray(part, float)[None] for part in logged), rate=rate)
    return Forces(time, {name: part[0] for name, part in parts.items()})


def _components(vector: Vec3) -> tuple[JaxArray, JaxArray, JaxArray]:
    return vector.x, vector.y, vector.z
