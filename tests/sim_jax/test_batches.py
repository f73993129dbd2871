"""One vehicle, a batch, a vmapped batch: the same numbers, whatever the others do."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sim_jax.control import mixer
from sim_jax.control.gains import Filters, MixerSettings
from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.rollout import Rollout, rollout
from sim_jax.schedule import Schedule
from sim_jax.sensing import look_back, push
from sim_jax.state import Limits, hover
from sim_jax.vehicle import Setup
from tests.golden_check.coefficients import golden_vehicle
from tests.golden_check.controllers import golden_controller

CONTROLLER = golden_controller(Filters(jnp.asarray(40.0), jnp.asarray(20.0)), MixerSettings())
DELAYED = Schedule(longest_estimate_latency=0.03, longest_actuator_latency=0.01)
VEHICLE = eqx.tree_at(
    lambda v: v.setup,
    golden_vehicle("new"),
    Setup(jnp.asarray(0.012), jnp.asarray(0.003)),
)
SAMPLES = 70
TARGETS = [0.0, 0.4, 0.9, 40.0]
LIMITS = Limits(half_width=1.3)


def steps_to(target: Array) -> ReferenceInlet:
    """Return a reference that jumps along x from 0 to each target after 0.1 s."""
    ticks = jnp.arange(SAMPLES)
    x = jnp.where(ticks[:, None] > 10, target, 0.0) if jnp.ndim(target) else ticks * 0.0 + target
    zero = Vec3.zeros(x)
    return ReferenceInlet(ReferencePoint(Vec3(x, x * 0.0, x * 0.0 + 1.0), zero, zero))


def fly(target: Array, schedule: Schedule = DELAYED, **options: object) -> Rollout:
    start = hover(VEHICLE, Vec3(*jnp.asarray([0.0, 0.0, 1.0])))
    inlet = steps_to(target)
    return rollout(VEHICLE, CONTROLLER, schedule, inlet, start, samples=SAMPLES, **options)  # type: ignore[arg-type]


compiled = eqx.filter_jit(fly)


@pytest.fixture(scope="module")
def batch() -> Rollout:
    """Vehicles that stay, go, saturate, and crash into a narrow wall."""
    return compiled(jnp.asarray(TARGETS), limits=LIMITS)


def test_the_batch_holds_a_crash_and_flights(batch: Rollout) -> None:
    assert batch.crashed.tolist() == [False, False, False, True]
    assert np.isinf(batch.crash_time).tolist() == [True, True, True, False]
    assert all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(batch.log))


def test_neighbours_change_nothing(batch: Rollout) -> None:
    for index, target in enumerate(TARGETS):
        alike = compiled(jnp.asarray([target] * len(TARGETS)), limits=LIMITS)
        for got, want in zip(jax.tree.leaves(alike), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(got[..., 0], want[..., index], rtol=1e-9, atol=1e-9)


def test_vmap_of_one_alone_gives_the_same(batch: Rollout) -> None:
    mapped = eqx.filter_jit(jax.vmap(lambda x: fly(x[None], limits=LIMITS)))
    flown = mapped(jnp.asarray(TARGETS))
    for got, want in zip(jax.tree.leaves(flown), jax.tree.leaves(batch), strict=True):
        np.testing.assert_allclose(jnp.moveaxis(got, 0, -1)[..., 0, :], want, rtol=1e-9, atol=1e-9)


def test_a_batch_of_none_is_empty() -> None:
    assert compiled(jnp.zeros(0)).log.motion.position.x.shape == (SAMPLES, 0)


def test_a_crashed_vehicle_stays_where_it_crashed(batch: Rollout) -> None:
    crash = float(batch.crash_time[3])
    at = round(crash * DELAYED.log_rate)
    x = np.asarray(batch.log.motion.position.x[:, 3])
    assert 0 < at < SAMPLES
    assert np.ptp(x[at:]) == 0.0
    assert np.all(np.abs(x) <= 1.3)
    assert np.ptp(x[:at]) > 0.1


@pytest.mark.parametrize("log_rate", [50, 400])
def test_logging_more_or_less_often_changes_nothing(log_rate: int) -> None:
    target = jnp.asarray([0.5] * len(TARGETS))
    usual = compiled(target, limits=LIMITS).log
    schedule = Schedule(
        log_rate=log_rate, longest_estimate_latency=0.03, longest_actuator_latency=0.01
    )
    other = compiled(target, schedule, limits=LIMITS).log
    ours, theirs = max(1, 100 // log_rate), max(1, log_rate // 100)
    for got, want in zip(jax.tree.leaves(other), jax.tree.leaves(usual), strict=True):
        rows = min(len(got[::theirs]), len(want[::ours]))
        np.testing.assert_allclose(got[::theirs][:rows], want[::ours][:rows], atol=1e-12)


def test_control_rates_that_do_not_divide_still_fly() -> None:
    schedule = Schedule(physics_rate=400, rate_control_rate=250, position_control_rate=30)
    zero = jnp.zeros(1)
    assert schedule.steps_per_block == 1
    hovering = compiled(zero, schedule)
    assert not bool(hovering.crashed[0])
    np.testing.assert_allclose(hovering.log.motion.position.z, 1.0, atol=0.2)


@pytest.mark.parametrize("airmode", [0, 1, 2])
def test_leaving_desaturation_out_changes_nothing(airmode: int) -> None:
    settings = MixerSettings(airmode=airmode)  # type: ignore[arg-type]
    keys = jax.random.split(jax.random.key(airmode), 2)
    torque = jax.random.uniform(keys[0], (3, 500), minval=-0.3, maxval=0.3)
    thrust = jax.random.uniform(keys[1], (500,))

    def mix(torque: Array, thrust: Array) -> Array:
        return jnp.stack(mixer.mix(settings, Vec3.of(torque), thrust))

    @jax.jit
    def both(torque: Array, thrust: Array) -> tuple[Array, Array]:
        pushed: tuple[Array, Array] = jax.jvp(mix, (torque, thrust), (torque, thrust))
        return pushed

    together, tangent = both(torque, thrust)
    inside = 0
    for i in range(0, 500, 10):
        alone, alone_tangent = both(torque[:, i], thrust[i])
        np.testing.assert_allclose(alone, together[:, i], atol=1e-15)
        np.testing.assert_allclose(alone_tangent, tangent[:, i], atol=1e-15)
        inside += bool(jnp.all((alone > 0) & (alone < 1)))
    assert 2 < inside < 48
    mapped = jax.jit(jax.vmap(mix, in_axes=(1, 0), out_axes=1))(torque, thrust)
    np.testing.assert_allclose(mapped, together, atol=1e-15)


def test_without_desaturation_each_rotor_is_clipped_by_itself_beside_one_with_it() -> None:
    """A yaw of 0.55 at a thrust of 0.45, of which PX4's desaturation leaves 0.45."""
    torque, thrust = Vec3(*jnp.asarray([[0.0] * 2, [0.0] * 2, [0.55] * 2])), jnp.full(2, 0.45)
    desaturates = jnp.asarray([True, False])
    mixed = jax.jit(partial(mixer.mix, MixerSettings(), desaturates=desaturates))
    commands = jnp.stack(mixed(torque, thrust))
    np.testing.assert_allclose(jnp.sort(commands[:, 0]), [0.0, 0.0, 0.9, 0.9], atol=1e-12)
    np.testing.assert_allclose(jnp.sort(commands[:, 1]), [0.0, 0.0, 1.0, 1.0], atol=1e-12)


def test_an_age_of_all_and_one_of_each_read_the_same() -> None:
    history = jnp.zeros((7, 2, 3))
    pushing = jax.jit(push)
    for step in range(20):
        history = pushing(history, jnp.full((2, 3), step**2 * 1.0), jnp.asarray(step))
    ages = jnp.asarray([0.0, 1.25, 4.0])

    @jax.jit
    def read(age: Array) -> tuple[Array, Array]:
        past = partial(look_back, history, jnp.asarray(19))
        return jax.jvp(past, (age,), (jnp.ones_like(age),))  # type: ignore[no-any-return]

    each, slope = read(ages)
    for i, age in enumerate(ages):
        value, rise = read(age)
        np.testing.assert_allclose(value[:, i], each[:, i], rtol=1e-14)
        np.testing.assert_allclose(rise[:, i], slope[:, i], rtol=1e-14)
    np.testing.assert_allclose(each[0], [361.0, 0.75 * 324 + 0.25 * 289, 225.0])
