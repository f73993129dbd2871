"""What the base model lacks: absent it costs nothing, present it does what its law says."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sim_jax import terms
from sim_jax.environment import STILL_AIR, Air, Environment
from sim_jax.geometry import Vec3
from sim_jax.inlet import ActuatorInlet, RotorSpeedInlet
from sim_jax.rigid_body import Motion
from sim_jax.rollout import Rollout, rollout
from sim_jax.schedule import Schedule
from sim_jax.state import Start, hover
from sim_jax.terms import fuselage_drag
from sim_jax.vehicle import Vehicle
from tests.sim_jax.support import (
    apart,
    controller,
    moving_start,
    quaternion,
    vec,
    vehicle,
    wobble,
)

SCHEDULE = Schedule(log_rate=400)
SAMPLES = 100


def with_effects(craft: Vehicle, effects: Mapping[str, float | Array]) -> Vehicle:
    numbers = {name: jnp.asarray(value) for name, value in effects.items()}
    return replace(craft, effects=numbers)


def flown(craft: Vehicle, inlet: ActuatorInlet, around: Environment = STILL_AIR) -> Rollout:
    start = moving_start(craft)
    return rollout(craft, controller(), SCHEDULE, inlet, start, samples=SAMPLES, environment=around)


fly = eqx.filter_jit(flown)


def test_an_absent_coefficient_and_no_environment_cost_no_operation(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loop is the one of a simulator that lacks the term."""
    inlet = wobble(vehicle(), SAMPLES + 2)

    def operations(craft: Vehicle) -> float:
        cost = jax.jit(partial(flown)).lower(craft, inlet).cost_analysis()
        assert cost is not None
        return float(cost["flops"])

    absent = operations(vehicle())
    assert operations(with_effects(vehicle(), {"fuselage_drag": 0.03})) > absent
    base = tuple(term for term in terms.TERMS if term is not fuselage_drag)
    monkeypatch.setattr(terms, "TERMS", base)
    assert operations(vehicle()) == absent


def test_fuselage_drag_is_against_the_air_and_grows_with_its_square() -> None:
    craft = with_effects(vehicle(), {"fuselage_drag": 0.03})
    attitude, velocity = quaternion(1.0, 0.3, -0.2, 0.5), vec(2.0, -1.0, 0.5)

    def force(velocity: Vec3, wind: Vec3 | None = None) -> Vec3:
        motion = Motion(vec(0, 0, 0), velocity, attitude, vec(0.4, 0.5, -0.6))
        air = Air.around(craft, motion, Environment(wind))
        wrench = fuselage_drag(craft, motion, (), air)
        assert wrench is not None
        assert apart(wrench.moment, vec(0, 0, 0)) == 0.0
        return attitude.to_world(wrench.force)

    speed = float(velocity.norm())
    assert apart(force(velocity), velocity * (-0.03 * speed)) < 1e-15
    assert apart(force(velocity * 2.0), force(velocity) * 4.0) < 1e-14
    assert apart(force(velocity, velocity), vec(0, 0, 0)) < 1e-15
    assert apart(force(vec(0, 0, 0), -velocity), force(velocity)) < 1e-15


def test_work_of_fuselage_drag_is_the_energy_that_is_lost() -> None:
    """Rotors that stand still in air that takes nothing from them: a thrown body."""
    craft = with_effects(vehicle(), {"fuselage_drag": 0.05})
    level = hover(craft, vec(0.0, 0.0, 20.0))
    motion = Motion(vec(0, 0, 20), vec(4.0, -2.0, 3.0), level.motion.attitude, vec(0, 0, 0))
    start = Start(motion, (jnp.zeros(()),) * 4, level.command, level.rate_integral)
    inlet = RotorSpeedInlet((jnp.zeros(402),) * 4)
    log = eqx.filter_jit(rollout)(
        craft, controller(), SCHEDULE, inlet, start, samples=400
    ).log.motion
    square = log.velocity.dot(log.velocity)
    energy = craft.body.mass * (0.5 * square + 9.81 * log.position.z)
    power = 0.05 * square**1.5
    lost = jnp.cumsum(0.5 * (power[1:] + power[:-1])) * SCHEDULE.step
    assert np.all(np.diff(np.asarray(energy)) < 0.0)
    np.testing.assert_allclose(energy[0] - energy[1:], lost, rtol=1e-4, atol=1e-6)


def test_a_vehicle_carried_by_the_wind_flies_as_in_still_air() -> None:
    """Galilei: with wind and start moving at the same velocity, only the place differs."""
    craft = with_effects(vehicle(), {"fuselage_drag": 0.05})
    inlet, wind = wobble(craft, SAMPLES + 2), vec(1.5, -2.0, 0.0)
    still = fly(craft, inlet).log.motion
    start = moving_start(craft)
    carried = eqx.tree_at(lambda s: s.motion.velocity, start, start.motion.velocity + wind)
    blown = eqx.filter_jit(rollout)(
        craft,
        controller(),
        SCHEDULE,
        inlet,
        carried,
        samples=SAMPLES,
        environment=Environment(wind),
    ).log.motion
    time = jnp.arange(SAMPLES) * SCHEDULE.step
    drift = Vec3(wind.x * time, wind.y * time, wind.z * time)
    assert apart(blown.position - drift, still.position) < 1e-10
    assert apart(blown.attitude, still.attitude) < 1e-10
    assert apart(blown.body_rate, still.body_rate) < 1e-9
