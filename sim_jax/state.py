"""Everything that changes during a flight: the carry of the rollout's loop, and its limits.

A flight that ends badly is frozen there, so that every number stays finite.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Float

from sim_jax.constants import GRAVITY
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import command_of, reference_speed
from sim_jax.numeric import Array, Flag, Scalar
from sim_jax.rigid_body import Motion
from sim_jax.schedule import Schedule
from sim_jax.sensing import GyroFilter, GyroMemory, constant_history, history_length
from sim_jax.vehicle import Motor, PerRotor, Vehicle


class Start(eqx.Module):
    """The start of a flight."""

    motion: Motion
    rotor_speed: PerRotor
    """rad/s."""
    command: PerRotor
    """0..1, what the motors received before the start."""
    rate_integral: Vec3
    """State of the rate controller's integrator, FRD."""


class Setpoints(eqx.Module):
    """Set-points of the attitude controller for the rate controller."""

    rate: Vec3
    """rad/s, body FLU."""
    thrust: Scalar
    """0..1."""


class State(eqx.Module):
    """Vehicle, controllers' memories and delay lines; delay lines not needed are None."""

    motion: Motion
    rotor_speed: PerRotor
    setpoints: Setpoints
    integral: Vec3
    gyro: GyroMemory
    command: PerRotor
    reference_speed: PerRotor
    """rad/s, what the command asks of the motors."""
    lagged_speed: PerRotor | None
    """rad/s, that as a second lag of the motors leaves it; None without one."""
    read_speed: PerRotor | None
    """rad/s, rotor speeds as tachometers with a lag read them; None without one."""
    estimate_history: Float[Array, "past_estimates 10 *batch"] | None
    reference_history: Float[Array, "past_references rotors *batch"] | None
    crash_time: Scalar
    """s, infinite while flying."""


class Limits(eqx.Module):
    """The space in which a flight counts as flying; static."""

    floor: float = eqx.field(static=True, default=0.227)
    """m, height of the landing gear below which the vehicle has hit the ground."""
    half_width: float = eqx.field(static=True, default=50.0)
    """m from the origin along any axis beyond which the vehicle has flown away."""
    fastest_rate: float = eqx.field(static=True, default=60.0)
    """rad/s of body rate about any axis beyond which the vehicle tumbles."""

    def broken_by(self, motion: Motion) -> Flag:
        """Return which vehicles are outside the limits; not-a-number counts as outside."""
        position, rate = motion.position, motion.body_rate
        inside = position.z >= self.floor
        for distance in (position.x, position.y, position.z):
            inside &= jnp.abs(distance) <= self.half_width
        for speed in (rate.x, rate.y, rate.z):
            inside &= jnp.abs(speed) <= self.fastest_rate
        return ~inside


AIRBORNE = Limits(floor=-1e3, half_width=1e3)
"""For recordings that leave the ground or an origin elsewhere: only tumbling ends the flight."""


def hover_speed(vehicle: Vehicle, *, gravity: float = GRAVITY) -> Scalar:
    """Return the speed, rad/s, at which equal rotors carry a vehicle's weight in still air."""
    thrust = vehicle.body.mass * gravity / len(vehicle.rotors)
    return vehicle.aerodynamics.speed_at(thrust)


def hover(vehicle: Vehicle, position: Vec3, *, gravity: float = GRAVITY) -> Start:
    """Return a level vehicle at rest at a position in m, its rotors carrying its weight."""
    count, speed = len(vehicle.rotors), hover_speed(vehicle, gravity=gravity)
    command = command_of(vehicle.motor, speed)
    rest = Vec3.zeros(position.x)
    return Start(
        motion=Motion(position, rest, Quaternion.identity(position.x), rest),
        rotor_speed=(speed,) * count,
        command=(command,) * count,
        rate_integral=rest,
    )


def first_state(
    start: Start,
    motor: Motor,
    schedule: Schedule,
    gyro: GyroFilter,
    shape: tuple[int, ...],
    *,
    seen: Motion,
    read: Vec3,
    lags_twice: bool = False,
    read_late: bool = False,
) -> State:
    """Return the state at time 0, every leaf in the full shape of the batch.

    ``seen``: the start's motion as position and attitude control see it; ``read``: its body rate as
    the gyro reads it, rad/s; ``lags_twice``: whether the motors have a second lag; ``read_late``:
    whether tachometers have one.
    """
    dtype = jnp.result_type(*jax.tree.leaves(start))
    start, seen, read = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, shape).astype(dtype), (start, seen, read)
    )
    speeds = (reference_speed(motor, command) for command in start.command)
    references = tuple(jnp.broadcast_to(speed, shape).astype(dtype) for speed in speeds)
    estimate_history = reference_history = None
    if schedule.longest_estimate_latency > 0:
        hold = 0.0 if schedule.pose_rate is None else 1.0 / schedule.pose_rate
        length = history_length(schedule.longest_estimate_latency + hold, schedule.step)
        estimate_history = constant_history(seen, length, schedule.step)
    elif schedule.pose_rate is not None:
        raise ValueError("pose_rate needs a delay line: set longest_estimate_latency")
    if schedule.longest_actuator_latency > 0:
        length = history_length(schedule.longest_actuator_latency, schedule.step)
        now = jnp.stack(references)
        reference_history = jnp.broadcast_to(now, (length, *now.shape))
    memory = GyroMemory.settled(gyro, read)
    thrust = sum(start.command[1:], start.command[0]) * (1.0 / len(start.command))
    return State(
        motion=start.motion,
        rotor_speed=start.rotor_speed,
        setpoints=Setpoints(Vec3.zeros(thrust), thrust),
        integral=start.rate_integral,
        gyro=jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, shape).astype(dtype), memory),
        command=start.command,
        reference_speed=references,
        lagged_speed=references if lags_twice else None,
        read_speed=start.rotor_speed if read_late else None,
        estimate_history=estimate_history,
        reference_history=reference_history,
        crash_time=jnp.full(shape, jnp.inf, dtype),
    )
