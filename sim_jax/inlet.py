"""Where a recorded signal enters the loop and replaces the stages upstream of it.

An inlet is a class. What it does not override, the loop's own stages do::

    position control ──> rate control ──>   motors   ──>   rigid body
     next_setpoints      next_command   next_rotor_speeds  felt, next_motion
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeVar, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float, Int

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import Array, Scalar, cast_like, replaced, row_of, where
from sim_jax.rigid_body import Motion
from sim_jax.state import Setpoints, State
from sim_jax.vehicle import PerRotor

T = TypeVar("T")
Step = Int[Array, ""]
"""Number of a physics step."""


@runtime_checkable
class Stages(Protocol):
    """The loop's own stages, on which an inlet calls for what it does not replace."""

    def position_control(self, state: State, step: Step, reference: ReferenceInlet) -> Setpoints:
        """Return the set-points of position and attitude control."""
        ...

    def rate_control(self, state: State, step: Step) -> State:
        """Return the state after gyro filters, rate control and mixer, where they are due."""
        ...

    def commanded(self, state: State, command: PerRotor) -> State:
        """Return the state in which the motors have received commands 0..1."""
        ...

    def motors(self, state: State, step: Step) -> tuple[PerRotor, PerRotor]:
        """Return the rotor speeds in rad/s after a step, and those that act during it."""
        ...


class Inlet(eqx.Module):
    """An input of the loop; a subclass overrides the stages that it replaces."""

    @property
    def needs_mixer(self) -> bool:
        """Whether commands come from the mixer, which is a quad X's."""
        return False

    def next_setpoints(self, stages: Stages, state: State, step: Step) -> Setpoints:
        """Return the set-points of the rate controller."""
        return state.setpoints

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        """Return the state with the motor commands of a step."""
        return stages.rate_control(state, step)

    def next_rotor_speeds(
        self, stages: Stages, state: State, step: Step
    ) -> tuple[PerRotor, PerRotor]:
        """Return the rotor speeds in rad/s after a step, and those that act during it."""
        return stages.motors(state, step)

    def felt(self, motion: Motion, step: Step) -> Motion:
        """Return the motion in which forces act during a step, of which an inlet may know a part.

        An integrator asks for forces in a motion that it predicts within the step.
        """
        return motion

    def next_motion(self, moved: Motion, step: Step) -> Motion:
        """Return the motion after a step, of which an inlet may replace a part."""
        return moved

    def batch_shape(self) -> tuple[int, ...]:
        """Return the shape of the batch: that of all leaves, without their first axis of time."""
        return jnp.broadcast_shapes(*(jnp.shape(leaf)[1:] for leaf in jax.tree.leaves(self)))

    def rotor_counts(self) -> set[int]:
        """Return for how many rotors something is fed in; empty where nothing is."""
        return set()

    def trimmed(self, trim: PerRotor) -> Inlet:
        """Return the inlet with a steady difference of each rotor, if something is fed into rotors.

        Commands are increased by ``trim``, rotor speeds by that share of themselves.
        """
        return self


class ReferenceInlet(Inlet):
    """The whole loop is simulated; leaves of ``points`` are (ticks, \\*batch), one a control tick.

    After its end the last point stays.
    """

    points: ReferencePoint
    spins: Bool[Array, "*batch"] = eqx.field(default_factory=lambda: jnp.zeros((), bool))
    """Where true, the rate set-point is (0, 0, yaw_rate) and only thrust is position-controlled,
    but for a vehicle that is held level."""
    yaw_rate: Scalar = eqx.field(default_factory=lambda: jnp.zeros(()))
    """rad/s, body z."""
    level_held: Bool[Array, "*batch"] | None = None
    """Where true, a spin's roll and pitch rate set-points are those of position and attitude
    control, which take the vehicle's own heading for the wanted one; None where no vehicle's are.
    """

    @property
    def needs_mixer(self) -> bool:
        return True

    def next_setpoints(self, stages: Stages, state: State, step: Step) -> Setpoints:
        return stages.position_control(state, step, self)

    def batch_shape(self) -> tuple[int, ...]:
        series = (jnp.shape(leaf)[1:] for leaf in jax.tree.leaves(self.points))
        modes = (self.spins, self.yaw_rate, self.level_held)
        shapes = (jnp.shape(mode) for mode in modes if mode is not None)
        return jnp.broadcast_shapes(*series, *shapes)


class BodyRateInlet(Inlet):
    """Rate and thrust set-points replace position control; leaves are (physics steps, \\*batch)."""

    rate: Vec3
    """rad/s, body FLU."""
    thrust: Float[Array, "steps *batch"]

    @property
    def needs_mixer(self) -> bool:
        return True

    def next_setpoints(self, stages: Stages, state: State, step: Step) -> Setpoints:
        return cast_like(row_of(Setpoints(self.rate, self.thrust), step), state.setpoints)

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        setpoints = self.next_setpoints(stages, state, step)
        return stages.rate_control(replaced(state, setpoints=setpoints), step)


class ActuatorInlet(Inlet):
    """Motor commands 0..1 replace all control; leaves are (physics steps, \\*batch)."""

    command: PerRotor

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        return stages.commanded(state, cast_like(row_of(self.command, step), state.command))

    def rotor_counts(self) -> set[int]:
        return {len(self.command)}

    def trimmed(self, trim: PerRotor) -> Inlet:
        pairs = zip(self.command, trim, strict=True)
        return ActuatorInlet(tuple(command + more for command, more in pairs))


class RotorSpeedInlet(Inlet):
    """Rotor speeds in rad/s replace control and motors; leaves are (physics steps, \\*batch)."""

    speed: PerRotor

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        return state

    def next_rotor_speeds(
        self, stages: Stages, state: State, step: Step
    ) -> tuple[PerRotor, PerRotor]:
        before = cast_like(row_of(self.speed, step), state.rotor_speed)
        after = cast_like(row_of(self.speed, step + 1), state.rotor_speed)
        return after, tuple(0.5 * (old + new) for old, new in zip(before, after, strict=True))

    def rotor_counts(self) -> set[int]:
        return {len(self.speed)}

    def trimmed(self, trim: PerRotor) -> Inlet:
        pairs = zip(self.speed, trim, strict=True)
        return RotorSpeedInlet(tuple(speed * (1.0 + more) for speed, more in pairs))


class AttitudeInlet(Inlet):
    """Recorded attitude and body rate are followed, and translation alone is simulated.

    What turns the vehicle (inertia, moments, control) then has no effect at all; leaves are
    (physics steps + 1, \\*batch).
    """

    attitude: Quaternion
    """Body to world."""
    body_rate: Vec3
    """rad/s, body FLU."""
    drive: Inlet
    """The input of the rotors: motor commands or rotor speeds."""

    @property
    def needs_mixer(self) -> bool:
        return self.drive.needs_mixer

    def next_setpoints(self, stages: Stages, state: State, step: Step) -> Setpoints:
        return self.drive.next_setpoints(stages, state, step)

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        return self.drive.next_command(stages, state, step)

    def next_rotor_speeds(
        self, stages: Stages, state: State, step: Step
    ) -> tuple[PerRotor, PerRotor]:
        return self.drive.next_rotor_speeds(stages, state, step)

    def felt(self, motion: Motion, step: Step) -> Motion:
        """Return the motion with the body rate of mid-step, whatever moments would make of it."""
        mean = 0.5 * (row_of(self.body_rate, step) + row_of(self.body_rate, step + 1))
        return Motion(
            motion.position, motion.velocity, motion.attitude, cast_like(mean, motion.body_rate)
        )

    def next_motion(self, moved: Motion, step: Step) -> Motion:
        attitude, body_rate = row_of((self.attitude, self.body_rate), step + 1)
        return Motion(
            moved.position,
            moved.velocity,
            cast_like(attitude, moved.attitude),
            cast_like(body_rate, moved.body_rate),
        )

    def rotor_counts(self) -> set[int]:
        return self.drive.rotor_counts()


class MixedInlet(Inlet):
    """Each vehicle of a batch has its own inlet; the loop is stepped once for every part."""

    parts: tuple[Inlet, ...]
    """For the whole batch each; what a part holds for a vehicle of another part is ignored."""
    kind: Int[Array, "*batch"]
    """Number of the part that each vehicle uses."""

    @property
    def needs_mixer(self) -> bool:
        return any(part.needs_mixer for part in self.parts)

    def next_setpoints(self, stages: Stages, state: State, step: Step) -> Setpoints:
        return self._of_each(lambda part: part.next_setpoints(stages, state, step))

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        return self._of_each(lambda part: part.next_command(stages, state, step))

    def next_rotor_speeds(
        self, stages: Stages, state: State, step: Step
    ) -> tuple[PerRotor, PerRotor]:
        return self._of_each(lambda part: part.next_rotor_speeds(stages, state, step))

    def felt(self, motion: Motion, step: Step) -> Motion:
        return self._of_each(lambda part: part.felt(motion, step))

    def next_motion(self, moved: Motion, step: Step) -> Motion:
        return self._of_each(lambda part: part.next_motion(moved, step))

    def batch_shape(self) -> tuple[int, ...]:
        shapes = (part.batch_shape() for part in self.parts)
        return jnp.broadcast_shapes(*shapes, jnp.shape(self.kind))

    def rotor_counts(self) -> set[int]:
        return set().union(*(part.rotor_counts() for part in self.parts))

    def trimmed(self, trim: PerRotor) -> Inlet:
        return MixedInlet(tuple(part.trimmed(trim) for part in self.parts), self.kind)

    def _of_each(self, result: Callable[[Inlet], T]) -> T:
        """Return for every vehicle the result of its own part."""
        chosen, *others = [result(part) for part in self.parts]
        for number, other in enumerate(others, start=1):
            chosen = where(self.kind == number, other, chosen)
        return chosen
