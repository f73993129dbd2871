"""Strengths of disturbances are where the likelihood is largest, as far as they may go."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from tests.sim_jax.support import vehicle
from tuner.disturbances.disturbances import (
    FAST,
    INITIAL_STRENGTHS,
    MAX_STRENGTHS,
    MIN_STRENGTHS,
    SLOW,
    clipped,
    disturbance_of,
    processes_of,
)
from tuner.disturbances.extended_kalman_filter import Filtered
from tuner.disturbances.predictor import STEP, Slopes, difference_steps, slopes_of

ORDER = (*SLOW, *FAST)


SAMPLES, WIDE = 3000, 5


def drawn(truth: np.ndarray, seed: int) -> Callable[[np.ndarray], Filtered]:
    """Return the likelihood of samples whose covariance strengths make up, and trade off in."""
    rng = np.random.default_rng(seed)
    shapes = np.random.default_rng(0).standard_normal((7, WIDE, WIDE))
    shapes = shapes @ np.swapaxes(shapes, 1, 2)

    def root(strengths: np.ndarray) -> np.ndarray:
        added = np.einsum("k,kij->ij", np.exp(2.0 * (strengths - INITIAL_STRENGTHS)), shapes)
        return np.linalg.cholesky(added + 1e-6 * np.eye(WIDE))

    samples = rng.standard_normal((SAMPLES, WIDE)) @ root(truth).T

    def filtered(strengths: np.ndarray) -> Filtered:
        factor = root(strengths)
        white = np.linalg.solve(factor, samples.T).T
        loss = 0.5 * np.sum(white**2) + SAMPLES * np.log(np.diag(factor)).sum()
        spread = np.broadcast_to(np.diag(factor), white.shape)
        return Filtered(white, spread, np.asarray(loss), None)

    return filtered


def differenced(filtered: Callable[[np.ndarray], Filtered], strengths: np.ndarray) -> Slopes:
    steps = difference_steps(strengths)
    beside = (filtered(strengths + step) for step in np.diag(steps))
    return slopes_of(filtered(strengths), beside, steps)


def test_the_likelihoods_slope_is_that_of_its_differences() -> None:
    at = INITIAL_STRENGTHS + np.log([3.0, 0.3, 4.0, 0.5, 0.6, 2.0, 0.7])
    filtered = drawn(at, seed=2)
    differences = [
        (filtered(at + 1e-4 * axis).loss - filtered(at - 1e-4 * axis).loss) / 2e-4
        for axis in np.eye(7)
    ]
    slope, information, *_ = differenced(filtered, at)
    error = 1.0 / np.sqrt(np.diag(information))  # of a strength by itself
    np.testing.assert_allclose(slope * error, differences * error, atol=0.1)


def test_slopes_scatter_about_none_as_fishers_information_says() -> None:
    at = INITIAL_STRENGTHS + np.log([3.0, 0.3, 4.0, 0.5, 0.6, 2.0, 0.7])
    drawn_many = [differenced(drawn(at, seed=seed), at) for seed in range(100)]
    told = np.sqrt(np.diag(drawn_many[0].information))
    slopes = np.array([found.slope for found in drawn_many]) / told
    np.testing.assert_allclose(slopes.mean(axis=0), 0.0, atol=0.35)
    np.testing.assert_allclose(slopes.std(axis=0), 1.0, atol=0.25)


def test_no_strength_is_displaced_beyond_its_limits() -> None:
    at = np.where(np.arange(7) % 2, MAX_STRENGTHS, MIN_STRENGTHS)
    steps = difference_steps(at)
    np.testing.assert_allclose(clipped(at + steps), at + steps)
    np.testing.assert_allclose(np.abs(steps), STEP)


def test_a_process_keeps_its_variance_and_forgets_within_its_time_constant() -> None:
    processes = processes_of(vehicle(), jnp.asarray(INITIAL_STRENGTHS), 400.0)
    kept, added = np.asarray(processes.retention), np.asarray(processes.added)
    np.testing.assert_allclose(kept**2 * processes.sd**2 + added, processes.sd**2)
    np.testing.assert_allclose(kept[0] ** 400, np.exp(-1.0 / np.exp(INITIAL_STRENGTHS[4])))


def test_thrusts_that_wander_alone_at_each_rotor_turn_a_vehicle_as_its_arms_say() -> None:
    craft = vehicle()
    processes = processes_of(craft, jnp.asarray(INITIAL_STRENGTHS), 400.0)
    sd = dict(zip(FAST, np.asarray(processes.sd * processes.acts)[len(SLOW) :], strict=True))
    each = np.exp(INITIAL_STRENGTHS[3]) * float(craft.body.mass) * GRAVITY / 4.0
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


def test_a_draught_is_as_strong_as_what_it_takes_of_the_thrust() -> None:
    craft = vehicle()
    fastest = float(craft.aerodynamics.max_relative_airspeed)
    draught = processes_of(craft, jnp.asarray(INITIAL_STRENGTHS), 400.0).draught
    assert float(draught) == pytest.approx(np.exp(INITIAL_STRENGTHS[1]) * fastest)
