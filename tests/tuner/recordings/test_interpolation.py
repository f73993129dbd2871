"""Each kind of signal meets the uniform clock in its own way."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from tuner.recordings.flight import Series
from tuner.recordings.interpolation import correlation, correlations, resample

CLOCK = np.arange(0, 1.001, 0.01)


def test_vectors_are_linear_and_unknown_outside_their_span() -> None:
    time = np.arange(0.105, 0.9, 0.02)
    got = resample("position", Series(time, np.column_stack([time, 2 * time, -time])), CLOCK)
    inside = (time[0] <= CLOCK) & (time[-1] >= CLOCK)
    assert np.allclose(got[inside, 1], 2 * CLOCK[inside])
    assert np.isnan(got[~inside]).all()


def test_long_gaps_stay_unknown() -> None:
    time = np.concatenate([np.arange(0, 0.3, 0.01), np.arange(0.7, 1.0, 0.01)])
    got = resample("position", Series(time, np.zeros((len(time), 3))), CLOCK)
    assert np.isnan(got[35:69]).all()
    assert np.isfinite(got[:29]).all()


def test_quaternions_turn_at_constant_speed_through_a_sign_flip() -> None:
    time = np.arange(0, 1.2, 0.1)
    angle = 9.0 * time
    values = np.column_stack([np.cos(angle / 2), 0 * time, 0 * time, np.sin(angle / 2)])
    got = resample("attitude", Series(time, values), CLOCK)
    half = 9.0 * CLOCK / 2
    expected = np.column_stack([np.cos(half), 0 * half, 0 * half, np.sin(half)])
    assert np.abs(got - expected).max() < 1e-9


def test_slerp_agrees_with_scipy() -> None:
    random = np.random.default_rng(0)
    turns = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.5, (12, 3)), axis=0))
    time = np.linspace(0, 1, 12)
    got = resample("attitude", Series(time, turns.as_quat(scalar_first=True)), CLOCK)
    expected = Slerp(time, turns)(CLOCK).as_quat(scalar_first=True)
    assert np.abs(np.abs((got * expected).sum(axis=1)) - 1).max() < 1e-12


def test_setpoints_hold_until_they_are_stale() -> None:
    got = resample("thrust_setpoint", Series(np.array([0.1, 0.2]), np.array([[0.3], [0.4]])), CLOCK)
    assert np.isnan(got[:10]).all()
    assert got[10:20, 0] == pytest.approx(0.3)
    assert got[20:45, 0] == pytest.approx(0.4)
    assert np.isnan(got[60:]).all()


def test_rotors_without_tachometer_stay_unknown() -> None:
    values = np.full((101, 4), np.nan)
    values[:, 3] = 600
    got = resample("rotor_speed", Series(CLOCK, values), CLOCK)
    assert np.isnan(got[:, :3]).all()
    assert (got[:, 3] == 600).all()


def test_correlations_of_all_lags_are_those_of_each() -> None:
    """Also where values are missing, few rows are left, or a signal rests in all of them."""
    random, count, furthest = np.random.default_rng(0), 300, 60
    one = np.cumsum(random.normal(size=(count, 2)), axis=0) + 50.0
    late = np.roll(one, 7, axis=0)
    rests, few = late.copy(), late.copy()
    one[random.random(count) < 0.1, 1], few[:270], rests[:270] = np.nan, np.nan, 3.0
    for other in (late, rests, few):
        each = [
            correlation(
                one[max(0, lag) : count + min(0, lag)], other[max(0, -lag) : count - max(0, lag)]
            )
            for lag in range(-furthest, furthest + 1)
        ]
        np.testing.assert_allclose(correlations(one, other, furthest), each, atol=1e-9)
        assert np.ptp(each) > 0.1
        assert (0.0 in each) == (other is not late)
