"""Air that pushes simulated flights: wind and rotors' thrusts that wander, both by chance."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.signal import lfilter

from sim_jax.constants import GRAVITY
from sim_jax.environment import Disturbance
from sim_jax.geometry import Vec3

GUST, GUST_TIME = 0.1, 1.0
"""m/s, standard deviation of the wind along x and y, half as much along z; s, it forgets."""
WANDER, WANDER_TIME = 0.004, 0.02
"""Share by which each rotor's thrust wanders, and s in which it forgets."""


def gauss_markov(
    random: np.random.Generator,
    shape: tuple[int, ...],
    *,
    deviation: float,
    seconds: float,
    rate: float,
) -> NDArray[np.float64]:
    """Return series of Ornstein and Uhlenbeck's process, time first, at a rate in Hz."""
    keep = np.exp(-1.0 / rate / seconds)
    steps = random.normal(size=shape) * deviation * np.sqrt(1.0 - keep**2)
    steps[0] /= np.sqrt(1.0 - keep**2)
    return np.asarray(lfilter([1.0], [1.0, -keep], steps, axis=0))


def air(
    random: np.random.Generator,
    *,
    shape: tuple[int, int],
    rate: float,
    mass: float,
    places: ArrayLike,
    spins: ArrayLike,
    moment_constant: float,
) -> Disturbance:
    """Return what pushes a vehicle with four rotors.

    Parameters
    ----------
    shape
        Ticks, and flights.
    rate
        Hz of the ticks: enough for what forgets in `WANDER_TIME`.
    mass
        kg.
    places
        (4, 3) m of the rotors from the centre of mass, body axes.
    spins
        (4,) +1 for a rotor that turns counter-clockwise seen from above.
    moment_constant
        m, a rotor's torque over its thrust.
    """
    ticks, flights = shape
    wind = gauss_markov(random, (ticks, 3, flights), deviation=GUST, seconds=GUST_TIME, rate=rate)
    wind *= np.array([1.0, 1.0, 0.5])[:, None]
    share = WANDER * mass * GRAVITY / 4.0
    thrust = gauss_markov(
        random, (ticks, 4, flights), deviation=share, seconds=WANDER_TIME, rate=rate
    )
    places, spins = np.asarray(places, float), np.asarray(spins, float)
    arms = (places[:, 1], -places[:, 0], -spins * moment_constant)
    return Disturbance(
        gust=Vec3(*(jnp.asarray(wind[:, axis]) for axis in range(3))),
        thrust=jnp.asarray(thrust.sum(axis=1)),
        moment=Vec3(*(jnp.asarray(np.einsum("r,trf->tf", arm, thrust)) for arm in arms)),
        rate=rate,
    )
