"""What must not change a flight: where north is, mirrors, and the scale of all masses."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.inlet import ActuatorInlet, ReferenceInlet
from sim_jax.rigid_body import Motion
from sim_jax.rollout import Rollout
from sim_jax.schedule import Schedule
from sim_jax.state import Start
from sim_jax.vehicle import Vehicle
from tests.sim_jax.support import (
    apart,
    at_first_point,
    compiled_rollout,
    controller,
    moving_start,
    open_loop,
    quaternion,
    reference,
    scaled,
    vehicle,
    wobble,
)

Order = tuple[int, int, int, int]
SAMPLES = 500


def seen_from_elsewhere(motion: Motion, turn: Quaternion) -> Motion:
    return Motion(
        turn.to_world(motion.position),
        turn.to_world(motion.velocity),
        turn.product(motion.attitude),
        motion.body_rate,
    )


@settings(max_examples=8)
@given(st.floats(-3.1, 3.1))
def test_north_may_lie_anywhere(angle: float) -> None:
    craft = vehicle()
    start, inlet = moving_start(craft), wobble(craft, 400)
    turn = quaternion(np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2))
    turned = eqx.tree_at(lambda s: s.motion, start, seen_from_elsewhere(start.motion, turn))
    here = open_loop(craft, inlet, start).log.motion
    there = open_loop(craft, inlet, turned).log.motion
    assert apart(there, seen_from_elsewhere(here, turn)) < 1e-9


def test_quarter_turn_of_the_airframe_changes_nothing() -> None:
    """With equal inertias, four rotors a quarter turn on, spinning the other way round."""
    craft = vehicle()
    craft = eqx.tree_at(lambda v: v.body.inertia_yy, craft, craft.body.inertia_xx)
    start, inlet = moving_start(craft), wobble(craft, 400)
    order: Order = (2, 3, 1, 0)  # which old rotor stands where the new one does

    spins = tuple(craft.rotors[old].spin for old in order)
    turned_craft = eqx.tree_at(
        lambda v: v.rotors,
        craft,
        tuple(
            type(rotor)(rotor.position, spin)
            for rotor, spin in zip(craft.rotors, spins, strict=True)
        ),
    )
    turn = quaternion(np.cos(np.pi / 4), 0.0, 0.0, np.sin(np.pi / 4))

    def relabelled(motion: Motion) -> Motion:
        """Describe the same body with axes a quarter turn on."""
        return Motion(
            motion.position,
            motion.velocity,
            motion.attitude.product(turn),
            turn.to_body(motion.body_rate),
        )

    turned_start = Start(
        relabelled(start.motion),
        pick(start.rotor_speed, order),
        pick(start.command, order),
        start.rate_integral,
    )
    here = open_loop(craft, inlet, start).log.motion
    there = open_loop(turned_craft, ActuatorInlet(pick(inlet.command, order)), turned_start)
    assert apart(there.log.motion, relabelled(here)) < 1e-9


def pick(four: tuple, order: Order) -> tuple:
    return tuple(four[old] for old in order)


def across_x(v: Vec3) -> Vec3:
    return Vec3(v.x, -v.y, v.z)


def across_y(v: Vec3) -> Vec3:
    return Vec3(-v.x, v.y, v.z)


MIRRORS = {
    "left and right": (across_x, (2, 3, 0, 1)),
    "front and rear": (across_y, (3, 2, 1, 0)),
}


def mirrored(motion: Motion, mirror: Callable[[Vec3], Vec3]) -> Motion:
    """Mirror a motion; what turns (rate, vector part of the attitude) is mirrored and reversed."""
    turned = -mirror(Vec3(motion.attitude.x, motion.attitude.y, motion.attitude.z))
    return Motion(
        mirror(motion.position),
        mirror(motion.velocity),
        Quaternion(motion.attitude.w, turned.x, turned.y, turned.z),
        -mirror(motion.body_rate),
    )


def fly(craft: Vehicle, points: ReferencePoint) -> Rollout:
    return compiled_rollout(  # type: ignore[no-any-return]
        craft,
        controller(),
        Schedule(),
        ReferenceInlet(points),
        at_first_point(craft, points),
        samples=SAMPLES,
    )


@pytest.mark.parametrize("name", MIRRORS)
def test_mirror_image_of_a_flight_is_the_flight_of_the_mirror_image(name: str) -> None:
    """The whole loop, hard enough to saturate the mixer."""
    mirror, order = MIRRORS[name]
    craft = vehicle()
    points = reference("lemniscate", ticks=SAMPLES)
    step = jnp.where(jnp.arange(SAMPLES) > 100, 3.0, 0.0)
    place = points.position
    points = ReferencePoint(
        Vec3(place.x + step, place.y - 0.7 * step, place.z), points.velocity, points.acceleration
    )
    image = ReferencePoint(
        mirror(points.position), mirror(points.velocity), mirror(points.acceleration)
    )
    here, there = fly(craft, points).log, fly(craft, image).log
    assert float(jnp.min(jnp.stack(here.command))) < 0.01
    assert apart(there.motion, mirrored(here.motion, mirror)) < 1e-7
    assert apart(there.command, pick(here.command, order)) < 1e-6


@settings(max_examples=5)
@given(st.floats(0.2, 5.0))
def test_scaling_every_mass_changes_no_motion(factor: float) -> None:
    """Mass, inertia, motor constant, drag and rolling moment: an exact null direction."""
    craft = vehicle()
    points = reference("circle", ticks=SAMPLES)
    here, there = fly(craft, points), fly(scaled(craft, factor), points)
    assert apart(here.log, there.log) < 1e-9


def test_scaling_the_mass_alone_changes_the_motion() -> None:
    craft = vehicle()
    points = reference("circle", ticks=SAMPLES)
    heavier = eqx.tree_at(lambda v: v.body.mass, craft, craft.body.mass * 1.01)
    assert apart(fly(craft, points).log.motion, fly(heavier, points).log.motion) > 1e-4
