"""The frames of motion capture and of the autopilot's sensors, which are not the vehicle's own.

A rigid body that is defined by hand in motion capture has its point some millimetres beside the
centre of mass, and its axes a degree off. What is simulated is the centre of mass in body axes;
what is recorded is

    p_recorded = p + R(q)·marker_offset,    q_recorded = q ⊗ exp(marker_tilt / 2).

Both numbers belong to the set-up and act where a simulation is compared with a recording: at its
start, which comes from the recorded pose, and on what it gives. Position and attitude control see
the same pose where the estimator is fed by motion capture and knows of no offset, and the velocity
of that point; else the centre of mass in the autopilot's axes (`Controller.sees_markers`).

An autopilot that sits askew has axes of its own, the body's turned by exp(autopilot_tilt / 2);
its gyro reads, and the rate controller follows,

    ω_gyro = gyro_scale · R(exp(autopilot_tilt / 2))ᵀ·ω,    axis by axis,

and an estimator that levels itself by these sensors delivers q ⊗ exp(autopilot_tilt / 2). What the
mixer asks for acts along the body's axes, where the rotors are; the pose that is recorded does not
know of it.

Source: PX4 SENS_BOARD_X_OFF and SENS_BOARD_Y_OFF, which are meant to take the tilt out; data sheets
of MEMS gyros, whose sensitivity is off by a percent or two.
"""

from __future__ import annotations

import equinox as eqx
import jax
from jaxtyping import Bool

from sim_jax.control.gains import Controller
from sim_jax.geometry import Quaternion, Vec3, rotation
from sim_jax.numeric import Array, Scalar, where
from sim_jax.rigid_body import Motion
from sim_jax.state import Start
from sim_jax.vehicle import Vehicle


class Gyro(eqx.Module):
    """Errors of a gyro's axes and scale; None stands for no error."""

    turn: Quaternion | None
    """From the autopilot's axes to the body's."""
    scale: Vec3 | None

    def reading(self, body_rate: Vec3) -> Vec3:
        """Return the reading of a body rate, rad/s."""
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


class Markers(eqx.Module):
    """Where the motion capture's frame sits in the body; what is None is not off.

    Attributes
    ----------
    offset
        m, from the centre of mass, body axes.
    turn
        The recorded attitude is the body's, turned by this.
    """

    offset: Vec3 | None
    turn: Quaternion | None

    def recorded(self, motion: Motion) -> tuple[Vec3, Quaternion]:
        """Return the pose that motion capture records of a motion."""
        position, attitude = motion.position, motion.attitude
        if self.offset is not None:
            position = position + attitude.to_world(self.offset)
        return position, attitude if self.turn is None else attitude.product(self.turn)

    def seen(self, motion: Motion) -> Motion:
        """Return the motion that an estimator fed by motion capture makes of a motion.

        The point moves with p' = v + R(q)·(ω × marker_offset).
        """
        position, attitude = self.recorded(motion)
        velocity = motion.velocity
        if self.offset is not None:
            turning = motion.body_rate.cross(self.offset)
            velocity = velocity + motion.attitude.to_world(turning)
        return Motion(position, velocity, attitude, motion.body_rate)

    def start(
        self, recorded: Start, resting: Bool[Array, "*batch"] | None, sees_markers: Scalar
    ) -> Start:
        """Return the start whose pose motion capture recorded.

        Parameters
        ----------
        recorded
            With the recorded pose; level where the vehicle rests.
        resting
            Where the vehicle itself is level, however its markers are tilted.
        sees_markers
            As of `Controller`: the recorded velocity is the estimator's.
        """
        motion = recorded.motion
        position, velocity, attitude = motion.position, motion.velocity, motion.attitude
        if self.turn is not None:
            attitude = attitude.product(self.turn.conjugate())
            if resting is not None:
                level = Quaternion(attitude.w, 0.0 * attitude.x, 0.0 * attitude.y, attitude.z)
                attitude = where(resting, level.normalized(), attitude)
        if self.offset is not None:
            position = position - attitude.to_world(self.offset)
            turning = attitude.to_world(motion.body_rate.cross(self.offset))
            velocity = velocity - turning * sees_markers
        moved = Motion(position, velocity, attitude, motion.body_rate)
        return Start(moved, recorded.rotor_speed, recorded.command, recorded.rate_integral)


def markers_of(vehicle: Vehicle) -> Markers:
    """Return a vehicle's markers."""
    tilt = vehicle.along_axes("marker_tilt")
    turn = None if tilt is None else rotation(tilt)
    return Markers(vehicle.along_axes("marker_offset"), turn)


def estimated_motion(vehicle: Vehicle, controller: Controller, motion: Motion) -> Motion:
    """Return the motion that position and attitude control see of a motion, were it not old."""
    markers, tilt = markers_of(vehicle), tilt_of(vehicle)
    if not jax.tree.leaves((markers, tilt)):
        return motion
    by_sensors = motion
    if tilt is not None:
        attitude = motion.attitude.product(tilt)
        by_sensors = Motion(motion.position, motion.velocity, attitude, motion.body_rate)
    return where(controller.sees_markers > 0.5, markers.seen(motion), by_sensors)
