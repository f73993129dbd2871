"""Terms beyond Gazebo's motor model, which a vehicle may lack."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax import terms
from sim_jax.environment import STILL_AIR, Air, Environment
from sim_jax.rigid_body import Motion
from sim_jax.terms import fuselage_drag
from tests.sim_jax.support import quaternion, vec, vehicle

CRAFT = vehicle()
SPEEDS = (jnp.asarray(600.0),) * 4


def force(craft, velocity):
    motion = Motion(vec(0, 0, 1), velocity, quaternion(1, 0, 0, 0), vec(0, 0, 0))
    return terms.total_wrench(craft, motion, SPEEDS, Air.around(craft, motion)).force.stacked()


def draggy(coefficient):
    return replace(CRAFT, effects={"fuselage_drag": coefficient})


def test_fuselage_drag_is_quadratic_and_against_the_velocity():
    velocity = vec(3.0, -4.0, 0.0)
    added = force(draggy(jnp.asarray(0.02)), velocity) - force(CRAFT, velocity)
    np.testing.assert_allclose(added, [-0.3, 0.4, 0.0], atol=1e-12)


def test_its_derivatives_are_finite_at_rest():
    at_rest = jax.jacfwd(lambda d, v: force(draggy(d), v), argnums=(0, 1))(
        jnp.asarray(0.02), vec(0, 0, 0)
    )
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(at_rest))


def test_a_term_without_its_coefficient_is_not_traced(monkeypatch):
    velocity = vec(3.0, -4.0, 0.0)
    absent = str(jax.make_jaxpr(lambda v: force(CRAFT, v))(velocity))
    assert fuselage_drag in terms.TERMS
    monkeypatch.setattr(terms, "TERMS", tuple(t for t in terms.TERMS if t is not fuselage_drag))
    assert str(jax.make_jaxpr(lambda v: force(CRAFT, v))(velocity)) == absent


@pytest.mark.parametrize("climbs", [0.0, 0.03, -0.08, 1.0])
def test_a_draught_leaves_of_thrust_and_damping_what_gusts_leave_in_the_mean(climbs):
    sd, gusts = 0.05, 0.05 * np.random.default_rng(0).standard_normal(200_000)
    motion = Motion(vec(0, 0, 1), vec(0, 0, climbs), quaternion(1, 0, 0, 0), vec(0.3, -0.2, 0.0))

    def acting(around):
        wrench = terms.total_wrench(CRAFT, motion, SPEEDS, Air.around(CRAFT, motion, around))
        return jnp.concatenate([wrench.force.stacked(), wrench.moment.stacked()])

    blown = jax.vmap(lambda w: acting(Environment(wind=vec(0, 0, w))))(jnp.asarray(gusts))
    scatter = np.asarray(blown).std(axis=0) / np.sqrt(len(gusts))
    found = np.asarray(acting(Environment(draught=jnp.asarray(sd))))
    assert (np.abs(found - np.asarray(blown).mean(axis=0)) < 4.0 * scatter + 1e-9).all()
    still = np.asarray(acting(STILL_AIR))
    if 0.0 < climbs < sd:
        assert (np.abs(found - still)[2:5] > 10.0 * scatter[2:5]).all()
    if climbs > 10.0 * sd:
        np.testing.assert_allclose(found, still, rtol=1e-12, atol=1e-12)
