"""The state at the start: averaged in a hover, a local parabola in flight."""

from __future__ import annotations

import numpy as np
import pytest

from tuner.recordings.flight import Series
from tuner.recordings.states import in_hover, initial_state, position_error


def _flight(speed: float, turn: float, seed: int = 0) -> dict[str, Series]:
    random = np.random.default_rng(seed)
    time = np.arange(-2, 2, 0.01) + 0.003
    noise = random.normal(0, 5e-4, (len(time), 3))
    path = np.column_stack([speed * time, 0.8 * speed * time**2, np.ones_like(time)])
    rates = np.tile([0, 0, turn], (len(time), 1)) + random.normal(0, 0.01, (len(time), 3))
    half = turn * time / 2
    attitude = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    return {
        "position": Series(time, path + noise),
        "attitude": Series(time, attitude),
        "body_rate": Series(time, rates),
    }


def test_flying_start() -> None:
    series = _flight(3.0, 1.5)
    assert not in_hover(series)
    state = initial_state(series)
    assert state.position == pytest.approx([0, 0, 1], abs=1e-3)
    assert state.velocity == pytest.approx([3, 0, 0], abs=0.03)
    assert state.attitude == pytest.approx([1, 0, 0, 0], abs=1e-4)
    assert state.body_rate == pytest.approx([0, 0, 1.5], abs=0.02)
    assert np.isnan(state.rotor_speed).all()
    assert np.isnan(state.command).all()


def test_hover_is_averaged_against_outliers() -> None:
    series = _flight(0.0, 0.0)
    series["position"].values[150] += 0.04
    assert in_hover(series)
    state = initial_state(series)
    assert state.position == pytest.approx([0, 0, 1], abs=3e-4)
    assert np.abs(state.velocity).max() < 2e-3


def test_what_follows_the_start_does_not_reach_into_a_hover() -> None:
    series = _flight(0.0, 0.0)
    moved = series["position"].values.copy()
    moved[series["position"].time > 0] += 0.5
    series["position"] = Series(series["position"].time, moved)
    assert initial_state(series).position == pytest.approx([0, 0, 1], abs=3e-4)


@pytest.mark.parametrize(("speed", "turn"), [(0.0, 0.0), (3.0, 1.5)])
def test_the_position_at_the_start_scatters_as_is_said(speed: float, turn: float) -> None:
    flights = [_flight(speed, turn, seed) for seed in range(300)]
    found = np.array([initial_state(series).position for series in flights])
    error = position_error(flights[0], 5e-4)
    assert found.std(axis=0) == pytest.approx(np.full(3, error), rel=0.15)
