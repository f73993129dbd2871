"""The laws of the terms, and of the lags of motors and tachometers."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from sim_jax.environment import STILL_AIR, Air, Environment
from sim_jax.motor import Lag, LagSlope, SwitchedLag
from sim_jax.rigid_body import Motion, angular_acceleration
from sim_jax.schedule import Schedule
from sim_jax.sensing import Tachometer
from sim_jax.state import hover_speed
from sim_jax.terms import thrust_terms_act, total_wrench, wrench_of_each_term
from tests.sim_jax.support import (
    compiled_rollout,
    controller,
    moving_start,
    quaternion,
    vec,
    vehicle,
    wobble,
)
from tuner.vehicle import REGISTRY

CRAFT = vehicle()
EFFECTS = [row for row in REGISTRY.values() if row.is_effect and row.scope == "vehicle"]
IN_MOTORS = ("battery_exponent", "time_constant_slope", "time_constant_second")
IN_WRENCH = [row for row in EFFECTS if row.name not in IN_MOTORS]
NEUTRAL = {row.name: float(row.neutral) for row in IN_WRENCH}
NONE = dict.fromkeys(NEUTRAL, 0.0)
SPEEDS = tuple(jnp.asarray(speed) for speed in (590.0, 610.0, 600.0, 630.0))
ACCELERATIONS = tuple(jnp.asarray(change) for change in (40.0, -20.0, 10.0, 90.0))
MOVING = Motion(
    vec(0.2, -0.1, 0.4), vec(3.0, -1.0, 0.7), quaternion(0.9, 0.1, -0.2, 0.3), vec(0.7, -0.4, 1.1)
)


def with_effects(**effects):
    return replace(CRAFT, effects={name: jnp.asarray(value) for name, value in effects.items()})


def wrench(craft, motion=MOVING, speeds=SPEEDS, environment=None):
    around = environment or Environment()
    air = Air.around(craft, motion, around, ACCELERATIONS)
    sum_ = total_wrench(craft, motion, speeds, air)
    return jnp.concatenate([sum_.force.stacked(), sum_.moment.stacked()])


@jax.jit
def with_slope(effects, along):
    return jax.jvp(lambda values: wrench(with_effects(**values)), (effects,), (along,))


def change(**effects):
    return np.asarray(wrench(with_effects(**effects)) - wrench(CRAFT))


@pytest.mark.parametrize("row", IN_WRENCH, ids=lambda row: row.name)
def test_the_neutral_value_changes_no_bit_and_another_value_does(row):
    at_neutral = wrench(with_effects(**{row.name: row.neutral}))
    np.testing.assert_array_equal(at_neutral, wrench(CRAFT))
    assert np.abs(change(**{row.name: row.neutral + row.prior_sd})).max() > 1e-6


@pytest.mark.parametrize("row", IN_WRENCH, ids=lambda row: row.name)
def test_derivatives_agree_with_differences(row):
    """Of one beside all others, at their neutral values: one program for all."""
    at, width = row.neutral + 0.3 * row.prior_sd, 1e-4 * row.prior_sd
    (_, slope), (up, _), (down, _) = (
        with_slope(NEUTRAL | {row.name: at + side * width}, NONE | {row.name: 1.0})
        for side in (0, 1, -1)
    )
    np.testing.assert_allclose(slope, (up - down) / (2 * width), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("axis", "xyz")
def test_drags_take_energy(axis):
    velocity = np.asarray(MOVING.attitude.to_body(MOVING.velocity).stacked())
    rate = np.asarray(MOVING.body_rate.stacked())
    assert change(**{f"linear_drag_{axis}": 0.1})[:3] @ velocity < 0
    assert change(**{f"angular_drag_{axis}": 0.01})[3:] @ rate < 0


def test_inflow_takes_energy_from_every_motion_of_the_rotors():
    added = change(thrust_inflow_coefficient=1e-4)
    velocity = np.asarray(MOVING.attitude.to_body(MOVING.velocity).stacked())
    assert added[:3] @ velocity + added[3:] @ np.asarray(MOVING.body_rate.stacked()) < 0
    rolling = replace(MOVING, velocity=vec(0, 0, 0), body_rate=vec(1.0, 0, 0))
    craft = with_effects(thrust_inflow_coefficient=1e-4)
    assert wrench(craft, rolling)[3] < wrench(CRAFT, rolling)[3]


def test_a_level_spin_feels_wind_as_its_own_motion():
    craft = with_effects(fuselage_drag=0.02, linear_drag_x=0.1, flapping_moment_coefficient=1e-5)
    wind = Environment(wind=vec(-3.0, 0.5, 0.0))
    still = replace(MOVING, velocity=MOVING.velocity - vec(-3.0, 0.5, 0.0))
    np.testing.assert_allclose(
        wrench(craft, MOVING, environment=wind), wrench(craft, still), rtol=1e-12
    )


def test_the_centre_of_mass_turns_thrust_into_moment():
    lift = np.asarray(wrench(CRAFT))[2]
    still = replace(MOVING, velocity=vec(0, 0, 0), body_rate=vec(0, 0, 0))
    added = wrench(with_effects(center_of_mass_x=0.01), still) - wrench(CRAFT, still)
    assert added[4] == pytest.approx(0.01 * float(wrench(CRAFT, still)[2]))
    assert lift > 0


def test_the_last_rotors_scale_follows_so_that_their_product_is_one():
    three = with_effects(
        rotor_thrust_scale_1=1.1, rotor_thrust_scale_2=0.9, rotor_thrust_scale_3=1.05
    )
    last = 1 / (1.1 * 0.9 * 1.05)
    four = replace(three, effects=three.effects | {"rotor_thrust_scale_4": jnp.asarray(last)})
    np.testing.assert_allclose(wrench(three), wrench(four), rtol=1e-14)


def test_rotors_keep_the_whole_angular_momentum():
    """A body free of aerodynamics: d(Iω + h e_z)/dt is zero in inertial axes."""
    inertia = 3e-5
    moment = change(rotor_inertia=inertia)[3:]
    spins = np.array([rotor.spin for rotor in CRAFT.rotors])
    momentum = inertia * float(spins @ np.array(SPEEDS))
    spin_up = inertia * float(spins @ np.array(ACCELERATIONS))
    body = np.array([CRAFT.body.inertia_xx, CRAFT.body.inertia_yy, CRAFT.body.inertia_zz])
    rate = np.asarray(MOVING.body_rate.stacked())
    turned = np.asarray(angular_acceleration(CRAFT.body, MOVING.body_rate, vec(*moment)).stacked())
    whole = body * rate + np.array([0, 0, momentum])
    np.testing.assert_allclose(
        body * turned + np.array([0, 0, spin_up]) + np.cross(rate, whole), 0.0, atol=1e-12
    )


def test_ground_lifts_by_cheeseman_and_bennett():
    level = replace(
        MOVING, velocity=vec(0, 0, 0), body_rate=vec(0, 0, 0), attitude=quaternion(1, 0, 0, 0),
        position=vec(0, 0, 0.2),
    )  # fmt: skip
    ratio = wrench(with_effects(ground_effect=1.0), level)[2] / wrench(CRAFT, level)[2]
    height = 0.2 + float(CRAFT.rotors[0].position.z)
    assert float(ratio) == pytest.approx(1 / (1 - (0.13 / (4 * height)) ** 2), rel=1e-9)


@pytest.mark.parametrize("exponent", [1.8, 1.93, 2.15])
def test_thrust_grows_by_a_power_of_the_speed_about_the_hovers(exponent):
    speeds = np.linspace(0.34, 2.0, 12) * float(hover_speed(CRAFT))
    lifted = np.asarray(
        thrust_terms_act(with_effects(thrust_exponent=exponent))(jnp.asarray(speeds))
    )
    power = (speeds / float(hover_speed(CRAFT))) ** (exponent - 2.0)
    np.testing.assert_allclose(lifted / speeds**2, power, rtol=2e-3)
    near = np.abs(speeds / float(hover_speed(CRAFT)) - 1.0) < 0.3
    np.testing.assert_allclose((lifted / speeds**2)[near], power[near], rtol=1e-5)


def test_time_constants_grow_with_the_speed_and_stay_at_hover():
    hover = float(hover_speed(CRAFT))
    plain = Lag.over(CRAFT.motor, 0.0025)
    sloped = Lag.over(CRAFT.motor, 0.0025, LagSlope(jnp.asarray(0.5), jnp.asarray(hover)))
    for gap in (50.0, -50.0):
        at_hover = [
            lag.advance(jnp.asarray(hover), jnp.asarray(hover + gap)) for lag in (plain, sloped)
        ]
        np.testing.assert_allclose(*at_hover, rtol=1e-12)
    faster = 1.2 * hover
    longer = 0.0025 / (float(CRAFT.motor.time_constant_up) * (1 + 0.5 * 0.2))
    after, _ = sloped.advance(jnp.asarray(faster), jnp.asarray(faster + 50.0))
    assert float(after) == pytest.approx(faster + 50 - 50 * np.exp(-longer), rel=1e-12)


def test_the_battery_scales_reference_speeds_and_declines():
    schedule = Schedule(physics_rate=400, rate_control_rate=400, position_control_rate=100)
    volts = jnp.log(jnp.asarray([1.0, 0.95, 0.9]))
    step = jnp.asarray(8)
    factor = Environment(log_voltage=volts).speed_factor(jnp.asarray(0.8), step, schedule)
    assert float(factor) == pytest.approx(0.9**0.8)
    falling = Environment(battery_decline=jnp.asarray(0.01)).speed_factor(None, step, schedule)
    assert float(falling) == pytest.approx(1 - 0.01 * 8 / 400)
    assert Environment().speed_factor(jnp.asarray(0.8), step, schedule) is None
    assert Environment(log_voltage=volts).speed_factor(None, step, schedule) is None


def test_gains_are_shares_of_the_angular_acceleration_about_each_axis():
    def turning(craft):
        air = Air.around(craft, MOVING, Environment(), ACCELERATIONS)
        moment = total_wrench(craft, MOVING, SPEEDS, air).moment
        return np.asarray(angular_acceleration(craft.body, MOVING.body_rate, moment).stacked())

    gains = {"torque_gain_x": 0.4, "torque_gain_z": 0.9}
    np.testing.assert_allclose(turning(with_effects(**gains)), [0.4, 1.0, 0.9] * turning(CRAFT))


def test_terms_add_up_with_gains():
    craft = with_effects(torque_gain_y=0.3, flapping_moment_coefficient=1e-5)
    air = Air.around(craft, MOVING, Environment(), ACCELERATIONS)
    whole = total_wrench(craft, MOVING, SPEEDS, air).moment.stacked()
    each = wrench_of_each_term(craft, MOVING, SPEEDS, air).values()
    np.testing.assert_allclose(sum(one.moment.stacked() for one in each), whole, rtol=1e-12)


SECOND = 0.006
ON_ITS_WAY = (jnp.asarray(610.0), jnp.asarray(620.0), jnp.asarray(590.0), jnp.asarray(585.0))
"""Speed, reference before and after a command arrives, reference as lagged, rad/s."""


@jax.jit
def after_two_lags(second, motor=CRAFT.motor, share=0.4):
    """Return the rotor speed after a step of 2.5 ms, its mean, and the lagged reference."""
    lag = SwitchedLag.over(motor, 0.0025, jnp.asarray(share), None, jnp.asarray(second))
    speed, before, after, lagged = ON_ITS_WAY
    return jnp.stack(
        [*lag.advance(speed, before, after, lagged), lag.lag_reference(lagged, before, after)]
    )


@pytest.mark.parametrize("second", [1e-4, SECOND, float(CRAFT.motor.time_constant_down), 0.05])
def test_two_lags_in_series_are_those_of_the_differential_equations(second):
    constant, (speed, before, after, lagged) = float(CRAFT.motor.time_constant_down), ON_ITS_WAY
    alike = replace(CRAFT.motor, time_constant_up=jnp.asarray(constant))

    def slopes(_, state, reference):
        turning, behind, _ = state
        return [(behind - turning) / constant, (reference - behind) / second, turning]

    state = [float(speed), float(lagged), 0.0]
    for reference, length in ((float(before), 0.001), (float(after), 0.0015)):
        state = solve_ivp(
            slopes, (0.0, length), state, args=(reference,), rtol=1e-10, atol=1e-10, method="LSODA"
        ).y[:, -1]
    expected = [state[0], state[2] / 0.0025, state[1]]
    np.testing.assert_allclose(after_two_lags(second, alike), expected, rtol=1e-8)


@pytest.mark.parametrize("share", [0.0, 0.4])
@pytest.mark.parametrize("second", [-0.002, 0.0, 5e-4, SECOND, 0.025])
def test_a_second_lags_derivatives_agree_with_differences_also_where_it_vanishes(second, share):
    _, slope = jax.jvp(lambda value: after_two_lags(value, share=share), (second,), (1.0,))
    width = 1e-7 if second else -1e-7  # below zero it leads
    there, here = (after_two_lags(second + way * width, share=share) for way in (1, 0))
    np.testing.assert_allclose(slope, (there - here) / width, rtol=2e-3, atol=1e-3)


def test_a_second_lag_goes_on_smoothly_below_zero_as_a_lead():
    lag, nothing, lead = (after_two_lags(second) for second in (1e-5, 0.0, -1e-5))
    np.testing.assert_allclose(lag - nothing, nothing - lead, rtol=0.02, atol=1e-6)


def test_a_second_lag_of_nothing_changes_no_bit_of_a_flight_and_another_delays_it():
    def flown(**effects):
        craft = with_effects(**effects)
        schedule = Schedule(log_rate=100, longest_actuator_latency=0.01)
        start = moving_start(craft)
        inlet = wobble(craft, 30)
        log = compiled_rollout(craft, controller(), schedule, inlet, start, samples=30).log
        return np.asarray(jnp.stack(log.rotor_speed))

    base = flown()
    np.testing.assert_array_equal(flown(time_constant_second=0.0), base)
    assert np.abs(flown(time_constant_second=SECOND) - base).max() > 1.0


@jax.jit
def read_by(lag, memory=1.0):
    """Return what tachometers with a lag read after a step of 2.5 ms, rad/s."""
    return Tachometer.over(lag, 0.0025, memory).reading(*map(jnp.asarray, (590.0, 600.0, 620.0)))


@pytest.mark.parametrize("memory", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("lag", [5e-4, 0.008])
def test_tachometers_read_what_the_differential_equation_says(lag, memory):
    slope, settling = (620.0 - 600.0) / 0.0025, memory * lag
    exact = solve_ivp(
        lambda time, read: (600.0 + slope * time - read + (settling - lag) * slope) / settling,
        (0.0, 0.0025),
        [590.0],
        rtol=1e-11,
        atol=1e-9,
        method="LSODA",
    ).y[0, -1]
    np.testing.assert_allclose(read_by(jnp.asarray(lag), memory), exact, rtol=1e-8)


@pytest.mark.parametrize("lag", [-0.002, 0.0, 5e-4, 0.008])
def test_a_tachometers_derivatives_agree_with_differences_also_where_its_lag_vanishes(lag):
    width = 1e-7 if lag else -1e-7  # below zero it leads
    difference = (read_by(jnp.asarray(lag + width)) - read_by(jnp.asarray(lag))) / width
    _, slope = jax.jvp(read_by, (lag,), (1.0,))
    np.testing.assert_allclose(slope, difference, rtol=1e-4)


def test_a_longer_memory_reads_as_a_filter_that_is_computed_sample_by_sample():
    """Four times as closely as a low-pass with the same lag."""
    rate, constant = 100.0, 0.02
    kept = np.exp(-1.0 / rate / constant)
    lag = jnp.asarray(kept / (1.0 - kept) / rate)
    true = 620.0 + 60.0 * np.sin(8.0 * np.arange(600) / 400.0) ** 3
    sampled = lfilter([1.0 - kept], [1.0, -kept], true[::4], zi=true[:1] * kept)[0]

    @jax.jit
    def read_along(memory):
        def reading(last, ends):
            read = Tachometer.over(lag, 1.0 / 400.0, memory).reading(last, *ends)
            return read, read

        return jax.lax.scan(reading, true[0], (true[:-1], true[1:]))[1]

    def off(memory):
        return np.std(np.array(read_along(memory))[3::4][19:] - sampled[20:])

    assert off(constant / float(lag)) < 0.25 * off(1.0)


def test_late_tachometers_change_what_is_read_and_no_bit_of_the_flight():
    def flown(**effects):
        craft = with_effects(**effects)
        start = moving_start(craft)
        schedule = Schedule(log_rate=400)
        inlet = wobble(craft, 60)
        return compiled_rollout(craft, controller(), schedule, inlet, start, samples=60).log

    true, late = (np.stack(flown(tachometer_lag=lag).read_speed) for lag in (0.0, 0.01))
    log = flown(tachometer_lag=0.01)
    np.testing.assert_array_equal(np.stack(log.rotor_speed), true)
    base = jax.tree.leaves(flown().motion)
    assert all((a == b).all() for a, b in zip(jax.tree.leaves(log.motion), base, strict=True))
    later = np.gradient(late, 1.0 / 400.0, axis=1)
    np.testing.assert_allclose((late + 0.01 * later)[:, 8:-1], true[:, 8:-1], atol=0.2)
    assert np.abs(late - true).max() > 2.0


def test_derivatives_of_the_drag_of_a_fuselage_are_finite_at_rest():
    def of(drag, velocity):
        return wrench(with_effects(fuselage_drag=drag), replace(MOVING, velocity=velocity))

    at_rest = jax.jit(jax.jacfwd(of, argnums=(0, 1)))(jnp.asarray(0.02), vec(0, 0, 0))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(at_rest))


@jax.jit
def climbing(climbs, around):
    motion = Motion(vec(0, 0, 1), vec(0, 0, climbs), quaternion(1, 0, 0, 0), vec(0.3, -0.2, 0.0))
    return wrench(CRAFT, motion, (jnp.asarray(600.0),) * 4, around)


@jax.jit
def climbing_in(climbs, gusts):
    return jax.vmap(lambda w: climbing(climbs, Environment(wind=vec(0, 0, w))))(gusts)


@pytest.mark.parametrize("climbs", [0.0, 0.03, -0.08, 1.0])
def test_a_draught_leaves_of_thrust_and_damping_what_gusts_leave_in_the_mean(climbs):
    sd, gusts = 0.05, 0.05 * np.random.default_rng(0).standard_normal(200_000)
    blown = np.asarray(climbing_in(climbs, gusts))
    scatter = blown.std(axis=0) / np.sqrt(len(gusts))
    found = np.asarray(climbing(climbs, Environment(draught=jnp.asarray(sd))))
    assert (np.abs(found - blown.mean(axis=0)) < 4.0 * scatter + 1e-9).all()
    still = np.asarray(climbing(climbs, STILL_AIR))
    if 0.0 < climbs < sd:
        assert (np.abs(found - still)[2:5] > 10.0 * scatter[2:5]).all()
    if climbs > 10.0 * sd:
        np.testing.assert_allclose(found, still, rtol=1e-12, atol=1e-12)
