"""Strengths of disturbances are where the likelihood is largest, as far as they may go."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.numeric import GRAVITY
from tests.sim_jax.support import vehicle
from tuner.filter_error.disturbances import (
    FAST,
    MOST,
    SLOW,
    USUAL,
    disturbance_of,
    processes_of,
)
from tuner.filter_error.strengths import likeliest

ORDER = (*SLOW, *FAST)


def test_the_least_loss_is_found_where_strengths_trade_off() -> None:
    best = USUAL + np.log([3.0, 0.3, 4.0, 0.5, 0.6, 2.0])
    bends = np.diag([40.0, 5.0, 8.0, 60.0, 10.0, 30.0])
    bends[0, 4] = bends[4, 0] = 8.0

    def loss(strengths: np.ndarray) -> float:
        return float(0.5 * (strengths - best) @ bends @ (strengths - best))

    np.testing.assert_allclose(likeliest(loss), best, atol=0.3)


def test_strengths_stay_inside_their_limits() -> None:
    np.testing.assert_allclose(likeliest(lambda strengths: -strengths.sum())[4:], MOST[4:])


def test_a_process_keeps_its_variance_and_forgets_within_its_time_constant() -> None:
    processes = processes_of(vehicle(), jnp.asarray(USUAL), 400.0)
    kept, added = np.asarray(processes.keeps), np.asarray(processes.added)
    np.testing.assert_allclose(kept**2 * processes.sd**2 + added, processes.sd**2)
    np.testing.assert_allclose(kept[0] ** 400, np.exp(-1.0 / np.exp(USUAL[4])))


def test_thrusts_that_wander_alone_at_each_rotor_turn_a_vehicle_as_its_arms_say() -> None:
    craft = vehicle()
    processes = processes_of(craft, jnp.asarray(USUAL), 400.0)
    sd = dict(zip(FAST, np.asarray(processes.sd)[len(SLOW) :], strict=True))
    each = np.exp(USUAL[3]) * float(craft.body.mass) * GRAVITY / 4.0
    rng = np.random.default_rng(0)
    thrust = each * rng.standard_normal((4, 20_000))
    arms = [(float(rotor.position.x), float(rotor.position.y)) for rotor in craft.rotors]
    moment = sum(np.outer([y, -x], wander) for (x, y), wander in zip(arms, thrust, strict=True))
    assert sd["thrust"] == pytest.approx(thrust.sum(axis=0).std(), rel=0.03)
    np.testing.assert_allclose([sd["moment_x"], sd["moment_y"]], np.std(moment, axis=1), rtol=0.03)


def test_slow_and_fast_moments_add_up() -> None:
    values = jnp.arange(1.0, len(ORDER) + 1.0)[:, None] * jnp.ones(2)
    acting = disturbance_of(values)
    assert acting.force is not None
    assert acting.moment is not None
    np.testing.assert_allclose(acting.force.stacked()[:, 0, 0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(acting.moment.stacked()[:, 0, 0], [4.0 + 7.0, 5.0 + 8.0, 9.0])
