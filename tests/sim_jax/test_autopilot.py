"""An autopilot that sits askew, a gyro whose scale is off, gains that are not the file's."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.constants import GRAVITY
from sim_jax.control.gains import with_gains_of
from sim_jax.control.geometric import ReferencePoint
from sim_jax.frames import estimated_motion, gyro_of
from sim_jax.geometry import rotation
from sim_jax.inlet import ReferenceInlet
from sim_jax.rollout import rollout
from sim_jax.schedule import Schedule
from sim_jax.state import hover
from tests.sim_jax.support import (
    apart,
    at_first_point,
    compiled_rollout,
    controller,
    moving_start,
    reference,
    vec,
    vehicle,
)
from tuner.vehicle import REGISTRY

TILT = {"autopilot_tilt_x": 0.02, "autopilot_tilt_y": -0.01}
SCALE = {"gyro_scale_x": 1.01, "gyro_scale_y": 0.99, "gyro_scale_z": 1.02}
GAINS = {
    "rate_gain_roll_pitch": 1.05,
    "rate_gain_yaw": 0.95,
    "integral_gain": 1.3,
    "gyro_cutoff_factor": 0.8,
    "derivative_cutoff_factor": 1.4,
    "attitude_gain": 1.1,
}
ALL = {**TILT, **SCALE, **GAINS, "thrust_exponent": 1.93}
NEUTRAL = {name: REGISTRY[name].neutral for name in ALL}
SAMPLES = 150


def craft_with(effects):
    return replace(vehicle(), effects={name: jnp.asarray(v, float) for name, v in effects.items()})


@cache
def inlet():
    return ReferenceInlet(
        reference("circle", ticks=SAMPLES), spins=jnp.asarray(False), yaw_rate=jnp.asarray(0.0)
    )


def flown(effects):
    """Return a flight with effects; all others are there, at their neutral values."""
    craft = craft_with({**NEUTRAL, **effects})
    return _fly(craft, at_first_point(craft, inlet().points))


@eqx.filter_jit
def _fly(craft, start):
    return rollout(craft, controller(), Schedule(), inlet(), start, samples=SAMPLES)


def end(values):
    """Return where a flight ends whose effects are all given, in the order of `ALL`."""
    motion = flown(dict(zip(ALL, values, strict=True))).log.motion
    return jnp.concatenate([motion.position.stacked(), motion.body_rate.stacked()])[:, -1]


def test_the_body_rate_is_what_was_read_turned_and_scaled_back():
    gyro = gyro_of(craft_with({**TILT, **SCALE}))
    rate = vec(0.7, -0.4, 1.1)
    np.testing.assert_allclose(gyro.body_rate(gyro.reading(rate)).stacked(), rate.stacked())
    read = gyro_of(craft_with({"autopilot_tilt_x": 0.02})).reading(vec(0.0, 0.0, 1.0))
    np.testing.assert_allclose(read.stacked(), [0.0, np.sin(0.02), np.cos(0.02)], atol=1e-14)
    assert gyro_of(vehicle()).reading(rate) is rate


def test_neutral_values_change_nothing_of_a_flight_and_each_other_value_does():
    """But how the compiler rounds products and sums at once."""
    plain = _fly(vehicle(), at_first_point(vehicle(), inlet().points))
    assert apart(flown({}).log, plain.log) < 1e-11
    for name, value in ALL.items():
        assert apart(flown({name: value}).log, plain.log) > 1e-6, name


def test_derivatives_of_a_flight_agree_with_differences():
    """At the neutral values, where a fit begins."""
    neutral = jnp.asarray(list(NEUTRAL.values()))
    slope = jax.jit(lambda along: jax.jvp(end, (neutral,), (along,))[1])
    slopes = jnp.stack([slope(along) for along in jnp.eye(len(ALL))], axis=1)
    for number, name in enumerate(ALL):
        width = 1e-3 * REGISTRY[name].prior_sd
        step = width * np.eye(len(ALL))[number]
        above, below = (np.asarray(end(neutral + side * step)) for side in (1, -1))
        scale = np.abs(slopes[:, number]).max()
        assert scale > 0.0, name
        difference = (above - below) / (2 * width)
        np.testing.assert_allclose(slopes[:, number], difference, atol=2e-4 * scale)


def hovered(effects, *, sees_markers):
    """Return where a vehicle ends that is sent to one point for eight seconds."""
    craft = craft_with(effects)
    still = vec(0.0, 0.0, 0.0) * jnp.zeros(800)
    point = ReferencePoint(still + vec(0.0, 0.0, 1.0), still, still)
    seeing = replace(controller(), sees_markers=jnp.asarray(float(sees_markers)))
    start = hover(craft, vec(0.0, 0.0, 1.0))
    inlet = ReferenceInlet(point, spins=jnp.asarray(False), yaw_rate=jnp.asarray(0.0))
    log = compiled_rollout(craft, seeing, Schedule(), inlet, start, samples=800).log
    return jax.tree.map(lambda leaf: leaf[-1], log.motion)


def test_who_levels_by_an_autopilot_that_is_askew_hovers_level_beside_its_point():
    end = hovered({"autopilot_tilt_y": -0.015}, sees_markers=False)
    lift = GRAVITY + float(controller().position.kp.z * (1.0 - end.position.z))
    gain = float(controller().position.kp.x)
    assert float(end.position.x) == pytest.approx(0.015 * lift / gain, rel=0.01)
    assert float(end.attitude.z_axis().z) == pytest.approx(1.0, abs=1e-9)


def test_who_is_fed_by_motion_capture_does_not_know_that_its_autopilot_is_askew():
    end = hovered({"autopilot_tilt_y": -0.015}, sees_markers=True)
    assert float(end.position.x) == pytest.approx(0.0, abs=1e-9)


def test_the_attitude_that_is_seen_is_the_autopilots_own():
    motion = moving_start(vehicle()).motion
    seen = estimated_motion(craft_with(TILT), controller(), motion)
    turned = motion.attitude.product(rotation(vec(0.02, -0.01, 0.0)))
    np.testing.assert_allclose(seen.attitude.stacked(), turned.stacked())
    assert estimated_motion(craft_with(SCALE), controller(), motion) is motion


def test_gains_are_those_of_the_file_times_a_factor():
    file = controller()
    flies = with_gains_of(file, craft_with(GAINS))
    factors = np.array([1.05, 1.05, 0.95])
    np.testing.assert_allclose(flies.rate.k.stacked(), factors * file.rate.k.stacked())
    np.testing.assert_allclose(flies.rate.i.stacked(), 1.3 * file.rate.i.stacked())
    assert flies.filters.gyro_cutoff == 0.8 * file.filters.gyro_cutoff
    assert flies.filters.dgyro_cutoff == 1.4 * file.filters.dgyro_cutoff
    assert flies.attitude.time_constant == file.attitude.time_constant / 1.1
    assert with_gains_of(file, vehicle()) is file
