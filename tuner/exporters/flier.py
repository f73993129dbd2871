"""A vehicle flown in a simulator that is not this project's, by this project's controllers.

Position control, rate control, mixer, latencies and the recorded reference are those of
`sim_jax.plant`; what a command does to the body is the other simulator's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Protocol

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from sim_jax.frames import estimated
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import SwitchedLag
from sim_jax.numeric import Array as JaxArray
from sim_jax.numeric import replaced
from sim_jax.plant import Plant, Sample
from sim_jax.rigid_body import Motion
from sim_jax.rollout import begun
from sim_jax.schedule import Schedule
from sim_jax.sensing import packed, push, switched
from sim_jax.state import Limits, State
from tuner.core.numerics import Array
from tuner.objective.segments import Segments
from tuner.objective.simulation import Flown, beginning_of, recorded_of
from tuner.vehicle.model import Model


class Body(Protocol):
    """One vehicle in another simulator.

    Its state is position, velocity (m and m/s, world), attitude (w, x, y, z; body to world) and
    body rate (rad/s, body), 13 numbers.
    """

    def begin(self, state: Array, rotor_speed: Array) -> None:
        """Set the state (13,) and the rotor speeds in the vehicle file's rad/s."""

    def step(self, asked: Array) -> Array:
        """Advance by a physics step in which so many rad/s are asked of the rotors; the state."""

    def rotor_speed(self) -> Array:
        """Return the rotor speeds in the vehicle file's rad/s."""


def flier(make: Callable[[float], Body]) -> Callable[..., Flown]:
    """Return what flies segments as `tuner.objective.simulation.fly` does, in another simulator.

    Parameters
    ----------
    make
        The step in s -> a vehicle at rest.
    """

    def fly(
        model: Model,
        segments: Segments,
        schedule: Schedule,
        *,
        samples: int,
        limits: Limits,
        states: Any = None,
        conditions: Mapping[str, Any] = MappingProxyType({}),
        channels: tuple[str, ...],
    ) -> Flown:
        start, inlet, environment = beginning_of(
            model, segments, schedule, states=states, conditions=conditions
        )
        plant, state = begun(
            model.vehicle,
            model.controller,
            schedule,
            inlet,
            start,
            environment=environment,
            limits=limits,
        )
        per_block = schedule.steps_per_block
        blocks = samples * schedule.blocks_per_sample
        count = int(np.size(state.crash_time))
        bodies = [make(schedule.step) for _ in range(count)]
        begin = state.motion
        parts = (begin.position, begin.velocity, begin.attitude, begin.body_rate)
        moving = np.concatenate([np.asarray(part.stacked()) for part in parts])
        turning = np.stack(state.rotor_speed)
        for number, body in enumerate(bodies):
            body.begin(moving[:, number], turning[:, number])
        crash_time = np.full(count, np.inf)
        log: list[dict[str, JaxArray]] = []
        for block in range(blocks):
            if block % schedule.blocks_per_sample == 0:
                row = Sample(state.motion, state.rotor_speed, state.command, state.setpoints)
            for step in range(block * per_block, (block + 1) * per_block):
                at = jnp.asarray(step)
                state, asked = _commanded(plant, state, at, step % per_block == 0)
                if step % per_block == 0 and block % schedule.blocks_per_sample == 0:
                    row = eqx.tree_at(lambda r: r.command, row, state.command)
                    log.append(_logged(row, model, environment, conditions, channels))
                wanted = np.asarray(asked)
                moving, turning = moving.copy(), turning.copy()
                for number, body in enumerate(bodies):
                    if np.isinf(crash_time[number]):
                        moving[:, number] = body.step(wanted[:, number])
                        turning[:, number] = body.rotor_speed()
                state = _moved(plant, state, moving, turning, at)
            broken = np.asarray(limits.broken_by(state.motion))
            now = (block + 1) / schedule.block_rate
            crash_time = np.where(broken & np.isinf(crash_time), now, crash_time)
            if not np.isinf(crash_time).any():
                log += [log[-1]] * (samples - len(log))
                break
        stacked = {name: np.stack([np.asarray(row[name]) for row in log], 1) for name in channels}
        return Flown(stacked, dict.fromkeys(channels), crash_time)

    return fly


@eqx.filter_jit
def _commanded(plant: Plant, state: State, step: Any, begins_block: bool) -> tuple[State, Any]:
    """Return the state with its commands, and the rotor speeds that they ask for, (rotors, F)."""
    if begins_block:
        state = replaced(state, setpoints=plant.inlet.next_setpoints(plant, state, step))
    state = plant.inlet.next_command(plant, state, step)
    asked: Any = jnp.stack(state.reference_speed)
    if state.reference_history is not None:
        history = push(state.reference_history, asked, step)
        state = replaced(state, reference_history=history)
        assert isinstance(plant.lag, SwitchedLag)
        age = plant.vehicle.setup.actuator_latency * plant.schedule.physics_rate
        before, after = switched(history, step, age)
        asked = plant.lag.share * before + (1.0 - plant.lag.share) * after
    return state, asked


@eqx.filter_jit
def _moved(plant: Plant, state: State, rows: Any, speeds: Any, step: Any) -> State:
    """Return the state with another motion, remembered for those who see it late."""
    motion = Motion(Vec3(*rows[0:3]), Vec3(*rows[3:6]), Quaternion(*rows[6:10]), Vec3(*rows[10:13]))
    state = replaced(state, motion=motion, rotor_speed=tuple(speeds))
    if state.estimate_history is not None:
        seen = estimated(plant.vehicle, plant.controller, motion)
        history = push(state.estimate_history, packed(seen), step + 1)
        state = replaced(state, estimate_history=history)
    return state


@eqx.filter_jit
def _logged(
    row: Sample, model: Model, environment: Any, conditions: Any, channels: tuple[str, ...]
) -> dict[str, JaxArray]:
    """Return channel -> (F, c)."""
    logged: dict[str, JaxArray] = recorded_of(row, model, environment, conditions, channels)
    return logged
