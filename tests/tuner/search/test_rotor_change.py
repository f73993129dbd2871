"""A rotor that gives less from some time of a flight on, and flights in which none does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tuner.config import resolve_settings
from tuner.findings.findings import Code
from tuner.job.prepare import prepare
from tuner.options import Options
from tuner.recordings.flight import Series
from tuner.search.job_flights import read_recordings
from tuner.search.recorded_rotors import WINDOW_S, cut_at_rotor_changes, rotor_change_of

ROOT = Path(__file__).parents[3]
BROKEN = 20.0


@pytest.fixture(scope="module")
def flown():
    paths = sorted(str(path) for path in (ROOT / "reference_flights").glob("*.bag"))
    settings = resolve_settings(
        Options(paths, config=str(ROOT / "reference_flights" / "tune.yaml"))
    )
    return settings, read_recordings(settings)[0]


def weakened(flight, vehicle, share, *, rotor=0, seconds=BROKEN):
    """Return a flight whose loop turns one rotor faster from a time on, as it has to."""
    motor, series = vehicle.motor, dict(flight.series)
    for name in {"command", "rotor_speed"} & set(series):
        values = series[name].values.copy()
        late = series[name].time >= seconds
        idle, gain = (
            (motor.zero_position_armed, motor.input_scaling) if name == "command" else (0, 1)
        )
        faster = (idle + gain * values[late, rotor]) / np.sqrt(1.0 - share)
        values[late, rotor] = (faster - idle) / gain
        series[name] = Series(series[name].time, values)
    return replace(flight, series=series)


@pytest.mark.parametrize("share", [0.05, 0.02, -0.05])
def test_a_rotor_that_gives_less_is_found_by_its_time(flown, share):
    settings, recordings = flown
    for rotor, recording in enumerate(recordings[:4]):
        flight = recording.flight
        if flight.duration < BROKEN + 5.0:
            continue
        found = rotor_change_of(
            weakened(flight, settings.vehicle, share * 1.1, rotor=rotor), settings.vehicle
        )
        assert found.rotor == rotor
        assert abs(found.seconds - BROKEN) <= 2.0 * WINDOW_S
        assert found.loss == pytest.approx(1.1 * share, abs=0.3 * abs(share))


def test_flights_without_a_change_raise_no_alarm(flown):
    settings, recordings = flown
    assert cut_at_rotor_changes(recordings, settings.vehicle) == (recordings, ())


def test_a_wandering_share_is_no_change(flown):
    settings, recordings = flown
    random, alarms = np.random.default_rng(0), 0
    for number in range(40):
        flight = recordings[number % len(recordings)].flight
        commands = flight.series["command"]
        kept = np.exp(-1.0 / commands.rate)  # gusts last a second
        wander = np.zeros_like(commands.values)
        for row in range(1, len(wander)):
            wander[row] = kept * wander[row - 1] + random.normal(size=4)
        wander *= 0.006 / wander.std()
        gusty = Series(commands.time, commands.values * (1.0 + wander))
        gusty = replace(flight, series={**flight.series, "command": gusty})
        alarms += rotor_change_of(gusty, settings.vehicle) is not None
    assert alarms <= 2


def test_a_job_uses_a_flight_up_to_the_change(flown, monkeypatch):
    settings, recordings = flown
    circle, *others = recordings
    assert circle.flight.duration > BROKEN + 5.0
    broken = replace(circle, flight=weakened(circle.flight, settings.vehicle, 0.05))
    monkeypatch.setattr("tuner.job.prepare.read_recordings", lambda _: ((broken, *others), ()))
    job, findings = prepare(settings)
    (finding,) = [finding for finding in findings if finding.code is Code.ROTOR_CHANGED]
    assert (finding.subject, finding.names) == (circle.flight.name, ("front right",))
    cut = next(flight for flight in job.flights if flight.name == circle.flight.name)
    assert BROKEN - 3.0 * WINDOW_S < cut.duration < BROKEN
    assert all(series.time[-1] <= BROKEN for series in cut.series.values())
    assert all(len(rows) == len(cut.time) for rows in cut.signals.values())


def test_little_is_not_looked_at(flown):
    settings, recordings = flown
    flight = recordings[0].flight.until(7.0)
    assert (
        rotor_change_of(weakened(flight, settings.vehicle, 0.05, seconds=3.5), settings.vehicle)
        is None
    )
