"""Every block's derivatives where they are easily lost: rest, identity, clips, saturations."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from sim_jax.control import geometric, mixer, rate
from sim_jax.control.gains import Filters, MixerSettings, PositionGains
from sim_jax.control.geometric import ReferencePoint
from sim_jax.control.mixer import HALF_SQRT2
from sim_jax.environment import Air
from sim_jax.geometry import Quaternion, Vec3
from sim_jax.motor import Lag, reference_speed
from sim_jax.rigid_body import Motion, Wrench, step_midpoint, step_semi_implicit
from sim_jax.sensing import MAX_CUTOFF, GyroFilter, GyroMemory, filter_gyro, look_back
from sim_jax.terms import total_wrench
from sim_jax.trajectory import Circle, publish
from sim_jax.vehicle import PerRotor, Rotor, Vehicle
from tests.sim_jax.derivatives import Differences, assert_derivatives
from tests.sim_jax.support import controller, hover, quaternion, vec, vehicle

CRAFT, CONTROL = vehicle(), controller()
STILL = vec(0.0, 0.0, 0.0)
LEVEL = quaternion(1.0, 0.0, 0.0, 0.0)
HALF = jnp.asarray(0.5)


# position and attitude


def steer(reference: ReferencePoint, place: Vec3, velocity: Vec3, now: Quaternion) -> object:
    gains = CONTROL.position
    heading = geometric.heading_of(gains, velocity)
    wanted = geometric.acceleration_setpoint(gains, reference, place, velocity, heading)
    goal = geometric.attitude_from_acceleration(wanted, heading)
    return (
        geometric.rate_setpoint(CONTROL.attitude, now, goal),
        geometric.thrust_setpoint(CONTROL.attitude, wanted, now),
    )


def test_position_control_at_hover() -> None:
    there = vec(0.0, 0.0, 1.0)
    assert_derivatives(steer, ReferencePoint(there, STILL, STILL), there, STILL, LEVEL)


def test_position_control_in_flight() -> None:
    reference = ReferencePoint(vec(2.0, 0.0, 1.0), vec(0.0, 1.4, 0.0), vec(-0.98, 0.0, 0.0))
    now = quaternion(1.0, 0.1, -0.2, 0.3)
    assert_derivatives(steer, reference, vec(1.7, 0.2, 0.9), vec(0.1, 1.2, -0.1), now)


def test_feedback_at_its_limit() -> None:
    """Length exactly 10: ten per metre, a metre off."""
    reference = ReferencePoint(vec(1.0, 0.0, 1.0), STILL, STILL)

    def feedback(place: Vec3) -> Vec3:
        return geometric.feedback_acceleration(CONTROL.position, reference, place, STILL)

    assert_derivatives(feedback, vec(0.0, 0.0, 1.0), kink=True, tolerance=1e-5)
    assert_derivatives(feedback, vec(-1.0, 0.5, 1.0))


def level_thrust(acceleration: Vec3) -> Array:
    return geometric.thrust_setpoint(CONTROL.attitude, acceleration, LEVEL)


@pytest.mark.parametrize("along", [-0.1 / 0.06, 0.9 / 0.06])
def test_thrust_setpoint_at_its_limits(along: float) -> None:
    # where the clip itself rounds, stay on the limit by adding to it
    limit = (0.0 if along < 0 else 1.0) - float(level_thrust(vec(0.0, 0.0, along)))
    assert abs(limit) < 1e-15
    assert_derivatives(level_thrust, vec(0.0, 0.0, along), kink=True)
    assert_derivatives(level_thrust, vec(0.0, 0.0, 3 * along))


def test_attitude_of_no_acceleration_and_of_one_along_the_heading() -> None:
    heading = vec(1.0, 0.0, 0.0)
    attitude_of = Differences(geometric.attitude_from_acceleration, STILL, heading)
    for acceleration in (STILL, vec(3.0, 0.0, 0.0), vec(-1.0, 0.0, 0.0)):
        attitude_of.jacobian(acceleration, heading)


def test_heading_from_no_velocity() -> None:
    gains = CONTROL.position
    follows = PositionGains(
        gains.kp, gains.kv, gains.max_feedback_acceleration, gains.reference_drag, velocity_yaw=True
    )
    heading = Differences(lambda v: geometric.heading_of(follows, v), STILL)
    heading.jacobian(STILL)
    heading.hold(vec(0.3, -0.4, 1.0))


@pytest.mark.parametrize("law", [geometric.quaternion_law, geometric.rotation_matrix_law])
def test_attitude_laws(law: Callable[..., Vec3]) -> None:
    tau = jnp.asarray(0.3)
    turn = Differences(law, LEVEL, LEVEL, tau)
    turn.hold(LEVEL, LEVEL, tau)
    turn.hold(quaternion(1, 0.2, 0.3, -0.1), quaternion(1, -0.4, 0.3, 0.5), tau)
    turn.jacobian(LEVEL, quaternion(0.0, 1.0, 0.0, 0.0), tau)


# rate control


def integrate(rates: Vec3, setpoint: Vec3, integral: Vec3, *, saturated: bool = False) -> Vec3:
    flags = tuple(jnp.asarray(saturated) for _ in range(3))
    return rate.next_integral(
        CONTROL.rate,
        rate=rates,
        setpoint=setpoint,
        integral=integral,
        saturation=rate.Saturation(flags, flags),
        step=1.0,
    )


INTEGRATOR = Differences(integrate, STILL, STILL, STILL)


def test_rate_control_at_rest_and_in_flight() -> None:
    def torque(rates: Vec3, setpoint: Vec3, acceleration: Vec3, integral: Vec3) -> Vec3:
        return rate.torque_setpoint(
            CONTROL.rate,
            rate=rates,
            setpoint=setpoint,
            acceleration=acceleration,
            integral=integral,
        )

    at_rest = (STILL, STILL, STILL, STILL)
    in_flight = (vec(1, 2, 3), vec(0, -1, 0.5), vec(9, 8, -7), vec(0.1, 0, -0.2))
    for point in (at_rest, in_flight):
        assert_derivatives(torque, *point)
    INTEGRATOR.hold(STILL, STILL, STILL)
    INTEGRATOR.hold(vec(0.1, 0.2, -0.3), STILL, vec(0.1, 0.2, -0.1))


def test_integrator_at_its_limit_at_the_fade_and_when_saturated() -> None:
    limit = vec(0.3, -0.3, 0.3)
    INTEGRATOR.hold(STILL, STILL, limit, kink=True)
    edge = rate.INTEGRAL_FADE * (1.0 - 1e-10)  # at the kink, but no rounding chooses the side
    fading = vec(edge, -edge, edge)
    INTEGRATOR.hold(fading, STILL, STILL, kink=True)
    INTEGRATOR.hold(fading * 1.5, STILL, STILL)

    def stopped(rates: Vec3, integral: Vec3) -> Vec3:
        return integrate(rates, STILL, integral, saturated=True)

    assert_derivatives(stopped, vec(0.1, -0.2, 0.3), STILL)


# mixer


def mixed(torque: Vec3, thrust: Array, **settings: object) -> PerRotor:
    return mixer.mix(MixerSettings(**settings), torque, thrust)  # type: ignore[arg-type]


@cache
def mixing_of(airmode: int, thrust_factor: float) -> Differences:
    """Return the commands of a torque and a thrust."""
    mix = partial(mixed, airmode=airmode, thrust_factor=thrust_factor)
    return Differences(mix, STILL, HALF)


@pytest.mark.parametrize("airmode", [0, 1, 2])
@pytest.mark.parametrize("thrust_factor", [0.0, 0.3])
def test_mixer(airmode: int, thrust_factor: float) -> None:
    mixing = mixing_of(airmode, thrust_factor)
    mixing.hold(STILL, HALF)
    for idle in (0.0, 1.0):
        mixing.jacobian(STILL, jnp.asarray(idle))
    for torque, thrust in (
        (vec(0.1, -0.05, 0.02), 0.5),  # nothing saturates
        (vec(0.4, -0.3, 0.1), 0.2),  # low
        (vec(-0.4, 0.3, 0.1), 0.9),  # high
        (vec(0.9, -0.7, 0.6), 0.45),  # both
        (vec(0.05, 0.03, 0.7), 0.3),  # yaw
        (vec(1.3, -1.2, 1.1), 0.6),  # beyond what counts
    ):
        mixing.hold(torque, jnp.asarray(thrust))


@pytest.mark.parametrize("airmode", [0, 1, 2])
@pytest.mark.parametrize("thrust", [0.0, 1.0])
def test_mixer_at_no_and_full_thrust(airmode: int, thrust: float) -> None:
    mixing_of(airmode, 0.0).hold(STILL, jnp.asarray(thrust), kink=True, along=slice(3, None))


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_mixer_where_a_torque_stops_to_count(axis: str) -> None:
    # at half thrust rotors reach 0 and 1 together when a torque's share reaches one half
    edge = 0.5 / (1.0 if axis == "z" else HALF_SQRT2)
    number = "xyz".index(axis)
    torque = vec(*edge * np.eye(3)[number])
    mixing_of(0, 0.0).hold(torque, HALF, kink=True, along=slice(number, number + 1))


def test_quantised_commands_keep_the_straight_derivative() -> None:
    def mix(thrust: Array) -> Array:
        return mixed(STILL, thrust, pwm_quantisation=True)[0]

    command, slope = jax.jit(jax.value_and_grad(mix))(jnp.asarray(0.5432))
    assert float(slope) == 1.0
    assert float(command) == pytest.approx(0.543, abs=1e-12)


# motor and rotor


def test_motor_curve_and_its_limit() -> None:
    def curve(command: Array) -> Array:
        return reference_speed(CRAFT.motor, command)

    at_limit = jnp.asarray(1000.0 / 950.0)
    assert float(curve(at_limit)) == pytest.approx(1100.0)
    speed = Differences(curve, HALF)
    speed.hold(HALF)
    speed.hold(jnp.asarray(0.0))
    speed.hold(at_limit, kink=True)
    assert_derivatives(lambda motor: reference_speed(motor, HALF), CRAFT.motor)


def test_lag_at_rest_rising_and_falling() -> None:
    def advance(speed: Array, reference: Array, up: Array, down: Array) -> tuple[Array, Array]:
        names = lambda motor: (motor.time_constant_up, motor.time_constant_down)  # noqa: E731
        return Lag.over(eqx.tree_at(names, CRAFT.motor, (up, down)), 0.0025).advance(
            speed, reference
        )

    up, down = jnp.asarray(0.0125), jnp.asarray(0.025)
    lag = Differences(advance, up, up, up, down)
    for speed, reference in ((0.0, 100.0), (100.0, 600.0), (600.0, 100.0)):
        lag.hold(jnp.asarray(speed), jnp.asarray(reference), up, down)
    assert_derivatives(
        lambda speed, reference: advance(speed, reference, up, down),
        jnp.asarray(616.0),
        jnp.asarray(616.0),
        kink=True,
    )


def blown(speed: Array, air: Vec3, *coefficients: Array) -> Wrench:
    names = lambda a: (a.motor_constant, a.moment_constant, a.rotor_drag_coefficient)  # noqa: E731
    aerodynamics = eqx.tree_at(names, CRAFT.aerodynamics, coefficients)
    vehicle = Vehicle(CRAFT.body, (Rotor(STILL, -1),), CRAFT.motor, aerodynamics, CRAFT.setup)
    motion = Motion(STILL, air, LEVEL, STILL)
    return total_wrench(vehicle, motion, (speed,), Air.around(vehicle, motion))


COEFFICIENTS = (jnp.asarray(1.45e-5), jnp.asarray(0.033), jnp.asarray(1.45e-4))


def test_rotor_in_flight_and_standing() -> None:
    for speed in (0.0, 616.0):
        assert_derivatives(
            blown, jnp.asarray(speed), vec(2.0, -1.0, 0.5), *COEFFICIENTS, tolerance=1e-5
        )


def force(air: Vec3) -> Wrench:
    return blown(jnp.asarray(616.0), air, *COEFFICIENTS)


@pytest.mark.parametrize("axial", [0.0, 25.0, -25.0])
def test_rotor_at_hover_and_where_thrust_has_gone(axial: float) -> None:
    assert_derivatives(force, vec(0.0, 0.0, axial), kink=True)
    if axial:
        assert_derivatives(force, vec(1.0, 0.0, 1.2 * axial))


# body and sensing


@pytest.mark.parametrize("advance", [step_semi_implicit, step_midpoint])
def test_body_at_rest_and_tumbling(advance: Callable[..., Motion]) -> None:
    speeds = hover(CRAFT, STILL).rotor_speed

    def moved(motion: Motion) -> Motion:
        def wrench_at(motion: Motion) -> Wrench:
            return total_wrench(CRAFT, motion, speeds, Air.around(CRAFT, motion))

        return advance(CRAFT.body, motion, wrench_at, 0.0025)

    climbing = Motion(STILL, vec(0.0, 0.0, 0.1), LEVEL, STILL)
    moving = Differences(moved, climbing)
    moving.hold(climbing)
    moving.hold(Motion(STILL, vec(1, 2, -3), quaternion(0.2, 0.5, -0.4, 0.1), vec(5.0, -4.0, 2.0)))
    moving.jacobian(Motion(STILL, STILL, LEVEL, STILL))  # where the axial speed has its kink


def test_gyro_filters() -> None:
    def run(cutoff: Array, derivative_cutoff: Array, first: Vec3, second: Vec3) -> GyroMemory:
        filters = Filters(cutoff, derivative_cutoff)
        gyro = GyroFilter.at(filters, 400.0)
        memory = filter_gyro(gyro, GyroMemory.settled(gyro, first), second, 400.0)
        return filter_gyro(gyro, memory, first, 400.0)

    cutoffs = jnp.asarray(40.0), jnp.asarray(20.0)
    assert_derivatives(run, *cutoffs, STILL, STILL, tolerance=1e-5)
    assert_derivatives(run, *cutoffs, vec(0.5, -1, 2), vec(0.6, -0.8, 2), tolerance=1e-5)


def test_a_gyro_filter_stays_below_half_of_its_rate() -> None:
    highest, beyond = (
        GyroFilter.at(Filters(jnp.asarray(cutoff), None), 400.0)
        for cutoff in (400.0 * MAX_CUTOFF, 600.0)
    )
    assert (beyond.b0, beyond.a1, beyond.a2) == (highest.b0, highest.a1, highest.a2)
    assert abs(float(jnp.asarray(beyond.a2))) < 1.0


def test_delay_line_between_and_at_whole_steps() -> None:
    history = jnp.sin(jnp.arange(12.0)).reshape(6, 2)

    def read(age: Array, history: Array) -> Array:
        return look_back(history, jnp.asarray(9), age)

    assert_derivatives(read, jnp.asarray(1.4), history)
    assert_derivatives(read, jnp.asarray(2.0), history, kink=True)
    assert_derivatives(lambda history: read(jnp.asarray(0.0), history), history)


def test_publisher_in_its_numbers() -> None:
    def flown(radius: Array, omega: Array, scaler: Array) -> ReferencePoint:
        return publish(Circle(radius, omega), ticks=40, velocity_scaler=scaler).points

    assert_derivatives(flown, jnp.asarray(2.0), jnp.asarray(0.7), jnp.asarray(2.1))
