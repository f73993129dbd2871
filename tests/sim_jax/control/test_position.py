"""The attitude that an acceleration asks for, against its own axes, from every side."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sim_jax.control.geometric import attitude_from_acceleration
from sim_jax.geometry import Vec3
from tests.sim_jax.support import apart, vec

component = st.floats(-1.0, 1.0, allow_subnormal=False)


@given(component, component, component, st.floats(-np.pi, np.pi))
@example(0.0, 0.0, -1.0, 0.0)
@example(0.0, 0.0, -1.0, np.pi)
@example(0.3, -0.2, 0.0, -np.pi / 2)
def test_attitude_has_the_axes_asked_for(x: float, y: float, z: float, yaw: float) -> None:
    acceleration, heading = vec(x, y, z) * 9.0, vec(np.cos(yaw), np.sin(yaw), 0.0)
    if float(acceleration.cross(heading).norm()) < 1e-3:
        return  # along the heading, where any roll would do: see below
    attitude = attitude_from_acceleration(acceleration, heading)
    assert abs(float(jnp.sum(attitude.stacked() ** 2)) - 1.0) < 1e-14
    z_axis = acceleration * (1 / acceleration.norm())
    y_axis = z_axis.cross(heading) * (1 / z_axis.cross(heading).norm())
    for axis, wanted in zip(np.eye(3), (y_axis.cross(z_axis), y_axis, z_axis), strict=True):
        assert apart(attitude.to_world(vec(*axis)), wanted) < 1e-11


@pytest.mark.parametrize("acceleration", [vec(0, 0, 0), vec(3, 0, 0), vec(-2, 0, 0)])
def test_without_a_plane_the_y_axis_stays_level(acceleration: Vec3) -> None:
    attitude = attitude_from_acceleration(acceleration, vec(1, 0, 0))
    assert apart(attitude.to_world(vec(0, 1, 0)), vec(0, 1, 0)) < 1e-15
    if float(acceleration.norm()):
        along = acceleration * (1 / acceleration.norm())
        assert apart(attitude.to_world(vec(0, 0, 1)), along) < 1e-15
