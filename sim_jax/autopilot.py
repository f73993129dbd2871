"""What an autopilot's sensors make of the motion: axes that are askew, a gyro whose scale is off.

An autopilot that sits askew has axes of its own, the body's turned by exp(autopilot_tilt / 2);
its gyro reads, and the rate controller follows,

    ω_gyro = gyro_scale · R(exp(autopilot_tilt / 2))ᵀ·ω,    axis by axis,

and an estimator that levels itself by these sensors delivers q ⊗ exp(autopilot_tilt / 2). (One that
is fed by motion capture delivers the markers' attitude, see `sim_jax.markers`.) What the mixer asks
for acts along the body's axes, where the rotors are; the pose that is recorded does not know of it.

Source: PX4 SENS_BOARD_X_OFF and SENS_BOARD_Y_OFF, which are meant to take the tilt out; data sheets
of MEMS gyros, whose sensitivity is off by a percent or two.
"""

from __future__ import annotations

import equinox as eqx

from sim_jax.rotation import Quaternion, rotation
from sim_jax.vector import Vec3
from sim_jax.vehicle import Vehicle


class Gyro(eqx.Module):
    """What a gyro reads of a body rate; what is None is not off."""

    turn: Quaternion | None
    """From the autopilot's axes to the body's."""
    scale: Vec3 | None

    def reading(self, body_rate: Vec3) -> Vec3:
        """Return what it reads of a body rate in rad/s."""
        along = body_rate if self.turn is None else self.turn.to_body(body_rate)
        return along if self.scale is None else self.scale.scaled_by(along)

    def body_rate(self, reading: Vec3) -> Vec3:
        """Return the body rate of which it reads something, in rad/s."""
        along = reading
        if self.scale is not None:
            along = Vec3(along.x / self.scale.x, along.y / self.scale.y, along.z / self.scale.z)
        return along if self.turn is None else self.turn.to_world(along)


def gyro_of(vehicle: Vehicle) -> Gyro:
    """Return a vehicle's gyro."""
    return Gyro(tilt_of(vehicle), vehicle.along_axes("gyro_scale", neutral=1.0))


def tilt_of(vehicle: Vehicle) -> Quaternion | None:
    """Return the turn from the autopilot's axes to the body's; None where they are the same."""
    tilt = vehicle.along_axes("autopilot_tilt")
    return None if tilt is None else rotation(tilt)
