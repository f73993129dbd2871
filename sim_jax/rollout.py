"""The closed loop flown from start to end: reference to motion, with one core for all inlets."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int

from sim_jax.constants import GRAVITY
from sim_jax.control import mixer
from sim_jax.control.gains import Controller, with_gains_of
from sim_jax.environment import STILL_AIR, Environment
from sim_jax.frames import estimated_motion, gyro_of
from sim_jax.inlet import Inlet
from sim_jax.motor import Lag, LagSlope, SwitchedLag
from sim_jax.numeric import Array, Precision, Scalar, in_precision, precision_of, rematerialised
from sim_jax.plant import Plant, Sample
from sim_jax.schedule import Schedule
from sim_jax.sensing import GyroFilter, Tachometer
from sim_jax.state import Limits, Start, State, first_state, hover_speed
from sim_jax.vehicle import Vehicle

SECOND_LAG = "time_constant_second"
"""The effect of a second lag of the motors."""
CHECKPOINT_STEPS = 100
"""Physics steps between the states that reverse mode stores."""


class Rollout(eqx.Module):
    """A simulated flight."""

    log: Sample
    crash_time: Scalar
    """s at which the vehicle crashed and was frozen; infinite if it never did."""

    @property
    def crashed(self) -> Array:
        """Which vehicles crashed, shape (\\*batch)."""
        return jnp.isfinite(self.crash_time)


def _lag(vehicle: Vehicle, schedule: Schedule) -> Lag | SwitchedLag:
    relative, second = vehicle.effects.get("time_constant_slope"), vehicle.effects.get(SECOND_LAG)
    slope = None if relative is None else LagSlope(relative, hover_speed(vehicle))
    if schedule.longest_actuator_latency == 0:
        return Lag.over(vehicle.motor, schedule.step, slope, second)
    age = vehicle.setup.actuator_latency * schedule.physics_rate
    part = age - jnp.floor(age)
    return SwitchedLag.over(vehicle.motor, schedule.step, part, slope, second)


def _check_rotors(vehicle: Vehicle, inlet: Inlet, start: Start) -> None:
    count = len(vehicle.rotors)
    if inlet.needs_mixer and count != mixer.ROTORS:
        raise ValueError(
            f"the vehicle has {count} rotors, and PX4's quad-X mixer commands {mixer.ROTORS}: "
            "feed in motor commands or rotor speeds (inlet actuator or rotor_speed)"
        )
    for name, counts in {
        "inlet": inlet.rotor_counts(),
        "start": {len(start.rotor_speed), len(start.command)},
    }.items():
        if counts - {count}:
            raise ValueError(
                f"the vehicle has {count} rotors, the {name} has values for "
                + ", ".join(map(str, sorted(counts)))
            )


def start_simulation(
    vehicle: Vehicle,
    controller: Controller,
    schedule: Schedule,
    inlet: Inlet,
    start: Start,
    *,
    environment: Environment = STILL_AIR,
    limits: Limits | None = None,
    gravity: float = GRAVITY,
    precision: Precision | None = None,
    reversible: bool = False,
) -> tuple[Plant, State]:
    """Return the plant and its state at time 0; the arguments are those of `rollout`.

    ``reversible``: whether reverse mode is to remember as little as can be.
    """
    _check_rotors(vehicle, inlet, start)
    arguments = vehicle, controller, inlet, start, environment
    dtype = precision_of(arguments) if precision is None else jnp.dtype(precision)
    vehicle, controller, inlet, start, environment = in_precision(arguments, dtype)
    others = jax.tree.leaves((vehicle, controller, start, environment.at_first))
    shape = jnp.broadcast_shapes(*map(jnp.shape, others), inlet.batch_shape())
    controller = with_gains_of(controller, vehicle)
    senses, read_late = gyro_of(vehicle), vehicle.effects.get("tachometer_lag")
    plant = Plant(
        vehicle=vehicle,
        controller=controller,
        environment=environment,
        schedule=schedule,
        limits=Limits() if limits is None else limits,
        gravity=gravity,
        reversible=reversible,
        inlet=inlet,
        lag=_lag(vehicle, schedule),
        gyro=GyroFilter.at(controller.filters, schedule.rate_control_rate),
        senses=senses,
        tachometer=None
        if read_late is None
        else Tachometer.over(
            read_late, schedule.step, vehicle.effects.get("tachometer_memory", 1.0)
        ),
    )
    return plant, first_state(
        start,
        vehicle.motor,
        schedule,
        plant.gyro,
        shape,
        seen=estimated_motion(vehicle, controller, start.motion),
        read=senses.reading(start.motion.body_rate),
        lags_twice=SECOND_LAG in vehicle.effects,
        read_late=read_late is not None,
    )


def rollout(
    vehicle: Vehicle,
    controller: Controller,
    schedule: Schedule,
    inlet: Inlet,
    start: Start,
    *,
    samples: int,
    environment: Environment = STILL_AIR,
    limits: Limits | None = None,
    gravity: float = GRAVITY,
    precision: Precision | None = None,
) -> Rollout:
    """Fly: one vehicle, or a batch along trailing axes of any leaf.

    Reverse mode stores a state every `CHECKPOINT_STEPS`, and recomputes those in between.

    Parameters
    ----------
    vehicle, controller
        Their leaves broadcast against each other, the inlet and the start.
    schedule
        Rates of the loops.
    inlet
        What is fed in, and where.
    start
        The state at time 0.
    samples
        How many samples to log at ``schedule.log_rate``, the first at time 0: the sample logged for
        a time is the state at that time, before the physics that follows it.
    environment
        What surrounds the flight; by default nothing.
    limits
        The space in which a flight counts as flying.
    gravity
        m/s², acting on the vehicle. (PX4's Gazebo worlds have 9.8066.)
    precision
        What to compute in; by default what holds all arguments. Single precision is twice as fast
        for a batch, and stays within a fiftieth of a millimetre of double over 40 s.

    Returns
    -------
    Rollout
        Log with leaves (samples, \\*batch), and the time of a crash.

    Raises
    ------
    ValueError
        The inlet or the start is for another number of rotors than the vehicle's, or the inlet
        needs the mixer and the vehicle is no quadrotor.
    """
    plant, first = start_simulation(
        vehicle,
        controller,
        schedule,
        inlet,
        start,
        environment=environment,
        limits=limits,
        gravity=gravity,
        precision=precision,
        reversible=True,
    )

    stretches = (
        -(-samples // max(1, CHECKPOINT_STEPS * schedule.log_rate // schedule.physics_rate)) or 1
    )
    length = -(-samples // stretches)

    def sample(state: State, number: Int[Array, ""]) -> tuple[State, Sample]:
        return plant.sample(state, number)

    def stretch(state: State, numbers: Int[jax.Array, " length"]) -> tuple[State, Sample]:
        return lax.scan(sample, state, numbers)

    numbers = jnp.arange(stretches * length).reshape(stretches, length)
    state, log = lax.scan(rematerialised(stretch), first, numbers)
    log = jax.tree.map(
        lambda leaf: leaf.reshape(len(leaf) * length, *leaf.shape[2:])[:samples], log
    )
    flown = state.crash_time <= samples / schedule.log_rate  # the last stretch may be longer
    return Rollout(log, jnp.where(flown, state.crash_time, jnp.inf))
