import numpy as np
import pytest

from tuner.flights.flight import Series
from tuner.objective.noise import white_noise


@pytest.mark.parametrize("sigma", [5e-4, 5e-3])
def test_noise_is_told_from_motion_at_jittering_stamps(sigma):
    generator = np.random.default_rng(1)
    time = np.sort(np.arange(4000) / 100 + generator.normal(0, 1e-3, 4000))
    time = np.maximum.accumulate(time + np.arange(4000) * 1e-9)
    moving = 2.0 * np.cos(1.5 * time)  # 3 m/s, so that a stamp's jitter is worth 3 mm
    values = np.stack([moving + generator.normal(0, sigma, 4000)], axis=-1)
    assert white_noise(Series(time, values))[0] == pytest.approx(sigma, rel=0.1)


def test_jumps_do_not_count_as_noise():
    generator = np.random.default_rng(2)
    time = np.arange(2000) / 100
    values = generator.normal(0, 1e-3, (2000, 1))
    values[::100] += 1.0
    assert white_noise(Series(time, values))[0] == pytest.approx(1e-3, rel=0.15)


def test_a_column_that_was_not_measured_has_no_noise():
    values = np.full((100, 2), np.nan)
    values[:, 0] = np.random.default_rng(3).normal(size=100)
    noise = white_noise(Series(np.arange(100) / 100, values))
    assert np.isfinite(noise[0])
    assert np.isnan(noise[1])
