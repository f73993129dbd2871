"""Samples of a steady publisher that were not recorded are put back in between their neighbours."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tuner.recordings.flight import Series
from tuner.recordings.interpolation import GAP, without_gaps
from tuner.recordings.loader import gaps_in

TIME = np.arange(0.0, 6.0, 0.01)


def circling(time: np.ndarray) -> np.ndarray:
    """Return positions on a circle of 2 m at 4 m/s."""
    angle = 2.0 * time
    return 2.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])


@given(st.sets(st.integers(1, len(TIME) - 2), max_size=30))
def test_lost_samples_of_a_circle_come_back(lost: set[int]) -> None:
    kept = np.array([i not in lost for i in range(len(TIME))])
    got = without_gaps(Series(TIME[kept], circling(TIME)[kept]))
    np.testing.assert_allclose(got.time, TIME, atol=1e-9)
    alone = not any(i + 1 in lost for i in lost)
    error = np.abs(got.values - circling(TIME)).max()
    assert error < (1e-3 if alone else 0.02)  # held, it would be 4 cm for each
    np.testing.assert_array_equal(got.values[kept], circling(TIME)[kept])


def test_a_steady_series_is_left_alone() -> None:
    series = Series(TIME, circling(TIME))
    assert without_gaps(series) is series


def test_a_step_stays_between_its_ends() -> None:
    values = np.where(TIME < 3.0, 0.0, 1.0)[:, None]
    kept = np.abs(TIME - 3.0) > 0.025
    got = without_gaps(Series(TIME[kept], values[kept]))
    assert len(got.time) == len(TIME)
    assert np.all((got.values >= 0.0) & (got.values <= 1.0))


@pytest.mark.parametrize("gap", [2.0 * GAP, 1.0])
def test_long_gaps_and_lone_samples_stay(gap: float) -> None:
    kept = (TIME < 2.0) | (2.0 + gap <= TIME)
    assert len(without_gaps(Series(TIME[kept], circling(TIME)[kept])).time) == kept.sum()
    assert len(without_gaps(Series(TIME[:1], circling(TIME)[:1])).time) == 1


def test_an_unknown_sample_counts_as_lost() -> None:
    values = circling(TIME)
    values[100] = np.nan
    got = without_gaps(Series(TIME, values))
    np.testing.assert_allclose(got.values, circling(TIME), atol=1e-3)
    unknown = Series(TIME, np.full((len(TIME), 3), np.nan))
    assert without_gaps(unknown) is unknown


@pytest.mark.parametrize(
    ("hertz", "lost", "is_said"), [(2.0, 0.45, False), (2.0, 2.0, True), (100.0, 0.3, True)]
)
def test_a_signal_is_unknown_only_beyond_what_its_rate_leaves_open(
    hertz: float, lost: float, *, is_said: bool
) -> None:
    clock = np.arange(0.0, 20.0, 0.01)
    sampled = Series(np.arange(0.0, 20.0, 1.0 / hertz), np.ones((int(20 * hertz), 1)))
    values = np.where(clock < lost, np.nan, 16.0)[:, None]
    notes = gaps_in({"battery_voltage": values}, {"battery_voltage": sampled}, 100.0)
    assert bool(notes) is is_said
