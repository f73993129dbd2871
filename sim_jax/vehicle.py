"""The coefficients of a vehicle as one pytree, each with its unit and meaning beside it."""

from __future__ import annotations

from typing import Literal, TypeAlias

import equinox as eqx
import jax.numpy as jnp
from jax.typing import ArrayLike

from sim_jax.geometry import Vec3
from sim_jax.numeric import Scalar

PerRotor: TypeAlias = tuple[Scalar, ...]
"""One value per rotor, in the vehicle's order of rotors."""


def _number(value: ArrayLike) -> Scalar:
    return jnp.asarray(value, dtype=float) if isinstance(value, (int, float)) else value  # type: ignore[return-value]


class Body(eqx.Module):
    """Mass and inertia about the centre of mass, diagonal in body axes."""

    mass: Scalar = eqx.field(converter=_number)
    """kg, take-off mass."""
    inertia_xx: Scalar = eqx.field(converter=_number)
    """kg m², about body x (roll)."""
    inertia_yy: Scalar = eqx.field(converter=_number)
    """kg m², about body y (pitch)."""
    inertia_zz: Scalar = eqx.field(converter=_number)
    """kg m², about body z (yaw)."""


class Rotor(eqx.Module):
    """Where one rotor sits and which way it turns."""

    position: Vec3
    """m, rotor centre from the centre of mass, body frame."""
    spin: Literal[1, -1] = eqx.field(static=True)
    """+1 turns counter-clockwise seen from above, -1 clockwise."""


class Motor(eqx.Module):
    """From motor command to rotor speed (thesis Eq. 4.2, 5.3; SDF motor model)."""

    input_scaling: Scalar = eqx.field(converter=_number)
    """rad/s per unit of command."""
    zero_position_armed: Scalar = eqx.field(converter=_number)
    """rad/s at zero command."""
    max_rotor_velocity: Scalar = eqx.field(converter=_number)
    """rad/s, limit of the reference speed."""
    time_constant_up: Scalar = eqx.field(converter=_number)
    """s, when the reference is above the speed."""
    time_constant_down: Scalar = eqx.field(converter=_number)
    """s, when it is not."""
    input_offset: Scalar = eqx.field(converter=_number, default=0.0)
    """Added to the command before scaling."""
    quadratic: Scalar = eqx.field(converter=_number, default=0.0)
    """rad/s per squared command, for polynomial RPM curves (thesis 4.4.1)."""


class Aerodynamics(eqx.Module):
    """From rotor speed and air velocity to force and moment (Eq. 6.5, 6.6, 7.2, 8.2, 9.2)."""

    motor_constant: Scalar = eqx.field(converter=_number)
    """N s²/rad², thrust per squared rotor speed."""
    moment_constant: Scalar = eqx.field(converter=_number)
    """m, drag torque per thrust."""
    rotor_drag_coefficient: Scalar = eqx.field(converter=_number)
    """N s²/(rad m), in-plane drag per rotor speed and in-plane velocity."""
    rolling_moment_coefficient: Scalar = eqx.field(converter=_number)
    """N s²/rad, rolling moment per rotor speed and in-plane velocity."""
    max_relative_airspeed: Scalar = eqx.field(converter=_number, default=25.0)
    """m/s, axial air speed at which thrust has fallen to zero."""
    reaction_torque: Literal["body", "world"] = eqx.field(static=True, default="body")
    """Axis of the drag torque: body z (upstream) or world z (the thesis's branch)."""
    thrust_law: Literal["linear"] | None = eqx.field(static=True, default=None)
    """Thrust goes with the squared rotor speed; ``linear``: with the speed, motor_constant in
    N s/rad, as in simulators whose state is a thrust or a throttle."""

    def squared(self, speed: Scalar) -> Scalar:
        """Return the factor of motor_constant: the squared rotor speed, or the speed."""
        return speed if self.thrust_law == "linear" else speed * speed

    def speed_at(self, thrust: Scalar) -> Scalar:
        """Return the speed in rad/s at which a rotor in still air gives a thrust in N."""
        squared = thrust / self.motor_constant
        return squared if self.thrust_law == "linear" else jnp.sqrt(squared)


class Setup(eqx.Module):
    """Latencies of the set-up, which are coefficients as well."""

    estimate_latency: Scalar = eqx.field(converter=_number, default=0.0)
    """s, age of the state estimate that the position and attitude controllers see."""
    actuator_latency: Scalar = eqx.field(converter=_number, default=0.0)
    """s, from the mixer's output to the motor."""


class Vehicle(eqx.Module):
    """One vehicle, or a batch of them when its leaves have a trailing batch axis."""

    body: Body
    rotors: tuple[Rotor, ...]
    """Of a quad X in PX4's order: front right ccw, rear left ccw, front left cw, rear right cw."""
    motor: Motor
    aerodynamics: Aerodynamics
    setup: Setup
    effects: dict[str, Scalar] = eqx.field(default_factory=dict)
    """Coefficients of terms beyond the base model by name; a term without them does not act."""
    rotor_radius: Scalar = eqx.field(converter=_number, default=0.13)
    """m, of which the ground effect depends; an 11 inch propeller has 0.14."""

    def along_axes(self, stem: str, neutral: float = 0.0) -> Vec3 | None:
        """Return the effects ``stem_x``, ``_y``, ``_z``, absent ones neutral; None without any."""
        parts = [self.effects.get(f"{stem}_{axis}") for axis in "xyz"]
        known = [part for part in parts if part is not None]
        if not known:
            return None
        absent = jnp.full_like(known[0], neutral)
        x, y, z = (absent if part is None else part for part in parts)
        return Vec3(x, y, z)
