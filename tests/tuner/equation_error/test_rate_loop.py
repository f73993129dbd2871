"""A rate loop other than the controller file's is named by its settings, through a noisy gyro."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.control.gains import MixerSettings
from sim_jax.control.mixer import mix
from sim_jax.geometry import Vec3
from tuner.equation_error.rate_loop import rate_loop_findings
from tuner.recordings.flight import Flight, InitialState, Series
from tuner.vehicle import ControllerFile

PHYSICS, LOG, SECONDS = 2000, 100, 12.0
AXES, TURNED = ("roll", "pitch", "yaw"), np.array([1.0, -1.0, -1.0])
FILE = ControllerFile()
OF_FILE = {
    f"rate.{axis}.{part}": getattr(getattr(FILE.rate, axis), part)
    for axis in AXES
    for part in ("p", "i", "d", "ff", "k")
} | {"rate.rate": 400, "filters.gyro_cutoff": 40.0, "filters.dgyro_cutoff": 20.0}
CHANGES = (
    {"rate.rate": 250},
    {"filters.gyro_cutoff": 22.0},
    {"filters.dgyro_cutoff": 8.0},
    {"rate.roll.ff": 0.05},
    {"rate.pitch.p": 0.13},
    {"rate.yaw.i": 0.25},
    {"rate.roll.d": 0.006},
    {"rate.pitch.k": 1.3},
    {"rate.roll.p": 0.13, "filters.gyro_cutoff": 22.0},
)
FLIGHTS, GUSTS = 2, (0.0, 2.0)
"""Flights of each loop in each air, pushed by so many rad/s²."""
FLIGHTS_OF_FILE = 5


@cache
def flown():
    """Return set-points, body rates and torques (flights, samples, 3), and each flight's change.

    The loops are stepped one tick after the other, as a flight controller does.
    """
    every = [({}, gust) for gust in GUSTS for _ in range(FLIGHTS_OF_FILE)]
    every += [(change, 2.0) for change in CHANGES for _ in range(FLIGHTS)]
    random, count = np.random.default_rng(0), len(every)

    def column(name):
        return np.array([[float({**OF_FILE, **change}[name])] for change, _ in every])

    p, i, d, ff, k = (
        np.hstack([column(f"rate.{axis}.{part}") for axis in AXES])
        for part in ("p", "i", "d", "ff", "k")
    )
    hertz, gusts = column("rate.rate"), np.array([[gust] for _, gust in every])
    ohm = np.tan(np.pi * column("filters.gyro_cutoff") / hertz)
    norm = 1.0 + np.sqrt(2.0) * ohm + ohm**2
    first, second = 2.0 * (ohm**2 - 1.0) / norm, (1.0 - np.sqrt(2.0) * ohm + ohm**2) / norm
    share = 1.0 / (1.0 + hertz / (2.0 * np.pi * column("filters.dgyro_cutoff")))
    wanted = np.zeros((round(LOG * SECONDS), count, 3))
    for row in range(1, len(wanted)):
        wanted[row] = 0.93 * wanted[row - 1] + 0.25 * random.normal(size=(count, 3))
    rate, motor, push, newer, older, smooth, faster, integral, torque = np.zeros((9, count, 3))
    rows = []
    for step in range(round(PHYSICS * SECONDS)):
        asked = wanted[step * LOG // PHYSICS]
        due = step * hertz % PHYSICS < hertz
        if due.any():
            fresh = rate - first * newer - second * older
            filtered = (fresh + 2.0 * newer + older) * ohm**2 / norm
            bent = faster + share * ((filtered - smooth) * hertz - faster)
            error = asked - filtered
            said = k * (p * error - d * bent) + integral + ff * asked
            fade = np.maximum(1.0 - (error / np.radians(400.0)) ** 2, 0.0)
            now = (fresh, newer, filtered, bent, integral + fade * k * i * error / hertz, said)
            before = (newer, older, smooth, faster, integral, torque)
            newer, older, smooth, faster, integral, torque = np.where(due, now, before)
        if step % (PHYSICS // LOG) == 0:
            rows.append((asked, rate, torque))
        push = 0.999 * push + gusts * np.sqrt(0.002) * random.normal(size=(count, 3))
        motor = motor + (torque - motor) / (0.02 * PHYSICS)
        rate = rate + (100.0 * motor + push) / PHYSICS
    return [change for change, _ in every], np.array(rows).transpose(2, 1, 0, 3)


def recorded(number, *, uneven=0.0, late=0.0):
    """Return a flight's recording: noise on its gyro, s of jitter and of the gyro's delay."""
    asked, rate, torque = flown()[1][number]
    random, time = np.random.default_rng(number), np.arange(len(rate)) / LOG
    told = mix(MixerSettings(), Vec3(*map(jnp.asarray, torque.T)), jnp.full(len(time), 0.5))

    def stamped(values, by=0.0):
        return Series(time + by + uneven * random.uniform(-0.5, 0.5, len(time)), values)

    series = {
        "rate_setpoint": stamped(asked * TURNED),
        "body_rate": stamped((rate + 0.01 * random.normal(size=rate.shape)) * TURNED, late),
        "command": stamped(np.stack([np.asarray(one) for one in told], axis=1)),
    }
    signals = {name: part.values for name, part in series.items()}
    nothing = InitialState(*[np.zeros(3)] * 6)
    return Flight(str(number), "", "", float(LOG), time, signals, series, nothing)


def of_loop(change, **how):
    changes = flown()[0]
    return [recorded(n, **how) for n, own in enumerate(changes) if own == change][-FLIGHTS:]


def said(flights):
    return [(one.names, dict(one.numbers)) for one in rate_loop_findings(flights, FILE)]


@pytest.mark.parametrize("change", CHANGES, ids=" ".join)
def test_settings_that_differ_are_named_with_their_values(change):
    ((names, numbers),) = said(of_loop(change))
    assert set(names) == set(change)
    for name, true in change.items():
        error = numbers[f"{name}_error"]
        assert numbers[name] == pytest.approx(true, abs=4.0 * error)
        assert error < 0.05 * true
        assert numbers[f"{name}_file"] == OF_FILE[name]


def test_the_loop_of_the_file_is_not_doubted():
    """In still air and in gusts."""
    assert [change for change in flown()[0] if not change] == 2 * FLIGHTS_OF_FILE * [{}]
    assert not any(said([recorded(number)]) for number in range(2 * FLIGHTS_OF_FILE))


def test_stamps_that_jitter_or_are_a_millisecond_late_are_no_other_loop():
    assert not said(of_loop({}, uneven=0.004, late=1e-3))
    assert not said(of_loop({"rate.rate": 250}, uneven=0.004))  # when it ran is not to be seen
    ((names, _),) = said(of_loop({"rate.roll.ff": 0.05}, uneven=0.004))
    assert names == ("rate.roll.ff",)


def test_a_loop_that_no_few_settings_explain_is_not_named():
    """Commands of another flight are no loop's of these set-points."""
    one, other = of_loop({})
    swapped = {**one.series, "command": other.series["command"]}
    assert not said([replace(one, series=swapped)])


def test_flights_without_signals_or_with_motors_at_their_limit_say_nothing():
    first, second = of_loop({"rate.pitch.p": 0.13})
    signals = {name: part for name, part in first.signals.items() if name != "body_rate"}
    assert not said([])
    assert not said([replace(first, signals=signals)])
    command = second.series["command"]
    values = command.values.copy()
    values[::50] = 1.0
    clipped = {**second.series, "command": replace(command, values=values)}
    assert not said([replace(second, series=clipped)])
    ((names, _),) = said([first, replace(second, series=clipped)])
    assert names == ("rate.pitch.p",)


def test_a_gyro_that_ends_after_a_few_samples_of_commands_says_nothing():
    flight = recorded(0)
    command, gyro = flight.series["command"], flight.series["body_rate"]
    few = Series(command.time[:400:20], command.values[:400:20])
    series = {"command": few, "body_rate": Series(gyro.time[:260], gyro.values[:260])}
    short = replace(flight, series=flight.series | series)
    assert not list(rate_loop_findings([short], FILE))
