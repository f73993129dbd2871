"""The drawn laboratories are ones that fly, and the table of their fits counts right."""

import math
from collections import Counter
from dataclasses import dataclass, replace
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import lab as laboratory
from benchmarks import lab_flights
from benchmarks.lab import Trial, TrialRecord, _rows, _voltages, append_trial, read_trials, section
from benchmarks.lab_flights import (
    CURRENT,
    KNOWN,
    METER,
    RATE,
    READ_EVERY,
    ROTORS,
    SECONDS,
    UNKNOWN,
    Beyond,
    Effect,
    drawn,
    effect_of,
    inlet_with,
)
from sim_jax.constants import GRAVITY
from sim_jax.schedule import Schedule
from tuner.findings.findings import Code, Finding
from tuner.objective.battery import VOLTAGE
from tuner.recordings.flight import Series
from tuner.uncertainty.estimates import Estimate
from tuner.uncertainty.verdict import ErrorParts, Reason, ReasonCode, Verdict
from tuner.vehicle import COEFFICIENTS, term_groups, values_of

SEEDS = range(8)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_drawn_vehicle_hovers_at_half_of_its_command(seed):
    lab = drawn(seed)
    values = values_of(lab.vehicle)
    speed = np.sqrt(values["mass"] * GRAVITY / 4.0 / values["motor_constant"])
    assert 0.4 < (speed - values["zero_position_armed"]) / values["input_scaling"] < 0.7
    scales = [values.get(f"rotor_thrust_scale_{number}", 1.0) for number in range(1, 5)]
    assert np.prod(scales) == pytest.approx(1.0)
    assert drawn(seed) == lab


def test_laboratories_differ_in_what_they_have():
    labs = [drawn(seed) for seed in SEEDS]
    assert len({lab.groups for lab in labs}) == len(labs)
    assert sum(lab.gusts for lab in labs) == len(labs) / 2
    for lab in labs:
        there = {g for g, names in term_groups().items() if set(names) & set(lab.vehicle.effects)}
        assert there == set(lab.groups)


def test_two_laboratories_of_three_have_an_effect_and_all_effects_are_drawn():
    effects = [effect_of(seed, seconds=SECONDS, flights=3, log_rate=100.0) for seed in range(300)]
    names = Counter(effect.name for effect in effects)
    assert set(names) == {"", *KNOWN, *UNKNOWN}
    assert 80 < names[""] < 120
    for effect in effects:
        assert bool(effect.values) == (effect.name in KNOWN)
        assert bool(effect.size) == (effect.name in (*UNKNOWN, "tachometer_lag"))
    assert set(KNOWN) <= set(term_groups())
    assert not set(UNKNOWN) & set(COEFFICIENTS)


def test_several_effects_are_two_or_three_of_them(monkeypatch):
    monkeypatch.setattr(lab_flights, "CHOICE", "several")
    for seed in SEEDS:
        effect = effect_of(seed, seconds=SECONDS, flights=3, log_rate=100.0)
        names = [part.name for part in effect.each]
        assert len(set(names)) == len(names) in (2, 3)
        assert set(names) <= {*KNOWN, *UNKNOWN}
        assert {g for g in drawn(seed, effect).groups if g in KNOWN} == {*names} & {*KNOWN}


def with_all(effect, inlet):
    """Return an inlet with what it lacks at neutral values, so that one program flies them all."""
    made = inlet_with(effect, inlet)
    usual = {"loss": jnp.zeros((ROTORS, len(inlet.spins))), "begin": jnp.asarray(0.0)}
    usual["lift"] = jnp.asarray(0.0)
    given = {name: getattr(made, name, None) for name in usual}
    beyond = {name: usual[name] if own is None else own for name, own in given.items()}
    return Beyond(inlet.points, inlet.spins, inlet.yaw_rate, inlet.level_held, **beyond)


@pytest.mark.slow
@pytest.mark.parametrize("name", UNKNOWN)
def test_what_no_coefficient_describes_changes_the_recordings(monkeypatch, tmp_path, name):
    """And nothing in them before a rotor is damaged. The battery drains in the hover, too."""
    monkeypatch.setattr(lab_flights, "CHOICE", name)
    monkeypatch.setattr(lab_flights, "METER", 0.0)
    monkeypatch.setattr(lab_flights, "PHYSICS", 400)
    monkeypatch.setattr(lab_flights, "SAGS", 1)
    monkeypatch.setattr(lab_flights, "inlet_with", with_all)
    effect = effect_of(0, seconds=SECONDS, flights=3, log_rate=100.0)
    flown = []
    monkeypatch.setattr(lab_flights, "write_bag", lambda simulation, _: flown.append(simulation))
    for lab in (drawn(0), drawn(0, effect)):
        lab_flights.write(lab, tmp_path, seed=0)
    volts = flown[0].signals["battery_voltage"][flown[0].time < 0.0]
    fall = np.diff(volts[np.isfinite(volts)]) * RATE / READ_EVERY
    np.testing.assert_allclose(fall, -ROTORS * CURRENT * drawn(0).drain, rtol=1e-6)
    pairs = list(zip(flown[:4], flown[4:], strict=True))
    moved = [
        np.abs(after.signals["rotor_speed"] - before.signals["rotor_speed"]).max(axis=1)
        for before, after in pairs
    ]
    assert max(part.max() for part in moved) > 1.0
    if name == "rotor_damage":
        early = pairs[effect.flight][0].time < effect.begin
        assert moved[effect.flight][early].max() < 1e-6
        assert all(part.max() < 1e-6 for i, part in enumerate(moved) if i != effect.flight)


def test_the_table_counts_errors_and_intervals_that_hold_the_truth():
    lab = drawn(0)
    true = values_of(lab.vehicle)["motor_constant"]

    def trial(error, half):
        value, off = true * (1.0 + error), half * true
        parts = ErrorParts(noise=0.1 * off, residuals=0.2 * off, left_out=0.5 * off, terms=off)
        estimate = SimpleNamespace(
            value=value, std_error=off / 2.0, ci95=(value - off, value + off), parts=parts
        )
        return Trial(lab, (), {"motor_constant": estimate}, {"motor_constant": 0.5}, 1.0)

    trials = [trial(0.02, 0.03), trial(0.04, 0.01)]  # half as wide, the first would hold no longer
    (row,) = _rows(trials)
    assert row == ["motor_constant", "2", "+3.00 %", "3.16 %", "2 %", "terms", "2 ×", "1 of 2"]
    part = section(trials)
    assert (part.rows, len(part.head)) == ([row], len(row))
    flown = 2 * len(lab.groups)
    assert "2 laboratories (0 with gusts)" in part.text
    assert f"Of {flown} groups of terms that were flown 0 are found; missed" in part.text
    assert (
        "In still air 1 of 2 95 % intervals hold the truth; without the part `terms` 0" in part.text
    )
    assert "1 of 2 that are twice the oracle's" in part.text
    assert "In gusts" not in part.text
    assert part.title == "Simulated lab flights"
    assert "effect |" not in part.text
    loss = Effect("rotor_damage", size=0.05)
    with_effect = replace(trials[1], lab=replace(lab, effect=loss))
    effects = section([trials[0], with_effect])
    assert effects.title == "Simulated lab flights with effects"
    by_effect = "| rotor damage |  | 1 |  | 0 of 1 | 1 (motor_constant) | motor_constant +8.0 |  |"
    assert by_effect in effects.text.splitlines()
    both = Effect(
        "rotor_damage, translational_lift", several=(loss, Effect("translational_lift", size=0.004))
    )
    with_both = replace(trials[1], lab=replace(lab, effect=both))
    several = section([with_effect, with_both])
    assert several.title == "Simulated lab flights with several effects"
    for name, count in (("rotor damage", 2), ("translational lift", 1)):
        assert any(
            line.startswith(f"| {name} |  | {count} |") for line in several.text.splitlines()
        )


def test_a_run_goes_on_from_the_laboratories_that_a_file_keeps(tmp_path, monkeypatch):
    parts = ErrorParts(noise=1.0, residuals=2.0, lack=math.inf)
    reason = Reason(code=ReasonCode.INTERVAL)
    known = Estimate(1.0, 0.1, (0.8, 1.2), Verdict.WELL_KNOWN, reason, parts)
    findings = (Finding(Code.LAW_LACKING, "warning", "model", {"share": 0.1}, ("force_z",)),)
    oracle = {"motor_constant": math.inf}
    trial = Trial(drawn(0), ("battery",), {"motor_constant": known}, oracle, 1.0, 16.0, findings)
    file = tmp_path / "kept"
    assert read_trials(file, "drawn") == {}
    append_trial(file, TrialRecord(seed=0, effect="drawn", trial=trial))
    append_trial(file, TrialRecord(seed=1, effect="none", trial=trial))
    fitted = []

    def fit(seed, _):
        fitted.append(seed)
        return trial

    monkeypatch.setattr(laboratory, "_task", fit)
    monkeypatch.setattr(laboratory, "SEEDS", (0, 1))
    monkeypatch.setattr(laboratory, "KEPT", str(file))
    laboratory.measure()
    assert fitted == [1]
    read = read_trials(file, "drawn")
    assert list(read) == [0, 1]
    assert all(replace(one, estimates={}) == replace(trial, estimates={}) for one in read.values())
    (estimate,) = read[1].estimates.values()
    assert (estimate.ci95, estimate.parts.noise) == (known.ci95, 1.0)


@dataclass(frozen=True)
class Read:
    series: dict[str, Series]


def test_other_readings_of_the_voltmeter_are_off_by_its_noise(monkeypatch):
    volts, seconds = np.linspace(16.4, 15.6, 4000)[:, None], np.arange(4000.0)
    flights = [Read({VOLTAGE: Series(seconds, volts)}) for _ in range(2)]

    def unsmoothed(flights, *_):
        return np.log(np.hstack([flight.series[VOLTAGE].values for flight in flights]))

    monkeypatch.setattr(laboratory, "log_voltage_of", unsmoothed)
    off = np.exp(_voltages(flights, Schedule())(np.random.default_rng(1))) - volts
    assert np.std(off, axis=0) == pytest.approx(METER, rel=0.05)
    assert abs(np.corrcoef(off.T)[0, 1]) < 0.1
