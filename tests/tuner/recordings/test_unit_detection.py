"""Lengths in another unit than metres are told by gravity, at any speed, and metres never are."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tuner.recordings import making
from tuner.core.numerics import Array
from tuner.recordings.flight import Flight, RawSeries
from tuner.recordings.loader import load_flight
from tuner.recordings.notes import NoteCode
from tuner.recordings.unit_detection import (
    Scale,
    _medians_in,
    scale_of,
    scales_of,
    to_enu_flu,
    unit_of,
)

REAL = Path(os.environ.get("TUNE_REAL_FLIGHTS", Path(__file__).parents[4] / "shared" / "flights"))
FILES = sorted((REAL / "nanobench").glob("*.csv"))
PER_METRE = {"si": 1.0, "ft": 1 / 0.3048, "cm": 100.0, "mm": 1000.0}
UNITS = pytest.mark.parametrize("unit", PER_METRE)


def flight(
    speed: float, *, rate: float = 100.0, noise: float = 0.001, seconds: float = 20.0, seed: int = 0
) -> dict[str, RawSeries]:
    """Return a lemniscate of 4 m by 2 m at about some m/s, in SI units.

    Noise is white, in m, m/s and, of a quaternion's components, without a unit.
    """
    random, time = np.random.default_rng(seed), np.arange(0.0, seconds, 1 / rate)
    tempo, size = speed / 2.0 * np.array([1.0, 2.0, 1.3]), np.array([2.0, 1.0, 0.2])

    def motion(order: int) -> Array:
        phase = time[:, None] * tempo + 0.5 * np.pi * order
        return np.asarray(size * tempo**order * np.sin(phase))

    up = motion(2) + np.array([0.0, 0.0, 9.81])
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    # the shortest turn that takes the vertical there
    attitude = np.column_stack([1.0 + up[:, 2], -up[:, 1], up[:, 0], 0.0 * time])
    attitude /= np.linalg.norm(attitude, axis=1, keepdims=True)
    signals = {"position": motion(0), "velocity": motion(1), "attitude": attitude}
    return {
        name: RawSeries(time, values + noise * random.normal(size=values.shape))
        for name, values in signals.items()
    }


def in_unit(signals: Mapping[str, RawSeries], unit: str) -> dict[str, RawSeries]:
    """Return signals with their lengths in a unit."""
    factors = {"position": PER_METRE[unit], "velocity": PER_METRE[unit], "attitude": 1.0}
    return {name: RawSeries(s.time, factors[name] * s.values) for name, s in signals.items()}


def units(signals: Mapping[str, RawSeries]) -> set[str]:
    """Return the units that the lengths are read in."""
    return {unit_of(name, "", scale)[0] for name, scale in scales_of(signals).items()}


@given(
    speed=st.floats(0.5, 4.0),
    noise=st.floats(0.0, 0.003),
    rate=st.sampled_from([10.0, 30.0, 100.0, 240.0]),
    unit=st.sampled_from(sorted(PER_METRE)),
    seed=st.integers(0, 99),
)
def test_the_unit_is_told_at_any_speed_noise_and_rate(speed, noise, rate, unit, seed) -> None:
    assert units(in_unit(flight(speed, rate=rate, noise=noise, seed=seed), unit)) == {unit}


@given(
    speed=st.floats(0.0, 30.0),
    noise=st.floats(0.0, 0.1),
    rate=st.floats(5.0, 500.0),
    seconds=st.floats(0.1, 20.0),
    seed=st.integers(0, 999),
)
def test_metres_are_never_taken_for_anything_else(speed, noise, rate, seconds, seed) -> None:
    """Hovers, races, short flights and poses of GPS: nothing is read otherwise, nothing doubted."""
    signals = flight(speed, rate=rate, noise=noise, seconds=seconds, seed=seed)
    for name, scale in scales_of(signals).items():
        assert unit_of(name, "", scale) == ("si", None)


@given(noise=st.floats(1e-4, 0.1), unit=st.sampled_from(["cm", "mm"]), seed=st.integers(0, 999))
def test_a_hover_tells_nothing(noise, unit, seed) -> None:
    assert units(in_unit(flight(0.0, noise=noise, seed=seed), unit)) == {"si"}


@UNITS
def test_stamps_and_samples_may_be_as_loggers_leave_them(unit: str) -> None:
    """Stamps out of order and in bursts, gaps, one of twenty samples corrupt, one of a year ago."""
    random, signals = np.random.default_rng(2), in_unit(flight(1.0), unit)
    for name, samples in signals.items():
        time = np.floor(samples.time / 0.05) * 0.05 + 2e-6 * np.arange(len(samples.time))
        values = samples.values.copy()
        values[400:520] = np.nan
        values[random.random(len(values)) < 0.05] = 1e5
        time[7] -= 3e7
        order = random.permutation(len(time))
        signals[name] = RawSeries(time[order], values[order])
    assert units(signals) == {unit}


@UNITS
@pytest.mark.parametrize(
    "recorded",
    [
        lambda q: q[:, [1, 2, 3, 0]],
        lambda q: -q,
        lambda q: 2.0 * q,
        lambda q: to_enu_flu(q, "attitude"),
    ],
)
def test_an_attitude_in_another_order_tells_it_too(unit: str, recorded) -> None:
    signals = in_unit(flight(1.0), unit)
    attitude = signals["attitude"]
    assert units(signals | {"attitude": RawSeries(attitude.time, recorded(attitude.values))}) == {
        unit
    }


@pytest.mark.parametrize("per_metre", [10.0, 39.37])
def test_a_unit_without_a_name_is_doubted(per_metre: float) -> None:
    signals = flight(1.5)
    position = RawSeries(signals["position"].time, per_metre * signals["position"].values)
    scale = scale_of(position, signals["attitude"])
    unit, note = unit_of("position", "/pose", scale)
    assert unit == "si"
    assert note is not None
    assert (note.code, note.topic, note.names) == (NoteCode.UNIT_DOUBTED, "/pose", ("position",))
    assert note.numbers["times"] == pytest.approx(per_metre, rel=0.05)


def test_a_speed_need_not_share_the_positions_unit() -> None:
    signals = flight(1.5)
    millimetres = in_unit(signals, "mm")["position"]
    scales = scales_of(signals | {"position": millimetres})
    assert {name: unit_of(name, "", scale)[0] for name, scale in scales.items()} == {
        "position": "mm",
        "velocity": "si",
    }


def test_a_speed_that_tells_nothing_follows_the_position() -> None:
    """It was recorded for two seconds only."""
    signals = in_unit(flight(1.5), "mm")
    velocity = RawSeries(signals["velocity"].time[:200], signals["velocity"].values[:200])
    assert not scale_of(velocity, signals["attitude"], speeds=True).sure
    assert units(signals | {"velocity": velocity}) == {"mm"}
    foreign = RawSeries(velocity.time, 1e-3 * velocity.values)
    scales = scales_of(signals | {"velocity": foreign})
    assert unit_of("velocity", "", scales["velocity"]) == ("si", None)


def test_nothing_is_known_of_nothing() -> None:
    none = RawSeries(np.empty(0), np.empty((0, 3)))
    attitude = flight(1.0)["attitude"]
    assert scale_of(none, attitude) == scale_of(attitude, RawSeries(np.empty(0), np.empty((0, 4))))
    assert scale_of(RawSeries(attitude.time, np.full((2000, 3), np.nan)), attitude) == Scale()
    assert scales_of({"position": none}) == {}
    assert set(scales_of({"position": none, "velocity": none, "attitude": attitude})) == {
        "position",
        "velocity",
    }


def lengths_and_attitude(flown: Flight) -> dict[str, RawSeries]:
    names = ("position", "velocity", "attitude")
    return {name: RawSeries(flown.series[name].time, flown.series[name].values) for name in names}


@pytest.mark.parametrize(
    "name", ["circle_3mps", "circle_4mps", "diagonal_3mps", "lemniscate_4mps", "yaw_spin_3rps"]
)
def test_the_shipped_flights_in_other_units(name: str) -> None:
    """All but the yaw spin, which holds still to a hundredth of a degree, and is left as it is."""
    signals = lengths_and_attitude(load_flight(making.FLIGHTS / f"{name}.bag"))
    for unit in PER_METRE:
        assert units(in_unit(signals, unit)) == {"si" if name == "yaw_spin_3rps" else unit}


@pytest.mark.skipif(not FILES, reason=f"no real flights in {REAL}")
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_real_flights_in_other_units(path: Path) -> None:
    flown = load_flight(path)
    assert not [note for note in flown.notes if note.code in ("unit_read", "unit_doubted")]
    signals = lengths_and_attitude(flown)
    for unit in PER_METRE:
        assert units(in_unit(signals, unit)) == {unit}


@pytest.mark.parametrize("burst", [0, 5000], ids=["even", "a burst"])
def test_medians_in_bins_are_those_of_their_samples(burst: int) -> None:
    """Whatever the samples' order, and where one bin holds nearly all of them."""
    random = np.random.default_rng(0)
    bins = random.permutation([*random.integers(0, 50, 300).tolist(), *[7] * burst])
    values = random.normal(size=len(bins))
    held, medians_of = _medians_in(bins)
    assert held.tolist() == np.unique(bins).tolist()
    for bin_, median in zip(held, medians_of(values), strict=True):
        own = np.sort(values[bins == bin_])
        assert median == own[len(own) // 2]
