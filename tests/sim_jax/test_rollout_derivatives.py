"""Derivatives through whole flights: right over seconds, finite whatever the coefficients are."""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ReferenceInlet
from sim_jax.numeric import where
from sim_jax.rollout import rollout
from sim_jax.schedule import Schedule
from sim_jax.vehicle import Vehicle
from tests.sim_jax.support import at_first_point, controller, reference, vehicle

NAMES = (
    "mass",
    "inertia_xx",
    "inertia_yy",
    "inertia_zz",
    "input_scaling",
    "zero_position_armed",
    "time_constant_up",
    "time_constant_down",
    "motor_constant",
    "moment_constant",
    "rotor_drag_coefficient",
    "rolling_moment_coefficient",
    "estimate_latency",
    "actuator_latency",
)
LATENCIES = (0.0123, 0.0021)
BATCH = 16
"""Vehicles whose derivatives are computed together, more than there are names."""
SCHEDULE = Schedule(longest_estimate_latency=0.05, longest_actuator_latency=0.02)


def places(craft: Vehicle) -> list[Array]:
    parts = (craft.body, craft.motor, craft.aerodynamics, craft.setup)
    return [getattr(part, name) for name in NAMES for part in parts if hasattr(part, name)]


def nominal() -> Array:
    values = jnp.stack([jnp.asarray(value) for value in places(vehicle())])
    return values.at[-2:].set(jnp.asarray(LATENCIES))


def waits_and_jumps(points: ReferencePoint) -> ReferencePoint:
    """Hold the reference still, where no error has a direction, then move it and its place."""
    waiting = jnp.arange(points.position.x.shape[0]) <= 10
    place = jax.tree.map(lambda leaf: leaf[0], points.position)
    still = Vec3.zeros(place.x)
    away = eqx.tree_at(lambda p: p.position.y, points, points.position.y + 0.3)
    return where(waiting, ReferencePoint(place, still, still), away)


@partial(jax.jit, static_argnames=("samples", "shape"))
def flown(values: Array, *, samples: int, shape: str) -> Array:
    """Return position, attitude, rates and rotor speeds, (channels, samples, *batch)."""
    craft = eqx.tree_at(places, vehicle(), list(values))
    points = waits_and_jumps(reference(shape, ticks=samples))
    start = at_first_point(vehicle(), points)
    # exactly at their reference speed rotors are between rising and falling
    speeds = tuple(0.98 * speed for speed in start.rotor_speed)
    start = eqx.tree_at(lambda s: s.rotor_speed, start, speeds)
    inlet = ReferenceInlet(points)
    log = rollout(craft, controller(), SCHEDULE, inlet, start, samples=samples).log
    leaves = jax.tree.leaves((log.motion, log.rotor_speed))
    return jnp.stack(jnp.broadcast_arrays(*leaves))


@partial(jax.jit, static_argnames=("samples", "shape"))
def slope(values: Array, along: Array, *, samples: int, shape: str) -> tuple[Array, Array]:
    return jax.jvp(partial(flown, samples=samples, shape=shape), (values,), (along,))


@pytest.fixture(scope="module")
def jacobian() -> Array:
    """Return derivatives of the first second, (channels, samples, names)."""
    values = jnp.broadcast_to(nominal()[:, None], (len(NAMES), BATCH))
    along = values * jnp.eye(len(NAMES), BATCH)
    return slope(values, along, samples=4000, shape="circle")[1][:, :100, : len(NAMES)]


@pytest.mark.parametrize("name", NAMES)
def test_forward_derivatives_are_the_finite_differences(name: str, jacobian: Array) -> None:
    """From rest: identity attitude, no velocity, every error zero at the first tick."""
    values, column = nominal(), NAMES.index(name)
    step = 1e-2 if name == "rolling_moment_coefficient" else 1e-6  # its effect is tiny
    move = jnp.eye(len(NAMES))[column] * values * step
    above = flown(values + move, samples=100, shape="circle")
    below = flown(values - move, samples=100, shape="circle")
    wanted = np.asarray((above - below) / (2 * step))
    got = np.asarray(jacobian[..., column])
    size = np.abs(wanted).max(axis=1, keepdims=True)
    rounding = 1e-13 / step * np.abs(np.asarray(above)).max(axis=1, keepdims=True)
    assert np.all(np.abs(got - wanted) < 1e-4 * size + rounding)
    assert np.any(size > 10 * rounding)


@pytest.mark.slow
def test_reverse_mode_gives_the_same_and_is_finite_through_forty_seconds(jacobian: Array) -> None:
    """Of the first second of a vehicle; and of the end of another's, with bad coefficients.

    Beside the log it remembers a state every hundred steps, not one a tick.
    """
    weights = jnp.sin(jnp.arange(jacobian[..., 0].size)).reshape(jacobian.shape[:-1])
    bad = nominal() * jnp.asarray([1.2, 0.4, 1.7, 3.0, 0.9, 1.2, 3.0, 2.0, 0.8, 2, 4, 5, 2, 3])

    def weighed(values: Array, first: Array, end: Array) -> Array:
        motion = flown(values, samples=4000, shape="circle")
        return jnp.sum(first * motion[:, :100]) + end * jnp.sum(motion[:3, -1])

    of_end = 0.0 * weights, jnp.asarray(1.0)
    program = jax.jit(jax.grad(weighed)).lower(bad, *of_end).compile()
    memory, log = program.memory_analysis(), 17 * 4000 * bad[0].nbytes
    assert memory is not None
    assert memory.temp_size_in_bytes < 4 * log
    assert bool(jnp.all(jnp.isfinite(program(bad, *of_end))))
    reverse = program(nominal(), weights, jnp.asarray(0.0))
    assert bool(jnp.all(jnp.isfinite(reverse)))
    forward = jnp.einsum("csk,cs->k", jacobian, weights)
    np.testing.assert_allclose(reverse * nominal(), forward, rtol=1e-8, atol=1e-8)


def test_scaling_every_mass_is_a_null_direction(jacobian: Array) -> None:
    massive = [
        "mass",
        "inertia_xx",
        "inertia_yy",
        "inertia_zz",
        "motor_constant",
        "rotor_drag_coefficient",
        "rolling_moment_coefficient",
    ]
    along = jnp.asarray([1.0 if name in massive else 0.0 for name in NAMES])
    sizes = jnp.abs(jacobian).max(axis=(0, 1))
    assert float(jnp.abs(jacobian @ along).max()) < 1e-9 * float(sizes.max())
    assert float(sizes[NAMES.index("mass")]) > 1e-3


@pytest.mark.slow
def test_forty_seconds_with_bad_coefficients_stay_finite_and_apart() -> None:
    """Sixteen vehicles drawn from a factor five: most crash, none gives not-a-number.

    Every second one moves along no coefficient, and so along none of its neighbours'.
    """
    rng = np.random.default_rng(3)
    factors = np.exp(rng.uniform(-np.log(5.0), np.log(5.0), (len(NAMES), BATCH)))
    factors[:, 0] = 1.0
    values = nominal()[:, None] * jnp.asarray(factors)
    values = values.at[-2:].set(jnp.minimum(values[-2:], jnp.asarray([[0.05], [0.02]])))
    along = values * jnp.asarray(rng.normal(size=values.shape)) * (jnp.arange(BATCH) % 2)
    motion, change = slope(values, along, samples=4000, shape="circle")
    assert bool(jnp.all(jnp.isfinite(motion)))
    assert bool(jnp.all(jnp.isfinite(change)))
    still = np.ptp(motion[:3, -100:], axis=1).max(axis=0) == 0.0
    assert 0 < still[0::2].sum() < 8
    assert 0 < still[1::2].sum() < 8
    most = np.abs(change).max(axis=(0, 1))
    assert np.all(most[0::2] == 0.0)
    assert np.all(most[1::2] > 1e-3)
