"""The uniform clock is laid onto the ticks of what was published regularly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.tuner.recordings import making
from tuner.recordings.clocks import fit_grid, pose_offset
from tuner.recordings.flight import Series
from tuner.recordings.loader import load_flight


def _late(count: int, rate: float, seed: int = 0) -> np.ndarray:
    random = np.random.default_rng(seed)
    return 3.2 + np.arange(count) / rate + random.exponential(0.2e-3, count)


@pytest.mark.parametrize("rate", [100.0, 50.0])
def test_ticks_are_the_lower_envelope(rate: float) -> None:
    grid = fit_grid(_late(3000, rate), 100.0)
    assert grid is not None
    assert grid.origin == pytest.approx(3.2, abs=2e-5)


def test_snapped_stamps_are_one_tick_each() -> None:
    stamps = _late(3000, 100.0)
    grid = fit_grid(stamps, 100.0)
    assert grid is not None
    ticks = (grid.snap(stamps) - grid.origin) * 100
    assert np.allclose(ticks, np.arange(3000), atol=1e-6)


def test_lost_messages_leave_the_others_on_their_ticks() -> None:
    random = np.random.default_rng(1)
    kept = np.sort(random.choice(3000, 2700, replace=False))
    stamps = _late(3000, 100.0)[kept]
    grid = fit_grid(stamps, 100.0)
    assert grid is not None
    ticks = (grid.snap(stamps) - grid.tick_nearest(3.2)) * 100
    assert np.allclose(ticks, kept, atol=1e-6)


def test_drifting_publisher_keeps_its_ticks() -> None:
    stamps = 3.2 + (_late(6000, 100.0) - 3.2) * (1 + 1e-4)
    grid = fit_grid(stamps, 100.0)
    assert grid is not None
    assert grid.drift == pytest.approx(1e-4, rel=0.1)
    assert np.allclose(np.diff(grid.snap(stamps)), 0.01)


def test_free_running_signal_is_left_alone() -> None:
    grid = fit_grid(_late(3000, 100.0), 100.0)
    assert grid is not None
    free = np.arange(0, 20, 0.0127)
    assert np.array_equal(grid.snap(free), free)


def test_irregular_stamps_have_no_grid() -> None:
    random = np.random.default_rng(2)
    assert fit_grid(np.cumsum(random.uniform(0.005, 0.02, 500)), 100.0) is None


@pytest.mark.parametrize("late", [0.0, 0.03, -0.08])
@pytest.mark.parametrize("degrees", [-3.0, 0.0, 2.0])
def test_markers_that_are_turned_a_little_are_not_late(degrees: float, late: float) -> None:
    series = load_flight(making.FLIGHTS / "circle_4mps.bag").series
    time, attitude = series["attitude"].time, series["attitude"].values
    askew = Rotation.from_quat(attitude, scalar_first=True) * Rotation.from_euler(
        "z", degrees, degrees=True
    )
    markers = Series(time + late, askew.as_quat(scalar_first=True))
    assert pose_offset({**series, "attitude": markers}) == pytest.approx(late, abs=2e-3)
