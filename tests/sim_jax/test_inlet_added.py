"""An inlet is one class: the loop flies one of which the simulator knows nothing."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from sim_jax.geometry import Quaternion
from sim_jax.inlet import ActuatorInlet, Inlet, MixedInlet, Stages, Step
from sim_jax.numeric import cast_like, row_of
from sim_jax.rigid_body import Motion
from sim_jax.schedule import Schedule
from sim_jax.state import State
from sim_jax.vehicle import PerRotor
from tests.sim_jax.support import (
    apart,
    compiled_rollout,
    controller,
    moving_start,
    vec,
    vehicle,
    without_losses,
)

SAMPLES = 50
# a first-order step takes the force in the attitude of before it, whatever the body rate
SCHEDULE = Schedule(log_rate=400, integrator="semi_implicit")
CRAFT = without_losses(vehicle())
START = moving_start(CRAFT)


class HeldAttitude(Inlet):
    """Motor commands 0..1 and the attitude are fed in; leaves are (physics steps + 1, \\*batch)."""

    command: PerRotor
    attitude: Quaternion

    def next_command(self, stages: Stages, state: State, step: Step) -> State:
        return stages.commanded(state, cast_like(row_of(self.command, step), state.command))

    def next_motion(self, moved: Motion, step: Step) -> Motion:
        attitude = cast_like(row_of(self.attitude, step + 1), moved.attitude)
        return Motion(moved.position, moved.velocity, attitude, moved.body_rate)

    def rotor_counts(self) -> set[int]:
        return {len(self.command)}


def fly(inlet: Inlet) -> Motion:
    flown = compiled_rollout(CRAFT, controller(), SCHEDULE, inlet, START, samples=SAMPLES)
    return flown.log.motion  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def added() -> HeldAttitude:
    """Hover commands and an attitude that stays, of a vehicle that turns as it starts."""

    def constant(leaf: jax.Array) -> jax.Array:
        return jnp.full(SAMPLES + 1, leaf)

    return HeldAttitude(*jax.tree.map(constant, (START.command, START.motion.attitude)))


def test_the_attitude_is_the_one_that_is_fed_in_and_the_velocity_follows_from_it(
    added: HeldAttitude,
) -> None:
    motion = fly(added)
    for kept, first in zip(
        jax.tree.leaves(motion.attitude), jax.tree.leaves(START.motion.attitude), strict=True
    ):
        assert np.all(np.asarray(kept) == first)
    pull = START.motion.attitude.to_world(vec(0.0, 0.0, GRAVITY)) + vec(0.0, 0.0, -GRAVITY)
    time = jnp.arange(SAMPLES) * SCHEDULE.step
    for axis in "xyz":
        wanted = getattr(START.motion.velocity, axis) + getattr(pull, axis) * time
        np.testing.assert_allclose(getattr(motion.velocity, axis), wanted, atol=1e-12)


def test_it_shares_a_batch_with_the_simulators_own(added: HeldAttitude) -> None:
    own = ActuatorInlet(added.command)
    together = fly(MixedInlet((added, own), jnp.asarray([0, 1])))
    for number, inlet in enumerate((added, own)):
        alone = fly(inlet)
        assert apart(jax.tree.map(lambda leaf, at=number: leaf[:, at], together), alone) < 1e-12
    turned = together.attitude.heading()
    assert float(jnp.max(jnp.abs(turned.x[:, 1] - turned.x[:, 0]))) > 0.01
