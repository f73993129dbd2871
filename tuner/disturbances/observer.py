"""The state-space model of the filter: the rate loop with recorded set-points, a tick at a time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from sim_jax.environment import Disturbance
from sim_jax.frames import markers_of
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.numeric import replaced, row_of
from sim_jax.plant import Plant
from sim_jax.rigid_body import Motion
from sim_jax.rollout import start_simulation
from sim_jax.schedule import Schedule
from sim_jax.sensing import GyroMemory
from sim_jax.state import AIRBORNE, State
from tuner.disturbances.disturbances import SLOW, Processes, processes_of
from tuner.disturbances.ticks import TickSamples
from tuner.objective.criterion import OFFSET_UNIT, AnyArray, units_of
from tuner.objective.segments import CLOCK_OF, CLOCKS, OFFSETS, Segments
from tuner.objective.simulation import beginning_of
from tuner.vehicle.model import Model, with_coefficients

CHANNELS = ("position", "attitude", "body_rate", "rotor_speed", "command")
"""Channels of samples, in order: jax sorts the keys of a dictionary."""

SPEED_SHORT = 1e-9
"""Share by which rotors begin slower than they were seen: those in trim turn as fast as they are
asked to, and round-off would choose which of their time constants the covariance begins with."""


class FilterInput(eqx.Module):
    """Segments and samples of a filter, F segments along the last axis.

    Attributes
    ----------
    segments
        Segments whose inlet takes set-points.
    offsets
        (offsets, F) of the point.
    samples
        Channel -> its samples on ticks.
    conditions
        Names of free per-flight conditions, the last rows of ``offsets``.
    """

    segments: Segments
    offsets: Float[AnyArray, "O F"]
    samples: dict[str, TickSamples]
    conditions: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def widths(self) -> dict[str, int]:
        """Channel -> number of columns, in the order of `CHANNELS`."""
        return {
            name: int(self.samples[name].weight.shape[1])
            for name in CHANNELS
            if name in self.samples
        }


class AssumedModel(eqx.Module):
    """The model of a filter.

    Attributes
    ----------
    model
        Vehicle and controller.
    coefficients
        Name -> value of every coefficient; replaces the model's.
    strengths
        (8, F) of the disturbances, each segment's own.
    noise
        (m, F) factors on the standard deviations of the samples.
    """

    model: Model
    coefficients: dict[str, AnyArray]
    strengths: Float[AnyArray, "8 F"]
    noise: Float[AnyArray, "m F"]


class Observer(eqx.Module):
    """The loop with its disturbances and its samples, a tick at a time."""

    plant: Plant
    processes: Processes
    late: Float[Array, "O F"]
    channels: tuple[str, ...] = eqx.field(static=True)
    rate: float = eqx.field(static=True)

    @staticmethod
    def of(
        schedule: Schedule, inputs: FilterInput, assumed: AssumedModel
    ) -> tuple[Observer, State]:
        """Return the observer of a model, and the state in which the segments begin."""
        model = with_coefficients(assumed.model, assumed.coefficients)
        units = units_of(inputs.conditions)
        conditions = {
            name: inputs.offsets[len(OFFSETS) + row] * units[row]
            for row, name in enumerate(inputs.conditions)
        }
        start, inlet, environment = beginning_of(
            model, inputs.segments, schedule, conditions=conditions
        )
        plant, state = start_simulation(
            model.vehicle,
            model.controller,
            schedule,
            inlet,
            start,
            environment=environment,
            limits=AIRBORNE,  # a height that no sample corrects drifts, and ends no flight
        )
        slower = tuple(speed * (1.0 - SPEED_SHORT) for speed in state.rotor_speed)
        state = replaced(state, rotor_speed=slower)
        rate = float(schedule.log_rate)
        processes = processes_of(model.vehicle, assumed.strengths, rate)
        late = inputs.offsets[: len(OFFSETS)] * OFFSET_UNIT
        return Observer(plant, processes, late, tuple(inputs.widths), rate), state

    def numbers(self, state: State, tick: Array, in_flight: int) -> Array:
        """Return the corrected numbers of a state, (n, F), the commands in flight last."""
        rows = jnp.stack(jax.tree.leaves(_parts(state)))
        line = state.reference_history
        if line is None or not in_flight:
            return rows
        slots = self._slots(len(line), tick, in_flight)
        return jnp.concatenate([rows, *(row_of(line, slot) for slot in slots)])

    def corrected(
        self, state: State, change: Sequence[Array] | Array, tick: Array, in_flight: int
    ) -> State:
        """Return a state moved by a change of its n numbers; its attitude stays a rotation."""
        leaves, structure = jax.tree.flatten(_parts(state))
        moved = [leaf + row for leaf, row in zip(leaves, change[: len(leaves)], strict=True)]
        motion, rotor_speed, integral, gyro, lagged, read = jax.tree.unflatten(structure, moved)
        motion = Motion(
            motion.position, motion.velocity, motion.attitude.normalized(), motion.body_rate
        )
        line = state.reference_history
        if line is not None and in_flight:
            rotors = len(rotor_speed)
            for number, slot in enumerate(self._slots(len(line), tick, in_flight)):
                first = len(leaves) + number * rotors
                row = row_of(line, slot) + jnp.asarray(change[first : first + rotors])
                line = lax.dynamic_update_index_in_dim(line, row, slot, 0)
        return replaced(
            state,
            motion=motion,
            rotor_speed=rotor_speed,
            integral=integral,
            gyro=gyro,
            lagged_speed=lagged,
            read_speed=read,
            reference_history=line,
        )

    def _slots(self, length: int, tick: Array, in_flight: int) -> list[Array]:
        """Return the places of the last commands in a delay line, the newest first."""
        step = self._step(tick)
        return [jnp.mod(step - 1 - number, length) for number in range(in_flight)]

    def _step(self, tick: Array) -> Array:
        """Return the step of physics that begins at a tick."""
        schedule = self.plant.schedule
        return tick * round(schedule.physics_rate / schedule.log_rate)

    def next(self, state: State, pushed: Array, tick: Array, draught: Array) -> State:
        """Return the state a tick later, with disturbances of values (D, *F).

        ``draught`` (*F) is the standard error of the estimated gusts upwards, in m/s².
        """
        acting = self.processes.disturbance(pushed)
        if self.plant.environment.disturbance is not None:
            known: Disturbance = row_of(self.plant.environment.disturbance, tick)
            acting = acting.plus(known)
        environment = eqx.tree_at(
            lambda e: (e.disturbance, e.draught),
            self.plant.environment,
            (acting, self.processes.acts[SLOW.index("gust_z")] * draught),
            is_leaf=lambda leaf: leaf is None,
        )
        plant = eqx.tree_at(lambda p: p.environment, self.plant, environment)
        after: State = plant.sample(state, tick)[0]
        return after

    def outputs(self, state: State, tick: Array | None = None) -> dict[str, Array]:
        """Return channel -> (c, F), the values that a recording would have.

        Commands only at a given tick: they hold until the next, and nothing is read between.
        """
        position, attitude = markers_of(self.plant.vehicle).recorded(state.motion)
        rate = self.plant.senses.reading(state.motion.body_rate)
        signals: dict[str, Any] = {
            "position": (position.x, position.y, position.z),
            "attitude": (attitude.w, attitude.x, attitude.y, attitude.z),
            "body_rate": (rate.x, rate.y, rate.z),
            "rotor_speed": state.rotor_speed if state.read_speed is None else state.read_speed,
        }
        if tick is not None and "command" in self.channels:
            to_come = self.plant.inlet.next_command(self.plant, state, self._step(tick))
            signals["command"] = to_come.command
        shape = self.late.shape[1:]
        return {
            name: jnp.stack([jnp.broadcast_to(leaf, shape) for leaf in signals[name]])
            for name in self.channels
            if name in signals
        }

    def sampled(self, samples: dict[str, TickSamples]) -> Array:
        """Return which rows of `errors` (m, F) have samples."""
        return jnp.concatenate([samples[name].weight > 0 for name in self.channels])

    def errors(
        self, now: dict[str, Array], before: dict[str, Array], samples: dict[str, TickSamples]
    ) -> list[Array]:
        """Return outputs minus samples, channel by channel, in standard deviations: m rows."""
        rows = []
        for name in self.channels:
            sample, there = samples[name], now[name]
            if name in before:
                place = sample.place - self.late[CLOCK_OF[name]] * self.rate
                there = before[name] + place * (there - before[name])
            if name == "attitude":
                outputs = Quaternion.of(there).normalized()
                error = Quaternion.of(sample.values).rotation_vector_to(outputs).stacked()
            elif name == "body_rate":
                error = there + self.late[len(CLOCKS) :] - sample.values
            else:
                error = there - sample.values
            rows.append(jnp.where(sample.weight > 0, error * sample.weight, 0.0))
        return rows


def _parts(state: State) -> tuple[Motion, Any, Vec3, GyroMemory, Any, Any]:
    """Return the corrected parts of a state: 32 numbers with both gyro filters.

    And four with a second lag of the motors, four with one of the tachometers.
    """
    lags = state.lagged_speed, state.read_speed
    return state.motion, state.rotor_speed, state.integral, state.gyro, *lags


def commands_in_flight(state: State, count: int) -> int:
    """Return the number of commands in flight among ``count`` corrected numbers."""
    return (count - len(jax.tree.leaves(_parts(state)))) // len(state.rotor_speed)


def first_errors(state: State, in_flight: int) -> np.ndarray[Any, Any]:
    """Return the standard deviations (n,) of a flight's initial state."""

    def filled(tree: Any, sd: float) -> Any:
        return jax.tree.map(lambda _: sd, tree)

    motion, rotor_speed, integral, gyro, lagged, read = _parts(state)
    errors = (
        Motion(
            filled(motion.position, 1e-3),
            filled(motion.velocity, 0.02),
            filled(motion.attitude, 0.0025),
            filled(motion.body_rate, 0.03),
        ),
        filled(rotor_speed, 3.0),
        filled(integral, 0.01),
        GyroMemory(
            filled(gyro.newer, 0.03),
            filled(gyro.older, 0.03),
            filled(gyro.rate, 0.03),
            filled(gyro.acceleration, 0.3),
        ),
        filled(lagged, 3.0),
        filled(read, 3.0),
    )
    return np.asarray([*jax.tree.leaves(errors), *[3.0] * (in_flight * len(rotor_speed))])
