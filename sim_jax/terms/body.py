"""Terms of the body as a whole, beyond Gazebo's motor model; each acts where its coefficient is.

v is the velocity of the centre of mass through the air and ω the body rate, both in body axes.
"""

from __future__ import annotations

from sim_jax.geometry import Vec3
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.terms.air import Air
from sim_jax.vehicle import PerRotor, Vehicle


def fuselage_drag(
    vehicle: Vehicle,
    motion: Motion,  # noqa: ARG001 (all terms take the same)
    rotor_speed: PerRotor,  # noqa: ARG001
    air: Air,
) -> Wrench | None:
    """Return the force -fuselage_drag·‖v‖·v.

    Source: drag of a bluff body at the Reynolds numbers of a multirotor, quadratic in the velocity.
    """
    coefficient = vehicle.effects.get("fuselage_drag")
    if coefficient is None:
        return None
    force = air.velocity * (-coefficient * air.velocity.norm())
    return Wrench(force, Vec3.zeros(air.velocity.x))


def linear_drag(
    vehicle: Vehicle,
    motion: Motion,  # noqa: ARG001
    rotor_speed: PerRotor,  # noqa: ARG001
    air: Air,
) -> Wrench | None:
    """Return the force -linear_drag·v, axis by axis: rotor drag at one speed of the rotors.

    Source: Faessler, Franchi, Scaramuzza, "Differential flatness of quadrotor dynamics subject to
    rotor drag", RA-L 2018.
    """
    coefficients = vehicle.along_axes("linear_drag")
    if coefficients is None:
        return None
    return Wrench(-coefficients.scaled_by(air.velocity), Vec3.zeros(air.velocity.x))


def torque_trim(
    vehicle: Vehicle,
    motion: Motion,  # noqa: ARG001
    rotor_speed: PerRotor,  # noqa: ARG001
    air: Air,
) -> Wrench | None:
    """Return the steady moment torque_trim: what rotors and blades that differ leave over."""
    moment = vehicle.along_axes("torque_trim")
    return None if moment is None else Wrench(Vec3.zeros(air.velocity.x), moment)


def angular_drag(
    vehicle: Vehicle,
    motion: Motion,
    rotor_speed: PerRotor,  # noqa: ARG001
    air: Air,
) -> Wrench | None:
    """Return the moment -angular_drag·ω, axis by axis: what is left of inflow and flapping."""
    coefficients = vehicle.along_axes("angular_drag")
    if coefficients is None:
        return None
    return Wrench(Vec3.zeros(air.velocity.x), -coefficients.scaled_by(motion.body_rate))
