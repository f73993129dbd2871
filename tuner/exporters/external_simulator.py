"""Fly a vehicle in an external simulator with this project's controllers.

Position control, rate control, mixer, latencies and the recorded reference are those of
`sim_jax.plant`; the external simulator has rotors and rigid body.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.experimental import io_callback

from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import SwitchedLag
from sim_jax.numeric import replaced
from sim_jax.plant import Plant
from sim_jax.rigid_body import Motion
from sim_jax.rollout import start_simulation
from sim_jax.schedule import Schedule
from sim_jax.state import Limits, State
from tuner.core.numerics import Array
from tuner.objective.segments import Segments
from tuner.objective.simulation import SimulatedChannels, beginning_of, recorded_of
from tuner.vehicle.model import Model


class ExternalBody(Protocol):
    """One vehicle in an external simulator.

    Its state is position, velocity (m and m/s, world), attitude (w, x, y, z; body to world) and
    body rate (rad/s, body), 13 numbers.
    """

    def begin(self, state: Array, rotor_speed: Array) -> None:
        """Set the state (13,) and the rotor speeds in the vehicle file's rad/s."""

    def step(self, asked: Array) -> tuple[Array, Array]:
        """Advance by a physics step with commanded rotor speeds; return state and rotor speeds.

        Rotor speeds are in the vehicle file's rad/s.
        """


def flier_of(make: Callable[[float], ExternalBody]) -> Callable[..., SimulatedChannels]:
    """Return a function like `tuner.objective.simulation.fly` for an external simulator.

    Parameters
    ----------
    make
        Step in s -> a vehicle.
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
    ) -> SimulatedChannels:
        start, inlet, environment = beginning_of(
            model, segments, schedule, states=states, conditions=conditions
        )
        own, state = start_simulation(
            model.vehicle,
            model.controller,
            schedule,
            inlet,
            start,
            environment=environment,
            limits=limits,
        )
        begin = state.motion
        parts = (begin.position, begin.velocity, begin.attitude, begin.body_rate)
        moving = np.concatenate([np.asarray(part.stacked()) for part in parts])
        turning = np.stack(state.rotor_speed)
        bodies = [make(schedule.step) for _ in range(segments.count)]
        for number, body in enumerate(bodies):
            body.begin(moving[:, number], turning[:, number])

        def turn(asked: Any, flies: Any) -> tuple[Array, Array]:
            wanted = np.asarray(asked)
            for number in np.flatnonzero(flies):
                moving[:, number], turning[:, number] = bodies[number].step(wanted[:, number])
            return moving, turning

        plant = _ExternalPlant(**vars(own), advance=turn)

        def sample(state: State, number: Any) -> tuple[State, dict[str, Any]]:
            after, row = plant.sample(state, number)
            return after, recorded_of(row, model, environment, conditions, channels)

        last, log = jax.jit(lambda: lax.scan(sample, state, jnp.arange(samples)))()
        flown = {name: np.asarray(rows).swapaxes(0, 1) for name, rows in log.items()}
        return SimulatedChannels(flown, dict.fromkeys(channels), np.asarray(last.crash_time))

    return fly


class _ExternalPlant(Plant):
    """A plant whose physics are an external simulator's."""

    advance: Callable[..., tuple[Array, Array]] = eqx.field(static=True, kw_only=True)
    """Commanded rotor speeds (rotors, F), and segments without crash (F,) -> states (13, F) and
    rotor speeds (rotors, F) a step later."""

    def physics(self, state: State, step: Any) -> State:
        """Return the state after one step of the external simulator."""
        held = [jnp.stack(tuple(speeds)) for speeds in self._asked(state, step)]
        share = self.lag.share if isinstance(self.lag, SwitchedLag) else 1.0
        asked: Any = share * held[0] + (1.0 - share) * held[-1]
        dtype, batch = asked.dtype, asked.shape[1:]
        shapes = jax.ShapeDtypeStruct((13, *batch), dtype), jax.ShapeDtypeStruct(asked.shape, dtype)
        rows, speeds = io_callback(self.advance, shapes, asked, jnp.isinf(state.crash_time))
        motion = Motion(
            Vec3(*rows[0:3]), Vec3(*rows[3:6]), Quaternion(*rows[6:10]), Vec3(*rows[10:13])
        )
        return replaced(state, motion=motion, rotor_speed=tuple(speeds))
