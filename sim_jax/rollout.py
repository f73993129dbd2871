"""The closed loop flown from start to end: reference to motion, with one core for all inlets."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int, PyTree

from sim_jax.autopilot import gyro_of
from sim_jax.constants import GRAVITY
from sim_jax.control import mixer
from sim_jax.control.gains import Controller, with_gains_of
from sim_jax.crash import Limits
from sim_jax.environment import NOTHING_AROUND, Environment
from sim_jax.inlet import Inlet
from sim_jax.markers import estimated
from sim_jax.motor import Lag, LagSlope, SwitchedLag
from sim_jax.numeric import Array, Scalar
from sim_jax.plant import Plant, Sample
from sim_jax.precision import Precision, in_precision, precision_of
from sim_jax.schedule import Schedule
from sim_jax.sensing import GyroFilter, Tachometer
from sim_jax.state import Start, State, first_state, hover_speed
from sim_jax.trees import forgetful
from sim_jax.vehicle import Vehicle

SECOND_LAG, TACHOMETER_LAG = "time_constant_second", "tachometer_lag"
"""The effects of a second lag of the motors, and of one of what measures their speeds."""


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
    slope, second = _lag_slope(vehicle), vehicle.effects.get(SECOND_LAG)
    if schedule.longest_actuator_latency == 0:
        return Lag.over(vehicle.motor, schedule.step, slope, second)
    age = vehicle.setup.actuator_latency * schedule.physics_rate
    part = age - jnp.floor(age)
    return SwitchedLag.over(vehicle.motor, schedule.step, part, slope, second)


def _lag_slope(vehicle: Vehicle) -> LagSlope | None:
    slope = vehicle.effects.get("time_constant_slope")
    return None if slope is None else LagSlope(slope, hover_speed(vehicle))


def _batch_shape(inlet: Inlet, others: PyTree[Array]) -> tuple[int, ...]:
    shapes = (jnp.shape(leaf) for leaf in jax.tree.leaves(others))
    return jnp.broadcast_shapes(*shapes, inlet.batch_shape())


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


def begun(
    vehicle: Vehicle,
    controller: Controller,
    schedule: Schedule,
    inlet: Inlet,
    start: Start,
    *,
    environment: Environment = NOTHING_AROUND,
    limits: Limits | None = None,
    gravity: float = GRAVITY,
    precision: Precision | None = None,
    reversible: bool = False,
) -> tuple[Plant, State]:
    """Return what is stepped, and the state at time 0; the arguments are those of `rollout`.

    ``reversible``: whether reverse mode is to remember as little as can be.
    """
    _check_rotors(vehicle, inlet, start)
    arguments = vehicle, controller, inlet, start, environment
    dtype = precision_of(arguments) if precision is None else jnp.dtype(precision)
    vehicle, controller, inlet, start, environment = in_precision(arguments, dtype)
    shape = _batch_shape(inlet, (vehicle, controller, start, environment.at_first))
    senses, read_late = gyro_of(vehicle), vehicle.effects.get(TACHOMETER_LAG)
    plant = Plant(
        vehicle=vehicle,
        controller=with_gains_of(controller, vehicle),
        environment=environment,
        schedule=schedule,
        limits=Limits() if limits is None else limits,
        gravity=gravity,
        reversible=reversible,
        inlet=inlet,
        lag=_lag(vehicle, schedule),
        gyro=GyroFilter.at(controller.filters, schedule.rate_control_rate),
        senses=senses,
        tachometer=None if read_late is None else Tachometer.over(read_late, schedule.step),
    )
    rate = start.motion.body_rate
    return plant, first_state(
        start,
        vehicle.motor,
        schedule,
        plant.gyro,
        shape,
        seen=estimated(vehicle, controller, start.motion),
        read=rate if senses is None else senses.reading(rate),
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
    environment: Environment = NOTHING_AROUND,
    horizon: Int[Array, ""] | None = None,
    limits: Limits | None = None,
    gravity: float = GRAVITY,
    precision: Precision | None = None,
) -> Rollout:
    """Fly: one vehicle, or a batch along trailing axes of any leaf.

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
    horizon
        If given, only so many samples are flown, and the rest of the log is zero. It may be traced:
        one compiled function serves every horizon; derivatives are then forward-mode only. Reverse
        mode remembers the state at every tick and computes the steps between again.
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
    plant, first = begun(
        vehicle,
        controller,
        schedule,
        inlet,
        start,
        environment=environment,
        limits=limits,
        gravity=gravity,
        precision=precision,
        reversible=horizon is None,
    )

    def sample(state: State, number: Int[Array, ""]) -> tuple[State, Sample]:
        return plant.sample(state, number)

    if horizon is None:
        state, log = lax.scan(forgetful(sample), first, jnp.arange(samples))
        return Rollout(log, state.crash_time)

    def logged(number: Int[Array, ""], carried: tuple[State, Sample]) -> tuple[State, Sample]:
        state, log = carried
        state, row = sample(state, number)
        log = jax.tree.map(
            lambda rows, now: lax.dynamic_update_index_in_dim(rows, now, number, 0), log, row
        )
        return state, log

    row = jax.eval_shape(sample, first, jnp.asarray(0))[1]
    empty = jax.tree.map(lambda leaf: jnp.zeros((samples, *leaf.shape), leaf.dtype), row)
    state, log = lax.fori_loop(0, jnp.minimum(horizon, samples), logged, (first, empty))
    return Rollout(log, state.crash_time)
