"""Strengths of disturbances are where the likelihood is largest, as far as they may go."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from sim_jax.environment import Air, Environment
from sim_jax.geometry import Vec3
from sim_jax.state import hover
from sim_jax.terms import rotor_drag
from tests.sim_jax.support import vehicle
from tuner.disturbances.disturbances import (
    FAST,
    INITIAL_STRENGTHS,
    MAX_STRENGTHS,
    MIN_STRENGTHS,
    SLOW,
    STRENGTHS,
    UPWARDS,
    clipped,
    processes_of,
)
from tuner.disturbances.extended_kalman_filter import FilterResult
from tuner.disturbances.predictor import STEP, Slopes, difference_steps, slopes_of

ORDER = (*SLOW, *FAST)


SAMPLES, WIDE = 3000, 5


def drawn(truth: np.ndarray, seed: int) -> Callable[[np.ndarray], FilterResult]:
    """Return the likelihood of samples whose covariance strengths make up, and trade off in."""
    rng = np.random.default_rng(seed)
    shapes = np.random.default_rng(0).standard_normal((len(STRENGTHS), WIDE, WIDE))
    shapes = shapes @ np.swapaxes(shapes, 1, 2)

    def root(strengths: np.ndarray) -> np.ndarray:
        added = np.einsum("k,kij->ij", np.exp(2.0 * (strengths - INITIAL_STRENGTHS)), shapes)
        return np.linalg.cholesky(added + 1e-6 * np.eye(WIDE))

    samples = rng.standard_normal((SAMPLES, WIDE)) @ root(truth).T

    def filtered(strengths: np.ndarray) -> FilterResult:
        factor = root(strengths)
        white = np.linalg.solve(factor, samples.T).T
        loss = 0.5 * np.sum(white**2) + SAMPLES * np.log(np.diag(factor)).sum()
        spread = np.broadcast_to(np.diag(factor), white.shape)
        return FilterResult(white, spread, np.asarray(loss), None)

    return filtered


def differenced(filtered: Callable[[np.ndarray], FilterResult], strengths: np.ndarray) -> Slopes:
    steps = difference_steps(strengths)
    beside = (filtered(strengths + step) for step in np.diag(steps))
    return slopes_of(filtered(strengths), beside, steps)


def test_the_likelihoods_slope_is_that_of_its_differences() -> None:
    at = INITIAL_STRENGTHS + np.log([3.0, 0.3, 4.0, 0.5, 0.6, 2.0, 0.7, 0.5])
    filtered = drawn(at, seed=2)
    differences = [
        (filtered(at + 1e-4 * axis).loss - filtered(at - 1e-4 * axis).loss) / 2e-4
        for axis in np.eye(len(STRENGTHS))
    ]
    slope, information, *_ = differenced(filtered, at)
    error = 1.0 / np.sqrt(np.diag(information))  # of a strength by itself
    np.testing.assert_allclose(slope * error, differences * error, atol=0.1)


def test_slopes_scatter_about_none_as_fishers_information_says() -> None:
    at = INITIAL_STRENGTHS + np.log([3.0, 0.3, 4.0, 0.5, 0.6, 2.0, 0.7, 0.5])
    drawn_many = [differenced(drawn(at, seed=seed), at) for seed in range(100)]
    told = np.sqrt(np.diag(drawn_many[0].information))
    slopes = np.array([found.slope for found in drawn_many]) / told
    np.testing.assert_allclose(slopes.mean(axis=0), 0.0, atol=0.35)
    np.testing.assert_allclose(slopes.std(axis=0), 1.0, atol=0.25)


def test_no_strength_is_displaced_beyond_its_limits() -> None:
    at = np.where(np.arange(len(STRENGTHS)) % 2, MAX_STRENGTHS, MIN_STRENGTHS)
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
    processes = processes_of(vehicle(), jnp.asarray(INITIAL_STRENGTHS), 400.0)
    values = np.arange(1.0, len(ORDER) + 1.0)
    acting = processes.disturbance(jnp.asarray(values)[:, None] * jnp.ones(2))
    assert acting.moment is not None
    acts = np.asarray(processes.acts) * values
    together = [acts[[at for at, name in enumerate(ORDER) if name == f"moment_{a}"]] for a in "xyz"]
    assert [len(parts) for parts in together] == [2, 2, 1]
    expected = [parts.sum() for parts in together]
    np.testing.assert_allclose(acting.moment.stacked()[:, 0, 0], expected)


def test_a_gust_is_wind_that_also_pushes() -> None:
    """Its force sideways goes with it, that upwards is another's."""
    craft, strengths = vehicle(), jnp.asarray(INITIAL_STRENGTHS)
    processes = processes_of(craft, strengths, 400.0)
    gust, lift, wind = np.exp(
        INITIAL_STRENGTHS[[STRENGTHS.index(n) for n in ("gust", "lift", "wind")]]
    )
    acting = processes.disturbance(processes.sd[:, None])
    assert acting.gust is not None
    assert acting.force is not None
    velocity = wind * np.array([1.0, 1.0, UPWARDS])
    np.testing.assert_allclose(acting.gust.stacked()[:, 0, 0], velocity)
    weight = float(craft.body.mass) * GRAVITY
    np.testing.assert_allclose(
        acting.force.stacked()[:, 0, 0], weight * np.array([gust, gust, lift])
    )


@pytest.mark.parametrize("drag", [0.0, 1e-4, 2e-3])
@pytest.mark.parametrize("wind", [0.01, 1.0])
def test_a_gust_moves_a_hovering_vehicle_by_as_much_whatever_its_drag(drag, wind) -> None:
    """As fixed gains have no information on it."""
    craft = vehicle()
    rotors = replace(craft.aerodynamics, rotor_drag_coefficient=jnp.asarray(drag))
    craft = replace(craft, aerodynamics=rotors)
    strengths = np.array(INITIAL_STRENGTHS)
    strengths[STRENGTHS.index("wind")] = np.log(wind)
    processes = processes_of(craft, jnp.asarray(strengths), 400.0)
    asked = np.zeros(len(ORDER))
    asked[[ORDER.index("gust_x"), ORDER.index("gust_y")]] = 0.3, -0.2
    acting = processes.disturbance(jnp.asarray(asked))
    assert acting.gust is not None
    assert acting.force is not None
    start = hover(craft, Vec3.zeros(jnp.asarray(0.0)))
    blown = Vec3(*(part[0] for part in (acting.gust.x, acting.gust.y, acting.gust.z)))
    air = Air.around(craft, start.motion, Environment(wind=blown))
    dragged = rotor_drag(craft, start.motion, start.rotor_speed, air)
    assert dragged is not None
    force = acting.force.stacked()[:, 0] + sum(part.stacked() for part in dragged.at_rotors)
    np.testing.assert_allclose(force / craft.body.mass, [0.3, -0.2, 0.0], rtol=1e-9)
