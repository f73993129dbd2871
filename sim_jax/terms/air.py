"""How the vehicle and each of its rotors move through the air: worked out once for all terms."""

from __future__ import annotations

import equinox as eqx

from sim_jax.environment import NOTHING_AROUND, Environment
from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar
from sim_jax.rigid_body import Motion
from sim_jax.vehicle import PerRotor, Vehicle


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
        environment: Environment = NOTHING_AROUND,
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
