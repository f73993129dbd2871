"""All terms, their sum about the centre of mass, and each of them there."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import jax.numpy as jnp

from sim_jax.environment import Air
from sim_jax.geometry import Vec3
from sim_jax.rigid_body import Motion, Wrench
from sim_jax.terms import beyond, rotor
from sim_jax.vehicle import PerRotor, Vehicle

Term: TypeAlias = Callable[[Vehicle, Motion, PerRotor, Air], Wrench | None]
"""(vehicle, motion, rotor speeds in rad/s, air) -> what acts, in body axes.

None where the vehicle lacks the term's coefficient: then nothing of it is traced or computed.
"""

TERMS: tuple[Term, ...] = (
    rotor.thrust,
    rotor.rotor_drag,
    rotor.rolling_moment,
    rotor.drag_torque,
    beyond.fuselage_drag,
    beyond.linear_drag,
    beyond.thrust_inflow,
    beyond.flapping_moment,
    beyond.gyroscopic_moment,
    beyond.angular_drag,
    beyond.torque_trim,
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
