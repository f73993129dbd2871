"""The environment of a flight: wind, battery, gusts, disturbances, and the airflow at rotors."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float, Int, PyTree

from sim_jax.geometry import Vec3
from sim_jax.numeric import Array, Scalar, row_of
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.schedule import Schedule
from sim_jax.vehicle import PerRotor, Vehicle


class Disturbance(eqx.Module):
    """Series with a value for every tick, linear in between; what is None is not there.

    After its end the last value stays.
    """

    gust: Vec3 | None = None
    """m/s, world ENU, leaves (ticks, \\*batch): the air's velocity beside the steady wind."""
    force: Vec3 | None = None
    """N, world ENU, leaves (ticks, \\*batch): acts at the centre of mass."""
    thrust: Float[Array, "ticks *batch"] | None = None
    """N along body z."""
    moment: Vec3 | None = None
    """N m about the centre of mass, body axes, leaves (ticks, \\*batch)."""
    rate: float | None = eqx.field(static=True, default=None)
    """Hz of the ticks; None for those of position control."""

    def during(self, step: Int[Array, ""], schedule: Schedule) -> Disturbance:
        """Return the values in the middle of a physics step, every leaf (\\*batch)."""
        rate = schedule.position_control_rate if self.rate is None else self.rate
        ticks = (step + 0.5) * (rate / schedule.physics_rate)
        tick = jnp.floor(ticks)
        before, share = tick.astype(step.dtype), ticks - tick

        def between(old: Array, new: Array) -> Array:
            return old + share.astype(old.dtype) * (new - old)

        now: Disturbance = jax.tree.map(between, row_of(self, before), row_of(self, before + 1))
        return now

    def plus(self, other: Disturbance) -> Disturbance:
        """Return the sum of both, in this one's ticks."""

        def both(first: Any, second: Any) -> Any:
            return first if second is None else second if first is None else first + second

        return Disturbance(
            gust=both(self.gust, other.gust),
            force=both(self.force, other.force),
            thrust=both(self.thrust, other.thrust),
            moment=both(self.moment, other.moment),
            rate=self.rate,
        )

    def added_to(self, wrench: Wrench, motion: Motion) -> Wrench:
        """Return the wrench about the centre of mass with added disturbances (\\*batch)."""
        force, moment = wrench.force, wrench.moment
        if self.force is not None:
            force = force + motion.attitude.to_body(self.force)
        if self.thrust is not None:
            force = Vec3(force.x, force.y, force.z + self.thrust)
        if self.moment is not None:
            moment = moment + self.moment
        return Wrench(force, moment)


class Environment(eqx.Module):
    """The surroundings of a flight; what is None is not there, and costs nothing."""

    wind: Vec3 | None = None
    """m/s, world ENU: the air's steady velocity over the ground, leaves (\\*batch)."""
    log_voltage: Float[Array, "ticks *batch"] | None = None
    """Logarithm of the battery's voltage over its reference voltage, one a control tick."""
    battery_decline: Scalar | None = None
    """1/s by which rotor speeds fall, where no voltage was recorded."""
    begin: Float[Array, "*batch"] | None = None
    """s since the battery began to decline at which the simulation begins; None for zero."""
    disturbance: Disturbance | None = None
    """Gusts, and whatever else pushes."""
    draught: Scalar | None = None
    """m/s, standard deviation along the rotors' axes of gusts of which no more is known: thrust is
    what they leave of it in the mean. None for still air."""

    @property
    def at_first(self) -> PyTree[Array]:
        """The values at the first control tick, every leaf (\\*batch)."""
        series = jax.tree.map(lambda values: values[0], (self.log_voltage, self.disturbance))
        return series, self.wind, self.battery_decline, self.begin, self.draught

    def during(self, step: Int[Array, ""], schedule: Schedule) -> Environment:
        """Return the environment in a physics step, with the gust in the wind."""
        if self.disturbance is None:
            return self
        now = self.disturbance.during(step, schedule)
        wind = self.wind
        if now.gust is not None:
            wind = now.gust if wind is None else wind + now.gust
        return replace(self, wind=wind, disturbance=now)

    def speed_factor(
        self, battery_exponent: Scalar | None, step: Int[Array, ""], schedule: Schedule
    ) -> Scalar | None:
        """Return the factor of the battery on reference rotor speeds in a step; None for none.

        (V/V_ref)^battery_exponent where the voltage is known (thesis 10.4), 1 - battery_decline·t
        where a flight's decline is.
        """
        factor: Scalar | None = None
        if battery_exponent is not None and self.log_voltage is not None:
            factor = jnp.exp(
                battery_exponent * row_of(self.log_voltage, schedule.control_tick(step))
            )
        if self.battery_decline is not None:
            time = step * schedule.step if self.begin is None else step * schedule.step + self.begin
            declined = 1.0 - self.battery_decline * time
            factor = declined if factor is None else factor * declined
        return factor


STILL_AIR = Environment()
"""Still air."""


class Air(eqx.Module):
    """Velocities through the air, and where they are taken; all in body axes."""

    velocity: Vec3
    """m/s, of the centre of mass through the air."""
    arms: tuple[Vec3, ...]
    """m, from the centre of mass to each rotor's centre."""
    at_rotors: tuple[Vec3, ...]
    """m/s, of each rotor's centre through the air: velocity + ω × arm."""
    up: Vec3
    """The world's z axis."""
    rotor_acceleration: PerRotor = ()
    """rad/s² of each rotor during the step; empty where no term asks for it."""
    draught: Scalar | None = None
    """As of `Environment`."""

    @staticmethod
    def around(
        vehicle: Vehicle,
        motion: Motion,
        environment: Environment = STILL_AIR,
        rotor_acceleration: PerRotor = (),
    ) -> Air:
        """Return the air as a vehicle meets it in a motion."""
        through = motion.velocity
        if environment.wind is not None:
            through = through - environment.wind
        velocity = motion.attitude.to_body(through)
        arms = tuple(rotor.position for rotor in vehicle.rotors)
        offset = vehicle.along_axes("center_of_mass")
        if offset is not None:
            arms = tuple(arm - offset for arm in arms)
        return Air(
            velocity=velocity,
            arms=arms,
            at_rotors=tuple(velocity + motion.body_rate.cross(arm) for arm in arms),
            up=motion.attitude.world_up(),
            rotor_acceleration=rotor_acceleration,
            draught=environment.draught,
        )
