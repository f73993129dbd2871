"""What happens in one step of the closed loop: who computes what, and in which order."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Int, PyTree

from sim_jax.control import attitude, mixer, rate
from sim_jax.control.gains import Controller
from sim_jax.control.position import (
    attitude_from_acceleration,
    heading_of,
    thrust_setpoint,
    wanted_acceleration,
)
from sim_jax.crash import Limits
from sim_jax.inlet import (
    ActuatorInlet,
    BodyRateInlet,
    Inlet,
    MixedInlet,
    ReferenceInlet,
    RotorSpeedInlet,
)
from sim_jax.motor import Lag, SwitchedLag, reference_speed
from sim_jax.rigid_body import Motion, Wrench, step_midpoint, step_rk4, step_semi_implicit
from sim_jax.rotation import Quaternion
from sim_jax.schedule import Schedule
from sim_jax.sensing import GyroFilter, filtered, look_back, packed, push, switched, unpacked
from sim_jax.state import Setpoints, State
from sim_jax.terms.air import Air
from sim_jax.terms.total import total_wrench
from sim_jax.trees import forgetful, like, repeat, replaced, row_of, where
from sim_jax.vector import Vec3
from sim_jax.vehicle import PerRotor, Vehicle

T = TypeVar("T")


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


_INTEGRATORS = {
    "midpoint": step_midpoint,
    "semi_implicit": step_semi_implicit,
    "rk4": step_rk4,
}


class Plant(eqx.Module):
    """The vehicle and its controllers with everything that is computed once a rollout."""

    vehicle: Vehicle
    controller: Controller
    schedule: Schedule = eqx.field(static=True)
    limits: Limits = eqx.field(static=True)
    gravity: float = eqx.field(static=True)
    reversible: bool = eqx.field(static=True)
    inlet: Inlet
    lag: Lag | SwitchedLag
    gyro: GyroFilter

    def steer(self, state: State, step: Int[Array, ""]) -> Setpoints:
        """Run position and attitude control on the estimate as old as it is."""
        assert isinstance(self.inlet, ReferenceInlet)
        points = self.inlet.points
        tick = self.schedule.control_tick(step)
        reference = row_of(points, tick)
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
        motion = state.motion
        if state.estimates is None:
            return motion.position, motion.velocity, motion.attitude
        age = self.vehicle.setup.estimate_latency * self.schedule.physics_rate
        if self.schedule.pose_rate is not None:
            poses = step * self.schedule.step * self.schedule.pose_rate
            held = (poses - jnp.floor(poses + 1e-9)) / self.schedule.pose_rate
            age = age + held * self.schedule.physics_rate
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
        flying = ~jnp.isfinite(state.crash_time)
        command = mixer.mix(controller.mixer, torque, state.setpoints.thrust, counts=flying)
        return self.tell(replaced(state, gyro=gyro, integral=integral), command)

    def tell(self, state: State, command: PerRotor) -> State:
        """Return a state in which the motors have been given commands 0..1."""
        a, b, c, d = (reference_speed(self.vehicle.motor, one) for one in command)
        return replaced(state, command=command, asked=like((a, b, c, d), state.asked))

    def mixed(self, result: Callable[[Plant], T]) -> T:
        """Return a result with each part's inlet, every vehicle's from its own."""
        assert isinstance(self.inlet, MixedInlet)
        found = [
            result(eqx.tree_at(lambda p: p.inlet, self, part, is_leaf=_is_inlet))
            for part in self.inlet.parts
        ]
        for number, one in enumerate(found[1:], start=1):
            found[0] = where(self.inlet.kind == number, one, found[0])
        return found[0]

    def setpoints(self, state: State, step: Int[Array, ""]) -> Setpoints:
        """Return what the rate controller is to follow: from position control or the inlet."""
        if isinstance(self.inlet, MixedInlet):
            return self.mixed(lambda plant: plant.setpoints(state, step))
        if isinstance(self.inlet, BodyRateInlet):
            given = Setpoints(self.inlet.rate, self.inlet.thrust)
            return like(row_of(given, step), state.setpoints)
        if not isinstance(self.inlet, ReferenceInlet):
            return state.setpoints
        if self.schedule.block_rate == self.schedule.position_control_rate:
            return self.steer(state, step)
        due = self.schedule.control_due(step)
        aimed: Setpoints = lax.cond(due, lambda: self.steer(state, step), lambda: state.setpoints)
        return aimed

    def command(self, state: State, step: Int[Array, ""]) -> State:
        """Bring the motor commands up to date, by rate control or from the inlet."""
        if isinstance(self.inlet, MixedInlet):
            return self.mixed(lambda plant: plant.command(state, step))
        if isinstance(self.inlet, BodyRateInlet):
            state = replaced(state, setpoints=self.setpoints(state, step))
        if isinstance(self.inlet, ActuatorInlet):
            command = like(row_of(self.inlet.command, step), state.command)
            return self.tell(state, command)
        if isinstance(self.inlet, RotorSpeedInlet):
            return state
        if self.schedule.rate_control_rate == self.schedule.physics_rate:
            return self.stabilise(state)
        due = self.schedule.rate_due(step)
        commanded: State = lax.cond(due, lambda: self.stabilise(state), lambda: state)
        return commanded

    def spin_up(self, state: State, step: Int[Array, ""]) -> tuple[PerRotor, PerRotor]:
        """Return the rotor speeds after this step and those that act during it, in rad/s."""
        if isinstance(self.inlet, MixedInlet):
            return self.mixed(lambda plant: plant.spin_up(state, step))
        if isinstance(self.inlet, RotorSpeedInlet):
            now = like(row_of(self.inlet.speed, step), state.rotor_speed)
            later = like(row_of(self.inlet.speed, step + 1), state.rotor_speed)
            a, b, c, d = (0.5 * (old + new) for old, new in zip(now, later, strict=True))
            return later, (a, b, c, d)
        if isinstance(self.lag, SwitchedLag) and state.asked_before is not None:
            age = self.vehicle.setup.actuator_latency * self.schedule.physics_rate
            before, after = switched(state.asked_before, step, age)
            moves = [
                self.lag.advance(speed, old, new)
                for speed, old, new in zip(state.rotor_speed, before, after, strict=True)
            ]
        else:
            assert isinstance(self.lag, Lag)
            moves = [
                self.lag.advance(speed, asked)
                for speed, asked in zip(state.rotor_speed, state.asked, strict=True)
            ]
        speeds = (moves[0][0], moves[1][0], moves[2][0], moves[3][0])
        mean = (moves[0][1], moves[1][1], moves[2][1], moves[3][1])
        return speeds, mean if self.schedule.integrator == "midpoint" else state.rotor_speed

    def physics(self, state: State, step: Int[Array, ""]) -> State:
        """Advance rotors and body by one step."""
        speeds, acting = self.spin_up(state, step)

        def wrench_at(motion: Motion) -> Wrench:
            air = Air.around(self.vehicle, motion)
            return total_wrench(self.vehicle, motion, acting, air)

        advance = _INTEGRATORS[self.schedule.integrator]
        motion = advance(
            self.vehicle.body, state.motion, wrench_at, self.schedule.step, gravity=self.gravity
        )
        return replaced(state, motion=motion, rotor_speed=speeds)

    def step(self, state: State, step: Int[Array, ""]) -> State:
        """Advance by one physics step, rate control before it; remember what is seen later."""
        state = self.command(state, step)
        if state.asked_before is not None:
            asked_before = push(state.asked_before, jnp.stack(state.asked), step)
            state = replaced(state, asked_before=asked_before)
        state = self.physics(state, step)
        if state.estimates is not None:
            estimates = push(state.estimates, packed(state.motion), step + 1)
            state = replaced(state, estimates=estimates)
        return state

    def block(self, state: State, number: Int[Array, ""]) -> tuple[State, Sample]:
        """Run position control, then the physics up to its next tick.

        Returns the next state and what is to be logged for the time before it. A vehicle that
        breaks the limits stays as it was at the last tick.
        """
        schedule, start = self.schedule, state
        count = schedule.steps_per_block
        gone = jnp.isfinite(state.crash_time)
        setpoints = self.setpoints(state, number * count)
        state = replaced(state, setpoints=where(gone, start.setpoints, setpoints))

        def one(offset: Int[Array, ""], carried: tuple[State, PerRotor]) -> tuple[State, PerRotor]:
            before, command = carried
            after = self.step(before, number * count + offset)
            return after, where(offset == 0, after.command, command)

        body = forgetful(one) if self.reversible else one
        end, command = repeat(count, body, (state, state.command))
        row = Sample(
            start.motion, start.rotor_speed, where(gone, start.command, command), state.setpoints
        )
        broken = gone | self.limits.broken_by(end.motion)
        now = (number + 1) / schedule.block_rate
        crash_time = jnp.where(broken & ~gone, now, start.crash_time).astype(start.crash_time.dtype)
        kept = where(broken, _flight(state), _flight(end))
        return replaced(end, **kept, crash_time=crash_time), row

    def sample(self, state: State, number: Int[Array, ""]) -> tuple[State, Sample]:
        """Advance to the next sample; return the state there and what is logged for before."""
        count = self.schedule.blocks_per_sample
        if count == 1:
            return self.block(state, number)

        def one(state: State, offset: Int[Array, ""]) -> tuple[State, Sample]:
            return self.block(state, number * count + offset)

        state, rows = lax.scan(forgetful(one), state, jnp.arange(count))
        return state, jax.tree.map(lambda leaf: leaf[0], rows)


def _flight(state: State) -> dict[str, PyTree[Array]]:
    """Return what stays as it is once a vehicle has crashed."""
    names = ("motion", "rotor_speed", "integral", "gyro", "command", "asked")
    return {name: getattr(state, name) for name in names}


def _frd(flu: Vec3) -> Vec3:
    return Vec3(flu.x, -flu.y, -flu.z)


def _is_inlet(node: object) -> bool:
    return isinstance(node, Inlet)
