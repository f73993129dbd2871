"""What disturbs a flight: forces and moments, each a first-order Gauss-Markov process.

Gusts push as the world has it, slowly; thrust wanders fast, at each rotor by itself, which is a
thrust and three moments in the body. Each process d has a standard deviation σ and a time constant
τ: from one tick to the next it keeps exp(-h/τ) of itself.

They are counted as the accelerations that they cause, for that is what samples tell of: gains that
stay while mass and inertia move then correct a motion by as much as before, and tell nothing of
mass and inertia themselves.

Source: Gelb, "Applied optimal estimation", 1974, ch. 2 (Gauss-Markov process).
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from sim_jax.constants import GRAVITY
from sim_jax.environment import Disturbance
from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar
from sim_jax.vehicle import Vehicle

STRENGTHS = (
    "gust",
    "lift",
    "roll",
    "turbulence",
    "gust_lasts",
    "turbulence_lasts",
    "command_noise",
)
"""What is estimated of them: shares of the weight by which gusts push sideways and upwards, and
which they would need at a rotor's arm to turn the vehicle as they do; the share of itself by which
a rotor's thrust wanders; the s that both last. And how noisy recorded commands are, as a factor:
they answer to what pushes and hardly err, so that a filter leans on them, and inertias follow by
4 % where they are taken for a quarter noisier than they are."""
COMMAND_NOISE = STRENGTHS.index("command_noise")
USUAL = np.log([0.003, 0.001, 0.001, 0.003, 1.0, 0.03, 1.0])
"""Logarithms of what they are before anything is known."""
LEAST = np.log([3e-5, 3e-5, 3e-5, 3e-5, 0.2, 0.005, 0.02])
MOST = np.log([0.1, 0.1, 0.1, 0.1, 5.0, 0.15, 10.0])
"""Logarithms between which they are looked for."""
STRONGEST = 1.0
"""m/s, the strongest gusts along the rotors' axes by which a lift is explained."""
SLOW = ("force_x", "force_y", "force_z", "moment_x", "moment_y")
FAST = ("thrust", "moment_x", "moment_y", "moment_z")
COUNT = len(SLOW) + len(FAST)


class Processes(eqx.Module):
    """The processes of a vehicle, those of `SLOW` and then those of `FAST`.

    Attributes
    ----------
    sd
        (D, F) in m/s² and rad/s², each segment's own.
    acts
        (D,) kg and kg m²: what a unit of each process acts by, in N and N m.
    keeps
        (D, F) share that a process keeps from one tick to the next.
    draught
        (F,) m/s, standard deviation of the gusts along the rotors' axes.
    """

    sd: Float[Array, "D *F"]
    acts: Float[Array, " D"]
    keeps: Float[Array, "D *F"]
    draught: Scalar

    @property
    def added(self) -> Float[Array, "D *F"]:
        """The variances (D, F) that come anew with every tick."""
        return self.sd**2 * (1.0 - self.keeps**2)


def processes_of(vehicle: Vehicle, strengths: Float[Array, "7 *F"], rate: float) -> Processes:
    """Return the processes of a vehicle.

    Parameters
    ----------
    vehicle
        Whose weight, arms and moment constant say what a share of a thrust is.
    strengths
        (7, F) logarithms of `STRENGTHS`, each segment's own; (7,) where all share them.
    rate
        Hz of the ticks.
    """
    gust, lift, roll, turbulence, gust_lasts, turbulence_lasts, _ = jnp.exp(strengths)
    body, count = vehicle.body, len(vehicle.rotors)
    weight, turns = body.mass * GRAVITY, (body.inertia_xx, body.inertia_yy, body.inertia_zz)
    own = turbulence * weight / count
    width = jnp.sqrt(sum(rotor.position.y**2 for rotor in vehicle.rotors))
    length = jnp.sqrt(sum(rotor.position.x**2 for rotor in vehicle.rotors))
    arm = (width + length) / (2.0 * count**0.5)
    turning = vehicle.aerodynamics.moment_constant
    sd = [gust * weight, gust * weight, lift * weight, roll * weight * arm, roll * weight * arm]
    sd += [own * count**0.5, own * width, own * length, own * turning * count**0.5]
    lasts = [gust_lasts] * len(SLOW) + [turbulence_lasts] * len(FAST)
    acts = [body.mass, body.mass, body.mass, *turns[:2], body.mass, *turns]
    accelerations = [each / act for each, act in zip(sd, acts, strict=True)]
    draught = jnp.minimum(lift * vehicle.aerodynamics.max_relative_airspeed, STRONGEST)
    keeps = jnp.exp(-1.0 / rate / jnp.stack(lasts))
    return Processes(jnp.stack(accelerations), jnp.stack(acts), keeps, draught)


def disturbance_of(values: Float[Array, "D F"]) -> Disturbance:
    """Return the disturbance that values in N and N m are, the same throughout a tick."""
    rows: dict[str, Array] = {}
    for name, value in zip((*SLOW, *FAST), values, strict=True):
        rows[name] = rows[name] + value if name in rows else value

    def along(kind: str) -> Vec3:
        still = jnp.zeros_like(values[0])
        return Vec3(*(rows.get(f"{kind}_{axis}", still)[None] for axis in "xyz"))

    return Disturbance(force=along("force"), thrust=rows["thrust"][None], moment=along("moment"))


def within(strengths: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return strengths (7,), logarithms, inside their limits."""
    return np.clip(strengths, LEAST, MOST)
