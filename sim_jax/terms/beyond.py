"""Terms beyond Gazebo's motor model, of body and rotors; each acts where its coefficient is.

As in `sim_jax.terms.rotor`, Ω is a rotor's speed, s its spin and v the velocity of its centre
through the air, v∥ along body z and v⊥ across it; of the body as a whole, v is the velocity of the
centre of mass through the air. ω is the body rate. All in body axes.
"""

from __future__ import annotations

from sim_jax.environment import Air
from sim_jax.geometry import Vec3
from sim_jax.rigid_body import Motion, Wrench
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


def thrust_inflow(
    vehicle: Vehicle,
    motion: Motion,  # noqa: ARG001 (all terms take the same)
    rotor_speed: PerRotor,
    air: Air,
) -> Wrench | None:
    """Return the force -thrust_inflow_coefficient·Ω·v∥ along body z, at each rotor.

    Signed, unlike the loss of thrust with airspeed in Gazebo's model: a rotor that moves up gives
    less thrust and one that moves down more, which also damps roll and pitch. Source: blade element
    theory, first order in the advance ratio (thesis 6).
    """
    coefficient = vehicle.effects.get("thrust_inflow_coefficient")
    if coefficient is None:
        return None
    zero = Vec3.zeros(air.velocity.x).x
    return Wrench.at_each_rotor(
        tuple(
            Vec3(zero, zero, -coefficient * (speed * through.z))
            for speed, through in zip(rotor_speed, air.at_rotors, strict=True)
        )
    )


def flapping_moment(
    vehicle: Vehicle,
    motion: Motion,  # noqa: ARG001
    rotor_speed: PerRotor,
    air: Air,
) -> Wrench | None:
    """Return the moment flapping_moment_coefficient·Ω·(e_z × v⊥), summed over the rotors.

    Blades flap in the same sense whichever way a rotor turns, so that nothing cancels over four of
    them. Body y points left: a vehicle that flies forward and pitches up, as blades that flap back
    make it, has a negative coefficient. Source: Mahony, Kumar, Corke, "Multirotor aerial vehicles",
    2012; Prouty, "Helicopter performance, stability and control".
    """
    coefficient = vehicle.effects.get("flapping_moment_coefficient")
    if coefficient is None:
        return None
    x = y = zero = Vec3.zeros(air.velocity.x).x
    for speed, through in zip(rotor_speed, air.at_rotors, strict=True):
        x, y = x - speed * through.y, y + speed * through.x
    return Wrench(Vec3.zeros(zero), Vec3(coefficient * x, coefficient * y, zero))


def gyroscopic_moment(
    vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air
) -> Wrench | None:
    """Return -ω × h - dh/dt, the moment on the body of rotors with angular momentum h along z.

    h = Σ s·rotor_inertia·Ω. Source: Euler's equations of a body that carries rotors.
    """
    inertia = vehicle.effects.get("rotor_inertia")
    if inertia is None:
        return None
    momentum = change = zero = Vec3.zeros(air.velocity.x).x
    for rotor, speed in zip(vehicle.rotors, rotor_speed, strict=True):
        momentum = momentum + rotor.spin * speed
    for rotor, acceleration in zip(vehicle.rotors, air.rotor_acceleration, strict=False):
        change = change + rotor.spin * acceleration
    rate = motion.body_rate
    turning = inertia * momentum
    return Wrench(Vec3.zeros(zero), Vec3(-rate.y * turning, rate.x * turning, -inertia * change))
