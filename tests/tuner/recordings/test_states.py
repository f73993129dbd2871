"""States of a vehicle at its start, and at any time, are those that it had."""

from __future__ import annotations

import numpy as np
import pytest

from tuner.recordings.flight import Series
from tuner.recordings.states import (
    MIN_HALF_WIDTH_S,
    half_width,
    in_hover,
    initial_position_error,
    initial_state,
    local_parabolas,
    states_at,
)

TIME = np.arange(0.0, 3.0, 0.01)


def wave(time, frequency=2.0):
    return np.sin(2 * np.pi * frequency * time)


def test_fast_motion_is_kept_and_noise_is_not():
    generator = np.random.default_rng(2)
    noise = generator.normal(0.0, 0.02, len(TIME))
    at = np.linspace(0.1, 2.8, 400)
    clean = local_parabolas(Series(TIME, wave(TIME)[:, None]), at)[:, 0]
    assert np.abs(clean - wave(at)).max() < 0.003
    noisy = local_parabolas(Series(TIME, (wave(TIME) + noise)[:, None]), at)[:, 0]
    assert np.std(noisy - clean) < 0.7 * 0.02
    slope = local_parabolas(Series(TIME, wave(TIME)[:, None]), at, derivative=1)[:, 0]
    np.testing.assert_allclose(slope, 4 * np.pi * np.cos(4 * np.pi * at), atol=0.25)


def test_slow_samples_are_filtered_over_more_time_and_gaps_are_bridged():
    slow = Series(TIME[::5], wave(TIME[::5], 0.5)[:, None])
    assert half_width(Series(TIME, TIME[:, None])) == pytest.approx(0.035, abs=0.006)
    assert half_width(slow) == pytest.approx(0.175)
    assert half_width(slow) > MIN_HALF_WIDTH_S
    gap = (TIME < 1.0) | (TIME > 1.2)
    series = Series(TIME[gap], (3.0 * TIME[gap])[:, None])
    assert local_parabolas(series, np.array([1.1]))[0, 0] == pytest.approx(3.3)
    assert np.isnan(local_parabolas(series, np.array([9.0]))).all()
    column = np.where(TIME < 1.0, np.nan, 1.0)
    both = local_parabolas(
        Series(TIME, np.column_stack([column, np.ones(len(TIME))])), np.array([0.2])
    )
    assert np.isnan(both[0, 0])
    assert both[0, 1] == pytest.approx(1.0)


def test_velocity_and_body_rate_follow_from_the_pose_where_they_were_not_recorded():
    angle = 0.4 * wave(TIME, 0.7)
    attitude = np.column_stack([np.cos(angle / 2), np.sin(angle / 2), 0 * angle, 0 * angle])
    position = np.column_stack([wave(TIME, 0.5), TIME, 0 * TIME])
    series = {"position": Series(TIME, position), "attitude": Series(TIME, attitude)}
    at = np.linspace(0.5, 2.5, 50)
    states = states_at(series, at)
    turning = 0.4 * 2 * np.pi * 0.7 * np.cos(2 * np.pi * 0.7 * at)
    np.testing.assert_allclose(states.body_rate[:, 0], turning, atol=0.02)
    np.testing.assert_allclose(states.body_rate[:, 1:], 0.0, atol=1e-9)
    np.testing.assert_allclose(states.velocity[:, 1], 1.0, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(states.attitude, axis=1), 1.0)
    recorded = series | {"velocity": Series(TIME, np.full((len(TIME), 3), 7.0))}
    np.testing.assert_allclose(states_at(recorded, at).velocity, 7.0)
    assert states.at(3).position == pytest.approx(states.position[3])
    assert np.isnan(states.at(3).rotor_speed).all()


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
    error = initial_position_error(flights[0], 5e-4)
    assert found.std(axis=0) == pytest.approx(np.full(3, error), rel=0.15)
