"""The loop as a whole: what is logged when, the four inlets, delays, steps that may be halved."""

from __future__ import annotations

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from jax import Array

from sim_jax.control.geometric import ReferencePoint
from sim_jax.geometry import Vec3
from sim_jax.inlet import ActuatorInlet, BodyRateInlet, Inlet, ReferenceInlet, RotorSpeedInlet
from sim_jax.rollout import Rollout
from sim_jax.schedule import Schedule
from sim_jax.state import Start, hover
from sim_jax.vehicle import Setup, Vehicle
from tests.golden_check.coefficients import golden_vehicle
from tests.sim_jax.support import (
    apart,
    at_first_point,
    compiled_rollout,
    controller,
    finite,
    moving_start,
    reference,
    vec,
    vehicle,
    wobble,
)

FINE = Schedule(log_rate=400)
STEPS = 400


def fly(
    craft: Vehicle,
    inlet: Inlet,
    start: Start,
    schedule: Schedule = FINE,
    samples: int = STEPS,
    *,
    filters: bool = True,
) -> Rollout:
    return compiled_rollout(  # type: ignore[no-any-return]
        craft, controller(filters=filters), schedule, inlet, start, samples=samples
    )


def jumping_reference(ticks: int) -> ReferencePoint:
    points = reference("circle", ticks=ticks)
    place = points.position
    jump = jnp.where(jnp.arange(ticks) >= 20, 0.4, 0.0)
    return ReferencePoint(
        Vec3(place.x - jump, place.y + jump, place.z + jump), points.velocity, points.acceleration
    )


@pytest.fixture(scope="module")
def whole() -> tuple[Vehicle, Start, Rollout]:
    craft = vehicle()
    points = jumping_reference(100)
    start = at_first_point(craft, points)
    return craft, start, fly(craft, ReferenceInlet(points), start)


def test_first_sample_is_the_start(whole: tuple[Vehicle, Start, Rollout]) -> None:
    _, start, flown = whole
    first = jax.tree.map(lambda leaf: leaf[0], flown.log)
    assert apart(first.motion, start.motion) == 0.0
    assert apart(first.rotor_speed, start.rotor_speed) == 0.0


def test_rate_setpoints_fed_in_below_give_the_same_flight(
    whole: tuple[Vehicle, Start, Rollout],
) -> None:
    craft, start, flown = whole
    asked = flown.log.setpoints
    again = fly(craft, BodyRateInlet(asked.rate, asked.thrust), start)
    assert apart(again.log.motion, flown.log.motion) < 1e-12


def test_motor_commands_fed_in_below_give_the_same_flight(
    whole: tuple[Vehicle, Start, Rollout],
) -> None:
    craft, start, flown = whole
    again = fly(craft, ActuatorInlet(flown.log.command), start)
    assert apart(again.log.motion, flown.log.motion) < 1e-12
    assert apart(again.log.rotor_speed, flown.log.rotor_speed) < 1e-9
    assert apart(again.log.command, flown.log.command) < 1e-12


def test_rotor_speeds_fed_in_below_give_nearly_the_same_flight(
    whole: tuple[Vehicle, Start, Rollout],
) -> None:
    """Nearly: within a step, speeds between samples are taken as straight lines."""
    craft, start, flown = whole
    again = fly(craft, RotorSpeedInlet(flown.log.rotor_speed), start)
    assert 0.0 < apart(again.log.motion.position, flown.log.motion.position) < 2e-3


def test_a_yaw_spin_turns_at_the_asked_rate() -> None:
    craft = vehicle()
    points = reference("hover", ticks=600)
    inlet = ReferenceInlet(points, jnp.asarray(True), jnp.asarray(2.0))
    flown = fly(craft, inlet, at_first_point(craft, points), Schedule(), 600).log
    assert float(flown.setpoints.rate.z[-1]) == 2.0
    assert float(flown.motion.body_rate.z[-1]) == pytest.approx(2.0, abs=0.02)
    assert float(jnp.max(jnp.abs(flown.motion.position.x))) < 1e-9


def level_held_spin(points: ReferencePoint, level_held: Array | None) -> ReferenceInlet:
    return ReferenceInlet(points, jnp.asarray(True), jnp.asarray(2.0), level_held)


def test_a_spin_that_is_held_level_returns_to_its_place_whatever_it_has_turned() -> None:
    craft, points = vehicle(), reference("hover", ticks=600)
    start = at_first_point(craft, points)
    moved = eqx.tree_at(lambda s: s.motion.position.x, start, start.motion.position.x + 0.3)
    held = fly(craft, level_held_spin(points, jnp.asarray(True)), moved, Schedule(), 600).log
    assert float(held.setpoints.rate.z[-1]) == 2.0
    assert float(held.motion.body_rate.z[-1]) == pytest.approx(2.0, abs=0.02)
    assert float(jnp.max(jnp.abs(held.setpoints.rate.y))) > 0.1
    assert abs(float(held.motion.position.x[-1] - points.position.x[-1])) < 0.02
    free = fly(craft, level_held_spin(points, None), moved, Schedule(), 600).log
    assert float(free.motion.position.x[-1] - points.position.x[-1]) == pytest.approx(0.3, abs=1e-6)


def test_where_no_spin_is_held_level_nothing_changes() -> None:
    craft, points = vehicle(), reference("circle", ticks=600)
    start = at_first_point(craft, points)
    flown = fly(craft, ReferenceInlet(points), start, Schedule(), 600)
    none = ReferenceInlet(points, level_held=jnp.asarray(False))
    held = fly(craft, none, start, Schedule(), 600)
    assert apart(flown.log.motion, held.log.motion) < 1e-14  # two programs: each may round its way


# delays

SLOW = Schedule(log_rate=400, longest_estimate_latency=0.05, longest_actuator_latency=0.05)


def delayed(estimate: float | Array = 0.0, actuator: float | Array = 0.0) -> Vehicle:
    return eqx.tree_at(lambda v: v.setup, vehicle(), Setup(estimate, actuator))  # type: ignore[no-any-return,arg-type]


def test_no_latency_through_the_delay_lines_changes_nothing(
    whole: tuple[Vehicle, Start, Rollout],
) -> None:
    _, start, flown = whole
    again = fly(delayed(), ReferenceInlet(jumping_reference(100)), start, SLOW)
    assert apart(again.log.motion, flown.log.motion) < 1e-11


@pytest.mark.parametrize("steps", [1, 4, 7])
def test_whole_steps_of_actuator_latency_shift_the_commands(steps: int) -> None:
    craft = vehicle()
    start, inlet = moving_start(craft), wobble(craft, STEPS)
    late = tuple(
        jnp.concatenate([jnp.full(steps, before), command[:-steps]])
        for before, command in zip(start.command, inlet.command, strict=True)
    )
    by_hand = fly(craft, ActuatorInlet(late), start)  # type: ignore[arg-type]
    by_latency = fly(delayed(actuator=steps / 400), inlet, start, SLOW)
    assert apart(by_hand.log.motion, by_latency.log.motion) < 1e-10


def test_half_a_step_of_actuator_latency_lies_between() -> None:
    craft = vehicle()
    start, inlet = moving_start(craft), wobble(craft, STEPS)
    ends = [
        fly(delayed(actuator=s / 400), inlet, start, SLOW).log.motion.position.stacked()[:, -1]
        for s in (3.0, 3.5, 4.0)
    ]
    between = 0.5 * (ends[0] + ends[2])
    assert apart(ends[1], between) < 0.02 * apart(ends[0], ends[2])


def test_estimate_latency_is_what_the_controller_sees() -> None:
    """At 10 ms, the set-points of a tick are those of the state one tick before."""
    craft = delayed(estimate=0.01)
    points = jumping_reference(100)
    start = at_first_point(craft, points)
    log = fly(craft, ReferenceInlet(points), start, SLOW).log
    asked, place, speed = log.setpoints, log.motion.position, log.motion.velocity
    gains = controller().position
    for tick in (25, 60):
        step, seen = 4 * tick, 4 * tick - 4
        want = gains.kp.z * (points.position.z[tick] - place.z[seen])
        want += gains.kv.z * (points.velocity.z[tick] - speed.z[seen])
        want_side = gains.kp.x * (points.position.x[tick] - place.x[seen])
        want_side += gains.kv.x * (points.velocity.x[tick] - speed.x[seen])
        want_left = gains.kp.y * (points.position.y[tick] - place.y[seen])
        want_left += gains.kv.y * (points.velocity.y[tick] - speed.y[seen])
        length = jnp.sqrt(want**2 + want_side**2 + want_left**2)
        shrink = jnp.minimum(1.0, 10.0 / length)
        axis = log.motion.attitude.z_axis()
        total = Vec3(
            want_side * shrink + points.acceleration.x[tick],
            want_left * shrink + points.acceleration.y[tick],
            want * shrink + points.acceleration.z[tick] + 9.8,
        )
        along = total.x * axis.x[seen] + total.y * axis.y[seen] + total.z * axis.z[seen]
        assert float(asked.thrust[step]) == pytest.approx(
            float(jnp.clip(0.06 * along + 0.1, 0.0, 1.0)), abs=1e-12
        )


def test_poses_at_30_hz_make_the_estimate_older_and_the_flight_worse() -> None:
    craft = delayed(estimate=0.01)
    points = jumping_reference(100)
    start = at_first_point(craft, points)
    held = replace(SLOW, pose_rate=30.0)
    flights = [fly(craft, ReferenceInlet(points), start, schedule) for schedule in (SLOW, held)]
    assert finite(flights[1].log)
    assert apart(flights[0].log.motion.position, flights[1].log.motion.position) > 1e-3


def test_unusable_schedules_are_refused() -> None:
    with pytest.raises(ValueError, match="log_rate must divide"):
        Schedule(log_rate=90)
    with pytest.raises(ValueError, match="rate_control_rate"):
        Schedule(rate_control_rate=500)
    craft = vehicle()
    points = reference("circle", ticks=5)
    start = at_first_point(craft, points)
    with pytest.raises(ValueError, match="pose_rate needs a delay line"):
        fly(craft, ReferenceInlet(points), start, Schedule(pose_rate=30.0), 5)


# steps


@pytest.mark.slow
@pytest.mark.parametrize("name", ["circle", "lemniscate"])
def test_halving_the_physics_step_moves_forty_seconds_by_less_than_2_mm(name: str) -> None:
    craft = delayed(estimate=0.012, actuator=0.002)
    points = reference(name, ticks=4000, velocity_scaler=2.0)
    start = at_first_point(craft, points)
    flights = [
        fly(
            craft,
            ReferenceInlet(points),
            start,
            Schedule(
                physics_rate=rate, longest_estimate_latency=0.05, longest_actuator_latency=0.05
            ),
            4000,
        )
        for rate in (400, 800)
    ]
    assert not bool(flights[0].crashed)
    assert apart(flights[0].log.motion.position, flights[1].log.motion.position) < 2e-3


def test_hover_of_the_updated_and_the_original_vehicle() -> None:
    """The thesis's anchors: 0.543, 616 rad/s and 0.12 m; 0.672, 772 rad/s and 0.013 m."""
    for name, command, speed, above in (("new", 0.543, 616, 0.12), ("old", 0.672, 772, 0.013)):
        craft = golden_vehicle(name)
        points = reference("hover", ticks=600)
        flown = fly(
            craft, ReferenceInlet(points), hover(craft, vec(0.0, 0.0, 1.0)), Schedule(), 600
        ).log
        assert float(flown.command[0][-1]) == pytest.approx(command, abs=5e-4)
        assert float(flown.rotor_speed[0][-1]) == pytest.approx(speed, abs=0.6)
        assert float(flown.motion.position.z[-1] - 1.0) == pytest.approx(above, abs=3e-3)
