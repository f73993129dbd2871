"""How far recorded motion and recorded inputs are from balance: errors in what is fed in.

A simulation that is fed measured rotor speeds is fed their errors too: noise, and a drift within
seconds. Least squares on what comes out then shrinks what the rotors do, the more the noisier they
are, and raises the damping that stands in for it (errors in variables). A loop that flies makes it
worse: rotors answer what disturbs the vehicle, and cancel it. Seen from the other side there is
no such bias: the motion is known well, what the rotors must have done follows from it, and errors
are in what they are said to have done (inverse regression; Fuller, Measurement Error Models, 1987).

Newton's and Euler's equations are weighed with a smooth function φ over stretches of a window; its
derivative takes the place of accelerations, which nobody recorded (modulating functions, Shinbrot
1957). With R the attitude, F and M what acts, in body axes::

    ∫ φ (R F) dt + ∫ φ' m v dt - m g,     ∫ φ (M - ω x Iω) dt + ∫ φ' Iω dt

What is left, as a change of the rotors' squared speeds that would make up for it, is the residual.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Float
from numpy.typing import NDArray

from sim_jax.constants import GRAVITY
from sim_jax.crash import AIRBORNE
from sim_jax.numeric import Array
from sim_jax.rigid_body import Motion
from sim_jax.rotation import Quaternion
from sim_jax.terms.air import Air
from sim_jax.terms.total import total_wrench
from sim_jax.vector import Vec3
from sim_jax.vehicle import PerRotor, Vehicle
from tuner.objective.criterion import Point
from tuner.objective.flown import fly
from tuner.objective.normal import Objective
from tuner.objective.space import Tunable
from tuner.recordings.flight import Flight
from tuner.recordings.states import states_at

STRETCH = 0.2
"""s that the equations are weighed over: noise beyond some 5 Hz is averaged out."""
FASTEST = 100
"""Hz at which the equations are evaluated, about."""


class Balance(eqx.Module):
    """Recorded motion of F windows at n times each, and what their rotors are said to have done.

    Attributes
    ----------
    motion
        Leaves (n, F).
    rotor_speed, rotor_acceleration
        rad/s and rad/s², each (n, F).
    weight, slope
        (S, n) φ of S stretches, its sum over the times 1, and φ' likewise, in 1/s.
    """

    motion: Motion
    rotor_speed: PerRotor
    rotor_acceleration: PerRotor
    weight: Float[Array, "S n"]
    slope: Float[Array, "S n"]

    @eqx.filter_jit
    def residuals(self, tunable: Tunable, vector: ArrayLike) -> Float[Array, "6 S F"]:
        """Return what forces and moments lack, in squares of rotor speeds.

        Forces along the body's axes in the middle of each stretch, then moments about them; those
        about x and y stand for squares at an arm of a metre.
        """
        return self._residuals(tunable, jnp.asarray(vector))

    @eqx.filter_jit
    def jacobian(self, tunable: Tunable, vector: ArrayLike) -> Float[Array, "6 S F K"]:
        """Return the residuals' derivatives by the search vector."""
        moved: Array = jax.jacfwd(lambda v: self._residuals(tunable, v))(jnp.asarray(vector))
        return moved

    def _residuals(self, tunable: Tunable, vector: Array) -> Array:
        vehicle = tunable.at(vector).vehicle
        air = Air.around(vehicle, self.motion, rotor_acceleration=self.rotor_acceleration)
        acting = total_wrench(vehicle, self.motion, self.rotor_speed, air)
        force = self._force_lacking(vehicle, acting.force)
        moment = self._moment_lacking(vehicle, acting.moment)
        aerodynamics = vehicle.aerodynamics
        of_square = aerodynamics.motor_constant
        about_shaft = of_square * aerodynamics.moment_constant
        return jnp.concatenate(
            [force / of_square, moment[:2] / of_square, moment[2:] / about_shaft]
        )

    def _force_lacking(self, vehicle: Vehicle, acting: Vec3) -> Array:
        """Return what Newton's equation lacks, (3, S, F) N."""
        attitude, mass = self.motion.attitude, vehicle.body.mass
        weight = jnp.asarray([0.0, 0.0, mass * GRAVITY])[:, None, None]
        lacking = (
            self._over(self.weight, attitude.to_world(acting))
            + mass * self._over(self.slope, self.motion.velocity)
            - weight
        )
        middle = jnp.argmax(self.weight, axis=1)
        there: Quaternion = jax.tree.map(lambda leaf: leaf[middle], attitude)
        return there.to_body(Vec3.of(lacking)).stacked()

    def _moment_lacking(self, vehicle: Vehicle, acting: Vec3) -> Array:
        """Return what Euler's equation lacks, (3, S, F) N m."""
        body, rate = vehicle.body, self.motion.body_rate
        momentum = rate.scaled_by(Vec3(body.inertia_xx, body.inertia_yy, body.inertia_zz))
        return self._over(self.weight, acting - rate.cross(momentum)) + self._over(
            self.slope, momentum
        )

    @staticmethod
    def _over(weights: Float[Array, "S n"], values: Vec3) -> Float[Array, "3 S F"]:
        return jnp.einsum("sn,anf->asf", weights, values.stacked())


def balance_of(objective: Objective, point: Point, flights: Sequence[Flight]) -> Balance:
    """Return the recorded motion in an objective's windows, and its rotors' speeds.

    Parameters
    ----------
    objective, point
        Windows from recorded states; where commands are fed in they turn the rotors as at the
        point.
    flights
        The fitted ones, in the objective's order.
    """
    step = max(1, objective.schedule.log_rate // FASTEST)
    rate, samples = objective.schedule.log_rate / step, -(-objective.samples // step)
    segments, flight = objective.segments, np.asarray(objective.segments.flight)
    time = segments.begins[:, None] + np.arange(samples) / rate
    columns: dict[str, NDArray[np.float64]] = {
        name: np.full((samples, size, segments.count), np.nan)
        for name, size in {"position": 3, "velocity": 3, "attitude": 4, "body_rate": 3}.items()
    }
    for number, recorded in enumerate(flights):
        windows = np.flatnonzero(flight == number)
        states = states_at(recorded.series, time[windows].ravel())
        for name, table in columns.items():
            rows = getattr(states, name).reshape(len(windows), samples, -1)
            table[..., windows] = np.moveaxis(rows, 0, -1)
    position, velocity, attitude, body_rate = (
        jnp.moveaxis(jnp.asarray(table), 1, 0) for table in columns.values()
    )
    model = objective.tunable.at(jnp.asarray(point.coefficients))
    logged = fly(
        model,
        segments,
        objective.schedule,
        samples=objective.samples,
        limits=AIRBORNE,
        channels=("rotor_speed",),
    ).channels["rotor_speed"]
    speeds = tuple(jnp.asarray(speed) for speed in logged.T[:, ::step])
    weight, slope = _smooth(samples, rate)
    return Balance(
        Motion(Vec3.of(position), Vec3.of(velocity), Quaternion.of(attitude), Vec3.of(body_rate)),
        speeds,
        tuple(jnp.asarray(np.gradient(speed, 1.0 / rate, axis=0)) for speed in speeds),
        weight,
        slope,
    )


def _smooth(samples: int, rate: float) -> tuple[Array, Array]:
    """Return Hann's window every half `STRETCH`, and its slope: (S, n) each."""
    count = round(STRETCH * rate)
    firsts = range(0, samples - count, max(1, count // 2))
    weight, slope = np.zeros((2, len(firsts), samples))
    phase = 2.0 * np.pi * np.arange(count + 1) / count
    for row, first in enumerate(firsts):
        weight[row, first : first + count + 1] = (1.0 - np.cos(phase)) / count
        slope[row, first : first + count + 1] = np.sin(phase) * 2.0 * np.pi / count * rate / count
    return jnp.asarray(weight), jnp.asarray(slope)
