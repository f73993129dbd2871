"""One step of the closed loop: its stages and their order."""

from __future__ import annotations

from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Int, PyTree

from sim_jax.control import mixer, rate
from sim_jax.control.gains import Controller
from sim_jax.control.geometric import (
    acceleration_setpoint,
    attitude_from_acceleration,
    heading_of,
    rate_setpoint,
    thrust_setpoint,
)
from sim_jax.environment import Air, Environment
from sim_jax.frames import Gyro, estimated_motion
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import Inlet, ReferenceInlet
from sim_jax.motor import Lag, SwitchedLag, reference_speed
from sim_jax.numeric import Array, cast_like, rematerialised, repeat, replaced, row_of, where
from sim_jax.rigid_body import Integrator, Motion, Wrench, step_midpoint, step_semi_implicit
from sim_jax.schedule import Schedule
from sim_jax.sensing import (
    GyroFilter,
    Tachometer,
    filter_gyro,
    look_back,
    pack_motion,
    push,
    read_between,
    unpack_motion,
)
from sim_jax.state import Limits, Setpoints, State
from sim_jax.terms import total_wrench
from sim_jax.vehicle import PerRotor, Vehicle

T = TypeVar("T")


class Sample(eqx.Module):
    """A logged sample: the state at a time, and the commands computed then.

    In a `Rollout` every leaf is (samples, \\*batch).
    """

    motion: Motion
    rotor_speed: PerRotor
    """rad/s."""
    command: PerRotor
    """0..1, as the mixer gave them."""
    setpoints: Setpoints
    read_speed: PerRotor | None = None
    """rad/s, as of `State`."""


_INTEGRATORS: dict[str, Integrator] = {
    "midpoint": step_midpoint,
    "semi_implicit": step_semi_implicit,
}


class Plant(eqx.Module):
    """The vehicle and its controllers with everything that is computed once a rollout."""

    vehicle: Vehicle
    controller: Controller
    environment: Environment
    schedule: Schedule = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    gravity: float = eqx.field(static=True)
    reversible: bool = eqx.field(static=True)
    inlet: Inlet
    lag: Lag | SwitchedLag
    gyro: GyroFilter
    senses: Gyro
    """The model of the gyro."""
    tachometer: Tachometer | None = None

    def position_control(
        self, state: State, step: Int[Array, ""], reference: ReferenceInlet
    ) -> Setpoints:
        """Return the set-points of position and attitude control, updated when due."""
        if self.schedule.block_rate == self.schedule.position_control_rate:
            return self._follow(state, step, reference)
        due = self.schedule.is_due(step, self.schedule.position_control_rate)
        setpoints: Setpoints = lax.cond(
            due, lambda: self._follow(state, step, reference), lambda: state.setpoints
        )
        return setpoints

    def _follow(self, state: State, step: Int[Array, ""], reference: ReferenceInlet) -> Setpoints:
        """Run position and attitude control on the estimate as old as it is."""
        point = row_of(reference.points, self.schedule.control_tick(step))
        position, velocity, estimate = self._estimate(state, step)
        gains = self.controller
        heading, turns_freely = heading_of(gains.position, velocity), reference.spins
        if reference.level_held is not None:
            heading = where(reference.level_held, estimate.heading(), heading)
            turns_freely = turns_freely & ~reference.level_held
        wanted = acceleration_setpoint(gains.position, point, position, velocity, heading)
        goal = attitude_from_acceleration(wanted, heading)
        turn = rate_setpoint(gains.attitude, estimate, goal)
        still = jnp.zeros_like(turn.x)
        return Setpoints(
            rate=Vec3(
                jnp.where(turns_freely, still, turn.x),
                jnp.where(turns_freely, still, turn.y),
                jnp.where(reference.spins, reference.yaw_rate, turn.z),
            ),
            thrust=thrust_setpoint(gains.attitude, wanted, estimate),
        )

    def _estimate(self, state: State, step: Int[Array, ""]) -> tuple[Vec3, Vec3, Quaternion]:
        motion = state.motion
        if state.estimate_history is None:
            seen = estimated_motion(self.vehicle, self.controller, motion)
            return seen.position, seen.velocity, seen.attitude
        age = self.vehicle.setup.estimate_latency * self.schedule.physics_rate
        if self.schedule.pose_rate is not None:
            poses = step * self.schedule.step * self.schedule.pose_rate
            waited = (poses - jnp.floor(poses + 1e-9)) / self.schedule.pose_rate
            age = age + waited * self.schedule.physics_rate
        return unpack_motion(look_back(state.estimate_history, step, age))

    def rate_control(self, state: State, step: Int[Array, ""]) -> State:
        """Run rate control where it is due."""
        if self.schedule.rate_control_rate == self.schedule.physics_rate:
            return self._stabilise(state)
        due = self.schedule.is_due(step, self.schedule.rate_control_rate)
        commanded: State = lax.cond(due, lambda: self._stabilise(state), lambda: state)
        return commanded

    def _stabilise(self, state: State) -> State:
        """Run gyro filters, rate PID and mixer once; PX4 thinks in FRD."""
        controller, rate_hz = self.controller, self.schedule.rate_control_rate
        gyro = filter_gyro(
            self.gyro, state.gyro, self.senses.reading(state.motion.body_rate), rate_hz
        )
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
        command = mixer.mix(
            controller.mixer,
            torque,
            state.setpoints.thrust,
            desaturates=controller.rate.saturation_feedback > 0.5,
            counts=~jnp.isfinite(state.crash_time),
        )
        return self.commanded(replaced(state, gyro=gyro, integral=integral), command)

    def commanded(self, state: State, command: PerRotor) -> State:
        """Return the state in which the motors have received commands 0..1."""
        speeds = tuple(reference_speed(self.vehicle.motor, share) for share in command)
        return replaced(
            state, command=command, reference_speed=cast_like(speeds, state.reference_speed)
        )

    def motors(self, state: State, step: Int[Array, ""]) -> tuple[PerRotor, PerRotor]:
        """Return the rotor speeds after a step and those that act during it, in rad/s."""
        asked = [self._on_battery(references, step) for references in self._asked(state, step)]
        if state.lagged_speed is not None:
            asked.append(self._on_battery(state.lagged_speed, step))
        moves = [
            self.lag.advance(*speeds) for speeds in zip(state.rotor_speed, *asked, strict=True)
        ]
        speeds = tuple(end for end, _ in moves)
        mean = tuple(mean for _, mean in moves)
        return speeds, mean if self.schedule.integrator == "midpoint" else state.rotor_speed

    def _asked(self, state: State, step: Int[Array, ""]) -> tuple[PerRotor | Array, ...]:
        """Return the reference speeds of a step in rad/s: of both its parts where it has two."""
        if state.reference_history is None:
            return (state.reference_speed,)
        age = self.vehicle.setup.actuator_latency * self.schedule.physics_rate
        return read_between(state.reference_history, step, age)

    def _on_battery(self, references: T, step: Int[Array, ""]) -> T:
        """Return reference speeds, rad/s, as the battery's voltage lets the motors reach them."""
        exponent = self.vehicle.effects.get("battery_exponent")
        factor = self.environment.speed_factor(exponent, step, self.schedule)
        if factor is None:
            return references
        reached: T = jax.tree.map(lambda speed: factor * speed, references)
        return reached

    def physics(self, state: State, step: Int[Array, ""]) -> State:
        """Advance rotors and body by one step."""
        speeds, acting = self.inlet.next_rotor_speeds(self, state, step)
        accelerations: PerRotor = ()
        if "rotor_inertia" in self.vehicle.effects:
            changes = zip(speeds, state.rotor_speed, strict=True)
            accelerations = tuple((end - begin) / self.schedule.step for end, begin in changes)

        around = self.environment.during(step, self.schedule)

        def wrench_at(predicted: Motion) -> Wrench:
            motion = self.inlet.felt(predicted, step)
            air = Air.around(self.vehicle, motion, around, accelerations)
            wrench = total_wrench(self.vehicle, motion, acting, air)
            pushing = around.disturbance
            return wrench if pushing is None else pushing.added_to(wrench, motion)

        integrator = self.schedule.integrator
        advance = _INTEGRATORS[integrator] if isinstance(integrator, str) else integrator
        motion = advance(
            self.vehicle.body, state.motion, wrench_at, self.schedule.step, gravity=self.gravity
        )
        return replaced(state, motion=self.inlet.next_motion(motion, step), rotor_speed=speeds)

    def step(self, state: State, step: Int[Array, ""]) -> State:
        """Advance by one physics step, rate control before it; remember what is seen later."""
        state = self.inlet.next_command(self, state, step)
        if state.reference_history is not None:
            history = push(state.reference_history, jnp.stack(state.reference_speed), step)
            state = replaced(state, reference_history=history)
        turning = state.rotor_speed
        state = self.physics(state, step)
        if self.tachometer is not None and state.read_speed is not None:
            speeds = zip(state.read_speed, turning, state.rotor_speed, strict=True)
            read = tuple(self.tachometer.reading(*each) for each in speeds)
            state = replaced(state, read_speed=read)
        if state.lagged_speed is not None:
            held = zip(state.lagged_speed, *self._asked(state, step), strict=True)
            lagged = tuple(self.lag.lag_reference(*speeds) for speeds in held)
            state = replaced(state, lagged_speed=lagged)
        if state.estimate_history is not None:
            seen = estimated_motion(self.vehicle, self.controller, state.motion)
            history = push(state.estimate_history, pack_motion(seen), step + 1)
            state = replaced(state, estimate_history=history)
        return state

    def block(self, state: State, number: Int[Array, ""]) -> tuple[State, Sample]:
        """Run position control, then the physics up to its next tick.

        Returns the next state and what is to be logged for the time before it. A vehicle that
        breaks the limits stays as it was at the last tick.
        """
        schedule, start = self.schedule, state
        count = schedule.steps_per_block
        crashed = jnp.isfinite(state.crash_time)
        setpoints = self.inlet.next_setpoints(self, state, number * count)
        state = replaced(state, setpoints=where(crashed, start.setpoints, setpoints))

        def advance(
            offset: Int[Array, ""], carried: tuple[State, PerRotor]
        ) -> tuple[State, PerRotor]:
            before, command = carried
            if self.reversible:  # what no step changes need not be remembered at every step
                before = replaced(before, setpoints=state.setpoints, crash_time=state.crash_time)
            after = self.step(before, number * count + offset)
            return after, where(offset == 0, after.command, command)

        body = rematerialised(advance) if self.reversible else advance
        end, command = repeat(count, body, (state, state.command))
        logged = where(crashed, start.command, command)
        row = Sample(start.motion, start.rotor_speed, logged, state.setpoints, start.read_speed)
        broken = crashed | self.limits.broken_by(end.motion)
        now = (number + 1) / schedule.block_rate
        crash_time = jnp.where(broken & ~crashed, now, start.crash_time).astype(
            start.crash_time.dtype
        )
        kept = where(broken, _flight(state), _flight(end))
        return replaced(end, **kept, crash_time=crash_time), row

    def sample(self, state: State, number: Int[Array, ""]) -> tuple[State, Sample]:
        """Advance to the next sample; return the state there and what is logged for before."""
        count = self.schedule.blocks_per_sample
        if count == 1:
            return self.block(state, number)

        def next_block(state: State, offset: Int[Array, ""]) -> tuple[State, Sample]:
            return self.block(state, number * count + offset)

        state, rows = lax.scan(next_block, state, jnp.arange(count))
        return state, jax.tree.map(lambda leaf: leaf[0], rows)


def _flight(state: State) -> dict[str, PyTree[Array]]:
    """Return the part of the state that is frozen after a crash."""
    motors = ("rotor_speed", "command", "reference_speed", "lagged_speed", "read_speed")
    return {name: getattr(state, name) for name in ("motion", "integral", "gyro", *motors)}


def _frd(flu: Vec3) -> Vec3:
    return Vec3(flu.x, -flu.y, -flu.z)
