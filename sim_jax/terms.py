"""Forces and moments on the vehicle, one pure function a term; their sum, and each of them.

A rotor at the arm r, turning with Ω > 0 in the sense of its spin s, moves through the air with v:
v∥ along its axis, which is body z, and v⊥ across it; of the body as a whole, v is the velocity of
the centre of mass through the air. ω is the body rate. All in body axes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp
from jax.scipy.stats import norm

from sim_jax.environment import Air
from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.state import hover_speed
from sim_jax.vehicle import Aerodynamics, PerRotor, Vehicle

Term: TypeAlias = Callable[[Vehicle, Motion, PerRotor, Air], Wrench | None]
"""(vehicle, motion, rotor speeds in rad/s, air) -> what acts, in body axes.

None where the vehicle lacks the term's coefficient: then nothing of it is traced or computed.
"""


# the base model: Gazebo's motor model


def thrust(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return motor_constant·Ω²·clip(1 - |v∥|/max_relative_airspeed, 0, 1) along body z, at r.

    Ω² is that of `thrust_terms_act`.

    Times the rotor's own ``rotor_thrust_scale_i`` and 1/(1 - ground_effect·(R/4h)²), h the height
    of the rotor's centre, where a vehicle has these effects. Source: thesis Eq. 6.5 and 6.6 (the
    equation is signed; the code that was flown, followed here, takes the length of v∥); Cheeseman
    and Bennett, "The effect of the ground on a helicopter rotor in forward flight", 1955.

    In a draught |v∥| is its mean over the gusts, of which each rotor meets the same.
    """
    aerodynamics = vehicle.aerodynamics
    zero = jnp.zeros_like(motion.velocity.x)
    lifts, lifted = [], thrust_terms_act(vehicle)
    for number, (speed, through) in enumerate(zip(rotor_speed, air.at_rotors, strict=True)):
        share = _remaining_share(aerodynamics, through.z, air.draught)
        square = lifted(speed) * share
        scale = _thrust_scale(vehicle, number)
        if scale is not None:
            square = scale * square
        ground = vehicle.effects.get("ground_effect")
        if ground is not None:
            height = motion.position.z + air.arms[number].dot(air.up)
            square = square * _near_ground(ground, vehicle.rotor_radius, height)
        lifts.append(Vec3(zero, zero, aerodynamics.motor_constant * square))
    return Wrench.at_each_rotor(tuple(lifts))


def rotor_drag(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return -rotor_drag_coefficient·Ω·v⊥, at r; along body y ``rotor_drag_ratio_y`` times that.

    Source: thesis Eq. 8.2, 10.4.
    """
    coefficient = vehicle.aerodynamics.rotor_drag_coefficient
    ratio = vehicle.effects.get("rotor_drag_ratio_y")
    across = coefficient if ratio is None else coefficient * ratio
    zero = jnp.zeros_like(motion.velocity.x)

    def drag(speed: Scalar, through: Vec3) -> Vec3:
        return Vec3(-coefficient * (speed * through.x), -across * (speed * through.y), zero)

    drags = (drag(speed, v) for speed, v in zip(rotor_speed, air.at_rotors, strict=True))
    return Wrench.at_each_rotor(tuple(drags))


def rolling_moment(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return the moment -s·rolling_moment_coefficient·Ω·v⊥.

    Source: thesis Eq. 9.2.
    """
    coefficient = vehicle.aerodynamics.rolling_moment_coefficient
    x = y = zero = jnp.zeros_like(motion.velocity.x)
    for rotor, speed, through in zip(vehicle.rotors, rotor_speed, air.at_rotors, strict=True):
        x, y = x + rotor.spin * (speed * through.x), y + rotor.spin * (speed * through.y)
    return Wrench(Vec3.zeros(zero), Vec3(-coefficient * x, -coefficient * y, zero))


def drag_torque(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return the moment -s·moment_constant·motor_constant·Ω² about body z.

    The thrust in it is that without axial speed, as in Gazebo. The thesis's branch turns about
    world z instead (``reaction_torque``). Source: thesis Eq. 7.2.
    """
    aerodynamics = vehicle.aerodynamics
    square = zero = jnp.zeros_like(motion.velocity.x)
    lifted = thrust_terms_act(vehicle)
    for number, (rotor, speed) in enumerate(zip(vehicle.rotors, rotor_speed, strict=True)):
        scale = _thrust_scale(vehicle, number)
        turned = lifted(speed)
        if scale is not None:
            turned = scale * turned
        square = square + rotor.spin * turned
    torque = -aerodynamics.motor_constant * aerodynamics.moment_constant * square
    if aerodynamics.reaction_torque == "world":
        return Wrench(Vec3.zeros(zero), air.up * torque)
    return Wrench(Vec3.zeros(zero), Vec3(zero, zero, torque))


def thrust_terms_act(vehicle: Vehicle) -> Callable[[Scalar], Scalar]:
    """Return the function from rotor speed, rad/s, to the factor of motor_constant, (rad/s)².

    Ω²·(Ω/Ω_h)^(thrust_exponent - 2): blades at low Reynolds numbers, or that bend, lift by another
    power of the speed than the second. At Ω_h, at which equal rotors carry the weight, motor
    constant and hover are what they are without. The power is right to two thousandths from a
    third of Ω_h to twice it, by approximants that cost a tenth: ln x by 3(x² - 1)/(x² + 4x + 1),
    the exponential by Padé's of second order. Source: thrust stands; Bangura and Mahony, "Nonlinear
    dynamic modeling for high performance control of a quadrotor", 2012, 3.2.
    """
    squared = vehicle.aerodynamics.squared
    exponent = vehicle.effects.get("thrust_exponent")
    if exponent is None:
        return squared
    beyond, per_speed = exponent - 2.0, 1.0 / hover_speed(vehicle)

    def lifted(speed: Scalar) -> Scalar:
        x = speed * per_speed
        squares = x * x
        power = beyond * (3.0 * (squares - 1.0) / (squares + 4.0 * x + 1.0))
        even, odd = 1.0 + power * power * (1.0 / 12.0), 0.5 * power
        return squared(speed) * ((even + odd) / (even - odd))

    return lifted


def _remaining_share(aerodynamics: Aerodynamics, axial: Scalar, draught: Scalar | None) -> Scalar:
    """Return the share of a rotor's static thrust that is left at an axial air speed in m/s."""
    length = jnp.abs(axial) if draught is None else _mean_length(axial, draught)
    lost = length * (1.0 / aerodynamics.max_relative_airspeed)
    return jnp.where(lost < 1.0, 1.0 - lost, 0.0)


def _mean_length(mean: Scalar, sd: Scalar) -> Scalar:
    """Return the mean length of a number that is normally distributed about a mean.

    u (1 - 2 Q(u/σ)) + 2 σ φ(u/σ): it has a slope at zero, where the length has none. Source: Leone,
    Nelson and Nottingham, "The folded normal distribution", 1961.
    """
    size = mean / sd
    return mean * (1.0 - 2.0 * norm.sf(size)) + 2.0 * sd * norm.pdf(size)


def _thrust_scale(vehicle: Vehicle, number: int) -> Scalar | None:
    """Return a rotor's own factor on thrust and torque; None where all rotors are alike.

    Their product is 1: the last rotor's follows from the others', unless it is given itself. What
    all rotors have in common is the motor constant.
    """
    count = len(vehicle.rotors)
    scales = [vehicle.effects.get(f"rotor_thrust_scale_{i + 1}") for i in range(count)]
    given = [scale for scale in scales if scale is not None]
    if not given or scales[number] is not None or number < count - 1:
        return scales[number]
    return 1.0 / math.prod(given[1:], start=given[0])


def _near_ground(ground: Scalar, radius: Scalar, height: Scalar) -> Scalar:
    """Return by how much the ground raises a rotor's thrust; bounded where the law diverges."""
    ratio = radius / (4.0 * jnp.maximum(height, 0.5 * radius))
    return 1.0 / (1.0 - jnp.clip(ground * ratio * ratio, -1.0, 0.5))


# terms beyond it, of body and rotors; each acts where its coefficient is


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


# all of them

TERMS: tuple[Term, ...] = (
    thrust,
    rotor_drag,
    rolling_moment,
    drag_torque,
    fuselage_drag,
    linear_drag,
    thrust_inflow,
    flapping_moment,
    gyroscopic_moment,
    angular_drag,
    torque_trim,
)
"""Everything that acts on the vehicle besides gravity; a term that is added here flies."""


def total_wrench(vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air) -> Wrench:
    """Return the sum of all terms, as force and moment about the centre of mass, body axes.

    Forces at one rotor are added up before the arm multiplies them, and rotors are taken one after
    the other: so those of opposite rotors cancel to the last bit, which a sum over rotors term by
    term does not give where the processor rounds a product and a sum at once.
    """
    acting = (term(vehicle, motion, rotor_speed, air) for term in TERMS)
    wrenches = [wrench for wrench in acting if wrench is not None]
    force = moment = Vec3.zeros(air.velocity.x)
    for number, arm in enumerate(air.arms):
        forces = [wrench.at_rotors[number] for wrench in wrenches if wrench.at_rotors]
        at_rotor = sum(forces, start=Vec3.zeros(air.velocity.x))
        force, moment = force + at_rotor, moment + arm.cross(at_rotor)
    for wrench in wrenches:
        force, moment = force + wrench.force, moment + wrench.moment
    unseen = _unobserved(vehicle, motion, moment)
    return Wrench(force, moment if unseen is None else moment + unseen)


def wrench_of_each_term(
    vehicle: Vehicle, motion: Motion, rotor_speed: PerRotor, air: Air
) -> dict[str, Wrench]:
    """Return a term's name -> its force and moment about the centre of mass, body axes.

    What a term does at the rotors is part of both. A term that does not act is left out; the others
    add up to `total_wrench`.
    """
    acting = {term.__name__: term(vehicle, motion, rotor_speed, air) for term in TERMS}
    wrenches = {
        name: _about_center_of_mass(wrench, air)
        for name, wrench in acting.items()
        if wrench is not None
    }
    zero = Vec3.zeros(air.velocity.x)
    unseen = _unobserved(vehicle, motion, sum((w.moment for w in wrenches.values()), start=zero))
    return wrenches if unseen is None else wrenches | {"torque_gain": Wrench(zero, unseen)}


def _about_center_of_mass(wrench: Wrench, air: Air) -> Wrench:
    force, moment = wrench.force, wrench.moment
    for arm, at_rotor in zip(air.arms, wrench.at_rotors, strict=False):
        force, moment = force + at_rotor, moment + arm.cross(at_rotor)
    return Wrench(force, moment)


def _unobserved(vehicle: Vehicle, motion: Motion, moment: Vec3) -> Vec3 | None:
    """Return (torque_gain - 1)·(M - ω × Iω), axis by axis: the unobserved part of a moment.

    No physics: a loop's rotors answer what disturbs the vehicle. Where their speeds are recorded
    and what they answer is not, less than all of the angular acceleration that they stand for
    predicts how the vehicle turns (Ljung, System Identification, 13.4).
    """
    names = [f"torque_gain_{axis}" for axis in "xyz"]
    if not any(name in vehicle.effects for name in names):
        return None
    body, rate, whole = vehicle.body, motion.body_rate, jnp.ones_like(moment.x)
    momentum = rate.scaled_by(Vec3(body.inertia_xx, body.inertia_yy, body.inertia_zz))
    x, y, z = (vehicle.effects.get(name, whole) - 1.0 for name in names)
    return Vec3(x, y, z).scaled_by(moment - rate.cross(momentum))
