"""The battery's voltage: smoothed, laid out for whole flights and windows, and acting on motors."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import make_smoothing_spline

from sim_jax.schedule import Schedule
from tests.tuner.uncertainty.making import (
    criterion_of,
    fly_at,
    problem,
    truth,
    vehicle_file,
    with_data,
)
from tuner.core.errors import RecordingError
from tuner.objective.battery import (
    IDLE_SPEED_RATIO,
    MIN_SPLINE_READINGS,
    _resistance,
    log_voltage_of,
    require_voltage,
    voltages_of,
    with_readings_redrawn,
    with_reference_voltage,
)
from tuner.objective.criterion import Point
from tuner.objective.normal_equations import normal_equations, with_conditions
from tuner.objective.windows import Window
from tuner.recordings.flight import Flight, InitialState, Series
from tuner.terms.linearisation import linearise
from tuner.uncertainty.estimates import STEP, VOLTMETER_DRAWS
from tuner.uncertainty.model_error import alternatives_of, with_other_readings

NOISE = 0.02


def sagging(time):
    """Return the V of a battery that declines, and sags as a lap of four seconds goes."""
    return 16.2 - 0.0128 * time + 0.03 * np.sin(2.0 * np.pi * time / 4.0)


def series(time, volts):
    return Series(time, volts[:, None])


def flight(name="flight", volts=None):
    time = np.arange(0.0, 30.0, 0.01)
    nothing = np.zeros(3)
    signals = {} if volts is None else {"battery_voltage": np.ones((len(time), 1))}
    return Flight(
        name=name,
        path=f"{name}.bag",
        sha256="",
        rate=100.0,
        time=time,
        signals=signals,
        series={} if volts is None else {"battery_voltage": volts},
        initial=InitialState(nothing, nothing, np.eye(4)[0], nothing, np.zeros(4), np.zeros(4)),
    )


TIME = np.arange(-2.0, 30.0, 0.1)


def loaded(seed=0, gap=0.1):
    """Return a flight whose battery of 0.2 V per load declines, its meter noisy, and the truth."""
    time = np.arange(-2.0, 30.0, 0.02)
    random = np.random.default_rng(seed)
    command = 0.5 + 0.08 * np.sin(2.0 * np.pi * time / 2.5)[:, None] * np.ones(4)
    load = ((command + IDLE_SPEED_RATIO) ** 3).mean(axis=1) / (
        (command + IDLE_SPEED_RATIO) ** 3
    ).mean()
    truth = 16.3 - 0.01 * time - 0.2 * load
    slow = np.arange(-2.0, 30.0, gap)
    readings = np.interp(slow, time, truth) + NOISE * random.normal(size=len(slow))
    known = flight(volts=series(slow, readings))
    return replace(
        known,
        signals=dict(known.signals) | {"command": np.ones((len(known.time), 4))},
        series=dict(known.series) | {"command": Series(time, command)},
    ), truth


@pytest.mark.parametrize("gap", [0.01, 0.1, 0.2])
def test_the_sag_follows_the_load_and_the_noise_goes(gap):
    errors = []
    for seed in range(5):
        known, truth = loaded(seed, gap)
        (curve,) = voltages_of([known])
        errors.append(np.sqrt(np.mean((curve.volts - truth) ** 2)))
        assert curve.without_load[0] == pytest.approx(16.32, abs=0.03)
    assert np.mean(errors) < 0.5 * NOISE


def test_the_sag_comes_no_later_where_commands_were_recorded_less_often():
    """Held until the next one, those of every 40 ms would make it 20 ms late."""
    fine = np.arange(-2.0, 30.0, 0.0025)
    swinging = 0.5 + 0.1 * np.sin(2.0 * np.pi * fine / 1.5)[:, None] * np.ones(4)
    curves = []
    for every in (1, 16):
        command = Series(fine[::every], swinging[::every])
        mean = ((command.values + IDLE_SPEED_RATIO) ** 3).mean()
        known, _ = loaded()
        volts = 16.3 - 0.2 * np.interp(
            TIME, fine, ((swinging + IDLE_SPEED_RATIO) ** 3).mean(axis=1) / mean
        )
        known = replace(
            known,
            series=dict(known.series)
            | {"command": command, "battery_voltage": series(TIME, volts)},
        )
        (curve,) = voltages_of([known])
        curves.append(np.interp(fine, curve.time, curve.volts))
    inside = (fine > 0.0) & (fine < 29.0)
    often, rarely = (curve[inside] - curve[inside].mean() for curve in curves)
    slope = np.gradient(often, fine[inside])
    assert abs(slope @ (rarely - often) / (slope @ slope)) < 1e-3  # s


def test_a_voltage_without_a_load_is_a_smooth_curve():
    noise = NOISE * np.random.default_rng(0).normal(size=len(TIME))
    (curve,) = voltages_of([flight(volts=series(TIME, sagging(TIME) + noise))])
    assert (curve.volts - sagging(curve.time)).std() < 0.5 * NOISE
    np.testing.assert_array_equal(curve.volts, curve.without_load)


def test_a_load_that_the_voltage_does_not_follow_is_left_out():
    known, _ = loaded()
    noise = NOISE * np.random.default_rng(1).normal(size=len(TIME))
    idle = replace(
        known, series=dict(known.series) | {"battery_voltage": series(TIME, 16.0 + noise)}
    )
    (curve,) = voltages_of([idle])
    np.testing.assert_array_equal(curve.volts, curve.without_load)
    assert np.abs(curve.volts - 16.0).max() < NOISE


@pytest.mark.parametrize("count", [MIN_SPLINE_READINGS, 200])
def test_a_curve_is_as_stiff_as_cross_validation_by_scipy_makes_it(count):
    random = np.random.default_rng(0)
    time = np.cumsum(random.uniform(0.05, 0.15, count))
    volts = sagging(time) + NOISE * random.normal(size=count)
    (curve,) = voltages_of([flight(volts=series(time, volts))])
    expected = make_smoothing_spline(time, volts)(time)
    np.testing.assert_allclose(curve.volts, expected, atol=1e-5 * NOISE)


@pytest.mark.parametrize("gap", [0.01, 0.1, 1.0])
def test_smoothing_takes_any_rate_and_gaps(gap):
    time = np.arange(0.0, 40.0, gap)
    time = time[(time < 10) | (time > 25)]
    (curve,) = voltages_of([flight(volts=series(time, 16.0 - 0.01 * time))])
    np.testing.assert_allclose(curve.volts, 16.0 - 0.01 * curve.time, atol=1e-3)


@pytest.mark.parametrize("count", [1, 3])
def test_few_readings_are_joined_by_lines(count):
    time = np.arange(float(count))
    (curve,) = voltages_of([flight(volts=series(time, 15.0 - time))])
    np.testing.assert_allclose(curve.volts, 15.0 - time)


def test_windows_see_the_whole_flights_voltage():
    whole = flight(volts=series(TIME, 16.0 - 0.01 * TIME))
    piece = replace(whole, time=np.arange(0.0, 1.0, 0.01))
    windows = [Window(piece, 0.0), Window(piece, 20.0)]
    table = np.exp(np.asarray(log_voltage_of([whole, whole], windows, Schedule())))
    np.testing.assert_allclose(table[0], [16.0, 15.8], atol=1e-3)
    np.testing.assert_allclose(table[50], [15.995, 15.795], atol=1e-3)
    np.testing.assert_allclose(table[-1], [15.99, 15.79], atol=1e-3)  # holds after the end
    ticks = -np.arange(2.0)[:, None] / 100.0 - 0.005  # in the middle of what takes its value
    np.testing.assert_allclose(table[:2], [16.0, 15.8] + 0.01 * ticks, atol=2e-6)


def test_a_flight_without_a_voltage_has_none():
    known, unknown = flight(volts=series(TIME, sagging(TIME))), flight("silent")
    windows = [Window(known, 0.0), Window(unknown, 0.0)]
    assert log_voltage_of([unknown], windows[1:], Schedule()) is None
    both = np.asarray(log_voltage_of([known, unknown], windows, Schedule()))
    assert np.isfinite(both[:, 0]).all()
    assert np.isnan(both[:, 1]).all()
    require_voltage([known])
    with pytest.raises(RecordingError, match="holds no battery voltage"):
        require_voltage([known, unknown])


def test_the_reference_voltage_is_the_largest_without_load_unless_it_is_given():
    known = flight(volts=series(TIME, 16.0 - 0.01 * TIME))
    vehicle = with_reference_voltage(vehicle_file(), [known, flight("silent")])
    assert vehicle.battery.reference_voltage == pytest.approx(16.02)
    assert with_reference_voltage(vehicle, [known]) == vehicle
    assert with_reference_voltage(vehicle_file(), [flight()]) == vehicle_file()


def with_battery(objective, volts):
    """Return a problem whose flights' batteries have so many V at each control tick, (ticks, 2)."""
    return eqx.tree_at(
        lambda o: (o.segments.log_voltage, o.model.reference_voltage),
        objective,
        (jnp.log(jnp.asarray(volts)), jnp.asarray(16.4)),
        is_leaf=lambda leaf: leaf is None,
    )


@pytest.fixture(scope="module")
def volts():
    time = np.arange(700) / 100.0
    return np.stack([16.2 - 0.1 * time, np.full(700, np.nan)], axis=-1)


def test_a_voltage_acts_only_with_an_exponent_and_where_it_is_known(volts):
    plain = problem(("input_scaling",))
    still = fly_at(with_battery(plain, volts), truth(plain))
    for name, expected in fly_at(plain, truth(plain)).items():
        np.testing.assert_array_equal(still[name], expected)
    fit = with_battery(problem(("battery_exponent",)), volts)
    vector = fit.space.vector_of({"battery_exponent": 1.0})
    flown = fly_at(fit, Point(jnp.asarray(vector), jnp.zeros((5, 2))))["position"]
    assert np.abs(flown[..., 0] - still["position"][..., 0]).max() > 1e-3
    np.testing.assert_allclose(flown[..., 1], still["position"][..., 1], atol=1e-12)


def test_the_exponent_is_estimated_with_the_derivative_that_it_has(volts):
    fit = with_battery(problem(("input_scaling", "battery_exponent")), volts)
    start = np.asarray(fit.space.initial)
    values = {"input_scaling": float(fit.space.numbers(start)["input_scaling"])}
    point = Point(
        jnp.asarray(fit.space.vector_of(values | {"battery_exponent": 1.0})), jnp.zeros((5, 2))
    )
    fit, criterion = with_data(fit, point), criterion_of(fit, prior=0.0)

    def equations(vector):
        there = fit.start(vector)
        sums = fit.sums(there, criterion)
        return normal_equations(fit, there, criterion, sums)

    middle = 0.5 * (start + np.asarray(point.coefficients))
    _, gradient, _ = equations(middle)
    for index in range(2):
        step = 1e-4 * np.eye(2)[index]
        difference = (equations(middle + step)[0] - equations(middle - step)[0]) / 2e-4
        assert float(gradient[index]) == pytest.approx(float(difference), rel=1e-3)
    vector = start
    for _ in range(6):
        _, gradient, hessian = equations(vector)
        vector = vector - np.linalg.solve(hessian[:2, :2], gradient[:2])
    assert float(fit.space.numbers(vector)["battery_exponent"]) == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize(("true", "at_most"), [(0.15, 0.07), (0.0, 0.045)])
def test_a_resistance_that_loads_hardly_tell_is_shrunk_not_dropped(true, at_most):
    """Loads that vary by 2 % tell it to 0.05 V: dropped wherever it is not sure it would be 0."""
    random, found = np.random.default_rng(0), []
    time, fine = np.arange(0.0, 20.0, 0.1), np.arange(0.0, 20.0, 0.01)
    for _ in range(40):
        pairs = []
        for _ in range(3):
            load = 1.0 + 0.025 * np.sin(fine * random.uniform(2.0, 6.0))
            volts = 16.2 - 0.01 * time - true * np.interp(time, fine, load)
            volts = volts + NOISE * random.normal(size=len(time))
            pairs.append((series(time, volts), series(fine, load)))
        found.append(_resistance(pairs, spikes_count=False))
    assert np.sqrt(np.mean((np.array(found) - true) ** 2)) < at_most


def test_a_saturated_moment_shows_the_resistance_where_rotor_speeds_were_recorded():
    time, fine = np.arange(0.0, 20.0, 0.1), np.arange(0.0, 20.0, 0.01)
    random = np.random.default_rng(1)
    load = 1.0 + 0.002 * random.normal(size=len(fine)) + ((fine > 5.0) & (fine < 5.35))
    volts = 16.2 - 0.15 * np.interp(time, fine, load) + NOISE * random.normal(size=len(time))
    found = _resistance([(series(time, volts), series(fine, load))], spikes_count=True)
    assert found == pytest.approx(0.15, abs=0.03)


def test_a_voltmeter_that_is_read_again_scatters_a_curve_as_other_readings_do():
    curves, again, random = [], [], np.random.default_rng(2)
    for seed in range(12):
        known, _ = loaded(seed)
        (curve,), (other,) = (
            voltages_of([known]),
            voltages_of(with_readings_redrawn([known], random)),
        )
        curves.append(curve.volts)
        again.append(other.volts - curve.volts)
    scatter = np.sqrt(np.mean(np.var(curves, axis=0, ddof=1)))
    assert np.sqrt(np.mean(np.square(again))) == pytest.approx(scatter, rel=0.2)
    silent = flight("silent")
    assert with_readings_redrawn([silent], random)[0] is silent


@pytest.mark.parametrize("exponent", [0.0, 1.0])
def test_a_fit_is_simulated_with_other_readings_where_they_matter_to_it(exponent):
    flights = [loaded(seed)[0] for seed in range(2)]
    plain = problem(("battery_exponent",))
    windows = [Window(known, 0.0) for known in flights]
    volts = np.exp(np.asarray(log_voltage_of(flights, windows, plain.schedule)))
    fit = with_battery(plain, volts)
    vector = fit.space.vector_of({"battery_exponent": exponent})
    point = Point(jnp.asarray(vector), jnp.zeros((5, 2)))
    others = alternatives_of(fit, point, flights)
    assert next(iter(others)) == STEP
    assert len(others) == 1 + (VOLTMETER_DRAWS if exponent else 0)
    for name, other in others.items():
        if name == STEP:
            continue
        off = np.exp(np.asarray(other.segments.log_voltage)) - volts
        assert 0.0 < off.std() < NOISE
    assert list(alternatives_of(fit, point)) == [STEP]
    assert list(alternatives_of(plain, point, flights)) == [STEP]


def test_a_linear_approximation_knows_the_gradients_with_other_readings():
    """Of a fit without error they are those of the other problems, of each flight's wind, too."""
    flights = [loaded(seed)[0] for seed in range(2)]
    plain = problem(("battery_exponent", "input_scaling"))
    windows = [Window(known, 0.0) for known in flights]
    volts = np.exp(np.asarray(log_voltage_of(flights, windows, plain.schedule)))
    fit = with_battery(plain, volts)
    vector = fit.space.vector_of({"battery_exponent": 1.0, "input_scaling": 1000.0})
    fit, at = with_conditions(fit, Point(jnp.asarray(vector), jnp.zeros((5, 2))), ("wind_x",))
    fit = with_data(fit, at)
    others = list(with_other_readings(fit, at, flights).values())

    def linear(objective, readings=()):
        return linearise(
            objective,
            at,
            criterion_of(objective),
            offsets_fitted=np.zeros((6, 2), bool),
            conditions=("wind_x",),
            readings=readings,
        )

    here = linear(fit, others[:2])
    assert here.readings.shape == (2, 4)
    for other, gradient in zip(others[:2], here.readings, strict=True):
        there = linear(other)
        expected = there.gradients(np.zeros(4)).sum(axis=0)
        assert np.all(np.abs(expected) > 1e-3)
        np.testing.assert_allclose(gradient, expected, rtol=0.05, atol=0.01 * abs(expected).max())
    assert linear(fit).readings is None
