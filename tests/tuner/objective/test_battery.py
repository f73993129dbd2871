"""The battery's voltage: smoothed, laid out for whole flights and windows, and acting on motors."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.schedule import Schedule
from tests.tuner.uncertainty.making import (
    criterion_of,
    fly_at,
    problem,
    truth,
    vehicle_file,
    with_data,
)
from tuner.errors import RecordingError
from tuner.flights.flight import Flight, InitialState, Series
from tuner.objective.battery import (
    log_voltage_of,
    require_voltage,
    smoothed,
    with_reference_voltage,
)
from tuner.objective.criterion import Point
from tuner.objective.windows import Window
from tuner.search.normal_equations import normal_equations

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


def test_smoothing_keeps_the_sag_and_a_third_of_the_noise():
    noise = NOISE * np.random.default_rng(0).normal(size=len(TIME))
    clean = smoothed(series(TIME, sagging(TIME)))
    inside = (TIME > 0) & (TIME < 28)
    assert np.abs(clean.values[inside, 0] - sagging(TIME[inside])).max() < 2e-3
    noisy = smoothed(series(TIME, sagging(TIME) + noise))
    left = noisy.values[inside, 0] - clean.values[inside, 0]
    assert left.std() < 0.4 * NOISE


@pytest.mark.parametrize("gap", [0.01, 0.1, 1.0])
def test_smoothing_takes_any_rate_and_gaps(gap):
    time = np.arange(0.0, 40.0, gap)
    time = time[(time < 10) | (time > 25)]
    smooth = smoothed(series(time, 16.0 - 0.01 * time))
    np.testing.assert_allclose(smooth.values[:, 0], 16.0 - 0.01 * smooth.time, atol=1e-3)


def test_a_lone_reading_is_itself():
    np.testing.assert_allclose(smoothed(series(np.zeros(1), np.full(1, 15.0))).values, 15.0)


def test_windows_see_the_whole_flights_voltage():
    whole = flight(volts=series(TIME, 16.0 - 0.01 * TIME))
    piece = replace(whole, time=np.arange(0.0, 1.0, 0.01))
    windows = [Window(piece, 0.0), Window(piece, 20.0)]
    table = np.exp(np.asarray(log_voltage_of([whole, whole], windows, Schedule())))
    np.testing.assert_allclose(table[0], [16.0, 15.8], atol=1e-3)
    np.testing.assert_allclose(table[50], [15.995, 15.795], atol=1e-3)
    np.testing.assert_allclose(table[-1], [15.99, 15.79], atol=1e-3)  # holds after the end


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


def test_the_reference_voltage_is_the_largest_recorded_unless_it_is_given():
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
    values = {"input_scaling": float(fit.space.values(jnp.asarray(start))["input_scaling"])}
    point = Point(
        jnp.asarray(fit.space.vector_of(values | {"battery_exponent": 1.0})), jnp.zeros((5, 2))
    )
    fit, criterion = with_data(fit, point), criterion_of(fit, prior=0.0)

    def equations(vector):
        there = fit.start(vector)
        sums = fit.sums(there, criterion)
        return normal_equations(fit.space, fit.segments.flight, there, criterion, sums)

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
    assert float(fit.space.values(jnp.asarray(vector))["battery_exponent"]) == pytest.approx(
        1, abs=1e-4
    )
