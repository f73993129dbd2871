"""The closed loop, stepped: reference to motion, with one core for the four inlets."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Int, PyTree

from sim_jax.control import attitude, mixer, rate
from sim_jax.control.gains import Controller
from sim_jax.control.mixer import PerRotor
from sim_jax.control.position import (
    attitude_from_acceleration,
    heading_of,
    thrust_setpoint,
    wanted_acceleration,
)
from sim_jax.crash import Limits
from sim_jax.inlet import ActuatorInlet, BodyRateInlet, Inlet, ReferenceInlet, RotorSpeedInlet
from sim_jax.motor import Lag, SwitchedLag, reference_speed
from sim_jax.numeric import GRAVITY, Scalar
from sim_jax.rigid_body import Motion, step_midpoint, step_rk4, step_semi_implicit
from sim_jax.rotation import Matrix3, Quaternion
from sim_jax.rotor import Wrench, vehicle_wrench
from sim_jax.schedule import Schedule
from sim_jax.sensing import GyroFilter, filtered, look_back, packed, push, switched, unpacked
from sim_jax.state import Setpoints, Start, State, first_state
from sim_jax.vector import Vec3
from sim_jax.vehicle import Vehicle


class Sample(eqx.Module):
    """What a rollout logs: the state at a time and the commands computed at that time.

    In a `Rollout` every leaf is (samples, \\*batch).
    """

    motion: Motion
    rotor_speed: PerRotor
    """rad/s."""
    command: PerRotor
    """0..1, as the mixer gave them."""
    setpoints: Setpoints


class Rollout(eqx.Module):
    """A simulated flight."""

    log: Sample
    crash_time: Scalar
    """s at which the vehicle crashed and was frozen; infinite if it never did."""

    @property
    def crashed(self) -> Array:
        """Tell which vehicles crashed, shape (\\*batch)."""
        return jnp.isfinite(self.crash_time)


_INTEGRATORS = {
    "midpoint": step_midpoint,
    "semi_implicit": step_semi_implicit,
    "rk4": step_rk4,
}


class _Plant(eqx.Module):
    """The vehicle and its controllers with everything that is computed once a rollout."""

    vehicle: Vehicle
    controller: Controller
    schedule: Schedule = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    gravity: float = eqx.field(static=True)
    inlet: Inlet
    lag: Lag | SwitchedLag
    gyro: GyroFilter

    def steer(self, state: State, step: Int[Array, ""]) -> Setpoints:
        """Run position and attitude control on the estimate as old as it is."""
        assert isinstance(self.inlet, ReferenceInlet)
        points = self.inlet.points
        tick = self.schedule.control_tick(step)
        reference = _row(points, tick)
        position, velocity, estimate = self._estimate(state, step)
        gains = self.controller
        heading = heading_of(gains.position, velocity)
        wanted = wanted_acceleration(gains.position, reference, position, velocity, heading)
        goal = attitude_from_acceleration(wanted, heading)
        turn = attitude.rate_setpoint(gains.attitude, estimate, goal)
        spins, still = self.inlet.spins, jnp.zeros_like(turn.x)
        return Setpoints(
            rate=Vec3(
                jnp.where(spins, still, turn.x),
                jnp.where(spins, still, turn.y),
                jnp.where(spins, self.inlet.yaw_rate, turn.z),
            ),
            thrust=thrust_setpoint(gains.attitude, wanted, estimate),
        )

    def _estimate(self, state: State, step: Int[Array, ""]) -> tuple[Vec3, Vec3, Quaternion]:
        if state.estimates is None:
            motion = state.motion
            return motion.position, motion.velocity, motion.attitude
        age = self.vehicle.setup.estimate_latency * self.schedule.physics_rate
        if self.schedule.pose_rate is not None:
            poses = step * self.schedule.step * self.schedule.pose_rate
            held = (poses - jnp.floor(poses + 1e-9)) / self.schedule.pose_rate
            age = age + held * self.schedule.physics_rate
        age = jnp.broadcast_to(age, state.crash_time.shape)
        return unpacked(look_back(state.estimates, step, age))

    def stabilise(self, state: State) -> State:
        """Run gyro filters, rate PID and mixer once; PX4 thinks in FRD."""
        controller, rate_hz = self.controller, self.schedule.rate_control_rate
        gyro = filtered(self.gyro, state.gyro, state.motion.body_rate, rate_hz)
        measured, wanted = _frd(gyro.rate), _frd(state.setpoints.rate)
        torque = rate.torque_setpoint(
            controller.rate,
            rate=measured,
            setpoint=wanted,
            acceleration=_frd(gyro.acceleration),
            integral=state.integral,
        )
        integral = rate.next_integral(
            controller.rate,
            rate=measured,
            setpoint=wanted,
            integral=state.integral,
            saturation=mixer.saturation(controller.mixer, state.command),
            step=1.0 / rate_hz,
        )
        command = mixer.mix(controller.mixer, torque, state.setpoints.thrust)
        return _replace(state, gyro=gyro, integral=integral, command=command)

    def control(self, state: State, step: Int[Array, ""]) -> State:
        """Run every controller that is due at a physics step, before the physics of that step."""
        if state.estimates is not None:
            estimates = push(state.estimates, packed(state.motion), step)
            state = _replace(state, estimates=estimates)
        if isinstance(self.inlet, ReferenceInlet):
            schedule = self.schedule
            if schedule.position_control_rate == schedule.physics_rate:
                setpoints = self.steer(state, step)
            else:
                setpoints = lax.cond(
                    schedule.control_due(step),
                    lambda: self.steer(state, step),
                    lambda: state.setpoints,
                )
            state = _replace(state, setpoints=setpoints)
        elif isinstance(self.inlet, BodyRateInlet):
            given = Setpoints(self.inlet.rate, self.inlet.thrust)
            state = _replace(state, setpoints=_like(_row(given, step), state.setpoints))
        if isinstance(self.inlet, ReferenceInlet | BodyRateInlet):
            if self.schedule.rate_control_rate == self.schedule.physics_rate:
                state = self.stabilise(state)
            else:
                state = lax.cond(
                    self.schedule.rate_due(step), lambda: self.stabilise(state), lambda: state
                )
        elif isinstance(self.inlet, ActuatorInlet):
            command = _like(_row(self.inlet.command, step), state.command)
            state = _replace(state, command=command)
        if state.commands is not None:
            commands = push(state.commands, jnp.stack(state.command), step)
            state = _replace(state, commands=commands)
        return state

    def _spin_up(self, state: State, step: Int[Array, ""]) -> tuple[PerRotor, PerRotor]:
        """Return the rotor speeds after this step and those that act during it, in rad/s."""
        if isinstance(self.inlet, RotorSpeedInlet):
            now = _like(_row(self.inlet.speed, step), state.rotor_speed)
            after = _like(_row(self.inlet.speed, step + 1), state.rotor_speed)
            a, b, c, d = (0.5 * (old + new) for old, new in zip(now, after, strict=True))
            return after, (a, b, c, d)
        motor = self.vehicle.motor
        if isinstance(self.lag, SwitchedLag) and state.commands is not None:
            age = self.vehicle.setup.actuator_latency * self.schedule.physics_rate
            age = jnp.broadcast_to(age, state.crash_time.shape)
            before, after = switched(state.commands, step, age)
            moves = [
                self.lag.advance(speed, reference_speed(motor, old), reference_speed(motor, new))
                for speed, old, new in zip(state.rotor_speed, before, after, strict=True)
            ]
        else:
            assert isinstance(self.lag, Lag)
            moves = [
                self.lag.advance(speed, reference_speed(motor, command))
                for speed, command in zip(state.rotor_speed, state.command, strict=True)
            ]
        speeds = (moves[0][0], moves[1][0], moves[2][0], moves[3][0])
        mean = (moves[0][1], moves[1][1], moves[2][1], moves[3][1])
        return speeds, mean if self.schedule.integrator == "midpoint" else state.rotor_speed

    def physics(self, state: State, step: Int[Array, ""]) -> State:
        """Advance rotors and body by one step; a vehicle that breaks the limits stays frozen."""
        speeds, acting = self._spin_up(state, step)

        def wrench_at(rotation: Matrix3, velocity: Vec3, body_rate: Vec3) -> Wrench:
            return vehicle_wrench(
                self.vehicle.aerodynamics,
                self.vehicle.rotors,
                speeds=acting,
                air_velocity=rotation.to_body(velocity),
                body_rate=body_rate,
                world_up=Vec3(rotation.x_axis.z, rotation.y_axis.z, rotation.z_axis.z),
            )

        advance = _INTEGRATORS[self.schedule.integrator]
        motion = advance(
            self.vehicle.body, state.motion, wrench_at, self.schedule.step, gravity=self.gravity
        )
        broken = self.limits.broken_by(motion) | jnp.isfinite(state.crash_time)

        def frozen(old: Array, new: Array) -> Array:
            return jnp.where(broken, old, new)

        now = (step + 1) * self.schedule.step
        first = jnp.where(jnp.isfinite(state.crash_time), state.crash_time, now)
        return _replace(
            state,
            motion=jax.tree.map(frozen, state.motion, motion),
            rotor_speed=jax.tree.map(frozen, state.rotor_speed, speeds),
            crash_time=jnp.where(broken, first, state.crash_time).astype(state.crash_time.dtype),
        )

    def until_next_sample(self, state: State, sample: Int[Array, ""]) -> State:
        """Advance from one logged sample to the next."""
        count = self.schedule.steps_per_sample

        def one(state: State, offset: Int[Array, ""]) -> tuple[State, None]:
            step = sample * count + offset
            return self.control(self.physics(state, step), step + 1), None

        return lax.scan(one, state, jnp.arange(count))[0]


def _frd(flu: Vec3) -> Vec3:
    return Vec3(flu.x, -flu.y, -flu.z)


def _row(tree: PyTree[Array], index: Int[Array, ""]) -> PyTree[Array]:
    return jax.tree.map(lambda leaf: lax.dynamic_index_in_dim(leaf, index, 0, keepdims=False), tree)


def _like(tree: PyTree[Array], other: PyTree[Array]) -> PyTree[Array]:
    return jax.tree.map(lambda a, b: jnp.broadcast_to(a, b.shape).astype(b.dtype), tree, other)


def _replace(state: State, **changes: object) -> State:
    names = list(changes)
    changed: State = eqx.tree_at(
        lambda s: [getattr(s, name) for name in names],
        state,
        [changes[name] for name in names],
        is_leaf=lambda leaf: leaf is None,
    )
    return changed


def _lag(vehicle: Vehicle, schedule: Schedule) -> Lag | SwitchedLag:
    if schedule.longest_actuator_latency == 0:
        return Lag.over(vehicle.motor, schedule.step)
    age = vehicle.setup.actuator_latency * schedule.physics_rate
    return SwitchedLag.over(vehicle.motor, schedule.step, age - jnp.floor(age))


def _batch_shape(
    vehicle: Vehicle, controller: Controller, inlet: Inlet, start: Start
) -> tuple[int, ...]:
    series = inlet.points if isinstance(inlet, ReferenceInlet) else inlet
    flags = (inlet.spins, inlet.yaw_rate) if isinstance(inlet, ReferenceInlet) else ()
    shapes = [jnp.shape(leaf)[1:] for leaf in jax.tree.leaves(series)]
    shapes += [jnp.shape(leaf) for leaf in jax.tree.leaves((vehicle, controller, start, flags))]
    return jnp.broadcast_shapes(*shapes)


def rollout(
    vehicle: Vehicle,
    controller: Controller,
    schedule: Schedule,
    inlet: Inlet,
    start: Start,
    *,
    samples: int,
    horizon: Int[Array, ""] | None = None,
    limits: Limits | None = None,
    gravity: float = GRAVITY,
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
    horizon
        If given, only so many samples are flown, and the rest of the log is zero. It may be traced:
        one compiled function serves every horizon; derivatives are then forward-mode only.
    limits
        The space in which a flight counts as flying.
    gravity
        m/s², acting on the vehicle. (PX4's Gazebo worlds have 9.8066.)

    Returns
    -------
    Rollout
        Log with leaves (samples, \\*batch), and the time of a crash.
    """
    shape = _batch_shape(vehicle, controller, inlet, start)
    plant = _Plant(
        vehicle=vehicle,
        controller=controller,
        schedule=schedule,
        limits=Limits() if limits is None else limits,
        gravity=gravity,
        inlet=inlet,
        lag=_lag(vehicle, schedule),
        gyro=GyroFilter.at(controller.filters, schedule.rate_control_rate),
    )
    state = first_state(start, schedule, plant.gyro, shape)
    state = plant.control(state, jnp.asarray(0))

    def sample_of(state: State) -> Sample:
        return Sample(state.motion, state.rotor_speed, state.command, state.setpoints)

    if horizon is None:

        def scanned(state: State, sample: Int[Array, ""]) -> tuple[State, Sample]:
            return plant.until_next_sample(state, sample), sample_of(state)

        state, log = lax.scan(scanned, state, jnp.arange(samples))
        return Rollout(log, state.crash_time)

    def logged(sample: Int[Array, ""], carried: tuple[State, Sample]) -> tuple[State, Sample]:
        state, log = carried
        log = jax.tree.map(
            lambda rows, now: lax.dynamic_update_index_in_dim(rows, now, sample, 0),
            log,
            sample_of(state),
        )
        return plant.until_next_sample(state, sample), log

    empty = jax.tree.map(
        lambda leaf: jnp.zeros((samples, *leaf.shape), leaf.dtype), sample_of(state)
    )
    state, log = lax.fori_loop(0, jnp.minimum(horizon, samples), logged, (state, empty))
    return Rollout(log, state.crash_time)
