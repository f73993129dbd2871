"""Terms of the body as a whole, beyond Gazebo's motor model; each acts where its coefficient is."""

from __future__ import annotations

from sim_jax.rigid_body import Motion, Wrench
from sim_jax.terms.air import Air
from sim_jax.vector import Vec3
from sim_jax.vehicle import PerRotor, Vehicle


def fuselage_drag(
    vehicle: Vehicle,
    motion: Motion,  # noqa: ARG001 (all terms take the same)
    rotor_speed: PerRotor,  # noqa: ARG001
    air: Air,
) -> Wrench | None:
    """Return -fuselage_drag·‖v‖·v, v the velocity of the centre of mass through the air.

    Source: drag of a bluff body at the Reynolds numbers of a multirotor, quadratic in the velocity.
    """
    coefficient = vehicle.effects.get("fuselage_drag")
    if coefficient is None:
        return None
    force = air.velocity * (-coefficient * air.velocity.norm())
    return Wrench(force, Vec3.zeros(air.velocity.x))
