"""Disturbances of a flight: forces and moments, each a first-order Gauss-Markov process.

Gusts act slowly, along the world's axes; thrust fluctuates fast, at each rotor independently, which
is a thrust and three moments in the body. Each process has a standard deviation σ and a time
constant τ: from one tick to the next it keeps exp(-h/τ) of itself.

A gust is wind, which acts through the vehicle's own terms: drag grows with the airspeed, and
Gazebo's motors lose thrust by the length of the axial velocity, so that the effect of a gust turns
with the sign of that velocity. Taken for a force it resembles an inflow of thrust. Sideways a gust
also pushes, by what the terms lack; upwards a force of its own is what is left of the length.

Forces and moments are accelerations: fixed gains then correct a motion by the same amount while
mass and inertia move, and have no information on mass and inertia. So are gusts, by the drag of
rotors that hover: fixed gains have no information on drag but for that of the vehicle's own
motion. A hover tells the wind times the drag; how much of it is wind, and so the draught that takes
thrust, is known no better than the drag.

Sources: Gelb, "Applied optimal estimation", 1974, ch. 2 (Gauss-Markov process); MIL-F-8785C, 1980,
3.7.3.4 (near the ground gusts are half as strong upwards as sideways).
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
from sim_jax.vehicle import Vehicle

STRENGTHS = (
    "gust",
    "lift",
    "roll",
    "turbulence",
    "gust_lasts",
    "turbulence_lasts",
    "command_noise",
    "wind",
)
"""Estimated strengths: gusts' forces sideways and upwards as shares of the weight, and their moment
as the share at a rotor's arm; relative fluctuation of a rotor's thrust; correlation times of both
in s. A factor on the noise of recorded commands: these respond to disturbances nearly without
noise, so that the filter relies on them, and inertias are 4 % off for a factor of 1.25. And gusts'
velocity sideways in m/s."""
COMMAND_NOISE = STRENGTHS.index("command_noise")
INITIAL_STRENGTHS = np.log([0.001, 0.001, 0.001, 0.003, 1.0, 0.03, 1.0, 0.1])
"""Logarithms of the strengths at the start."""
MIN_STRENGTHS = np.log([3e-5, 3e-5, 3e-5, 3e-5, 0.2, 0.005, 0.02, 1e-3])
MAX_STRENGTHS = np.log([0.1, 0.1, 0.1, 0.1, 5.0, 0.15, 10.0, 5.0])
"""Bounds of their logarithms."""
UPWARDS = 0.5
"""Standard deviation of gusts upwards over that sideways."""
SLOW = ("gust_x", "gust_y", "gust_z", "force_z", "moment_x", "moment_y")
FAST = ("thrust", "moment_x", "moment_y", "moment_z")
PROCESSES = len(SLOW) + len(FAST)


class Processes(eqx.Module):
    """The processes of a vehicle, those of `SLOW` and then those of `FAST`.

    Attributes
    ----------
    sd
        (D, F) in m/s² and rad/s², each segment's own.
    acts
        (D, F) force and moment of each process over its acceleration, kg and kg m²; of gusts their
        velocity over it, s.
    pushes
        (F,) kg/s, force of a gust sideways over its velocity, beside what the airspeed does.
    retention
        (D, F) share that a process keeps from one tick to the next.
    """

    sd: Float[Array, "D *F"]
    acts: Float[Array, "D *F"]
    pushes: Float[Array, "*F"]
    retention: Float[Array, "D *F"]

    @property
    def added(self) -> Float[Array, "D *F"]:
        """The variances (D, F) of the driving noise of each tick."""
        return self.sd**2 * (1.0 - self.retention**2)

    def disturbance(self, values: Float[Array, "D F"]) -> Disturbance:
        """Return the disturbance of values in units of ``sd``, constant over a tick."""
        rows: dict[str, Array] = {}
        for name, value in zip((*SLOW, *FAST), (self.acts.T * values.T).T, strict=True):
            rows[name] = rows[name] + value if name in rows else value
        gust, moment = (
            Vec3(*(rows[f"{kind}_{axis}"][None] for axis in "xyz")) for kind in ("gust", "moment")
        )
        force = Vec3(self.pushes * gust.x, self.pushes * gust.y, rows["force_z"][None])
        return Disturbance(gust=gust, force=force, thrust=rows["thrust"][None], moment=moment)


def processes_of(vehicle: Vehicle, strengths: Float[Array, "8 *F"], rate: float) -> Processes:
    """Return the processes of a vehicle.

    Parameters
    ----------
    vehicle
        Gives weight, arms and moment constant.
    strengths
        (8, F) logarithms of `STRENGTHS`, each segment's own; (8,) where all share them.
    rate
        Hz of the ticks.
    """
    gust, lift, roll, turbulence, gust_lasts, turbulence_lasts, _, wind = jnp.exp(strengths)
    body, count = vehicle.body, len(vehicle.rotors)
    weight, turns = body.mass * GRAVITY, (body.inertia_xx, body.inertia_yy, body.inertia_zz)
    own = turbulence * weight / count
    width = jnp.sqrt(sum(rotor.position.y**2 for rotor in vehicle.rotors))
    length = jnp.sqrt(sum(rotor.position.x**2 for rotor in vehicle.rotors))
    arm = (width + length) / (2.0 * count**0.5)
    turning = vehicle.aerodynamics.moment_constant
    sd = [wind, wind, UPWARDS * wind, lift * weight, roll * weight * arm, roll * weight * arm]
    sd += [own * count**0.5, own * width, own * length, own * turning * count**0.5]
    lasts = [gust_lasts] * len(SLOW) + [turbulence_lasts] * len(FAST)
    pushes, rotors = gust * weight / wind, vehicle.aerodynamics
    speed = rotors.speed_at(jnp.asarray(weight / count))
    answers = body.mass / (pushes + count * speed * rotors.rotor_drag_coefficient)
    acts = [answers, answers, answers, body.mass, *turns[:2], body.mass, *turns]
    acts = [jnp.broadcast_to(act, pushes.shape) for act in acts]
    accelerations = [each / act for each, act in zip(sd, acts, strict=True)]
    retention = jnp.exp(-1.0 / rate / jnp.stack(lasts))
    return Processes(jnp.stack(accelerations), jnp.stack(acts), pushes, retention)


def clipped(strengths: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return strengths (8,), logarithms, inside their limits."""
    return np.clip(strengths, MIN_STRENGTHS, MAX_STRENGTHS)
