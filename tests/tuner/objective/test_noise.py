from dataclasses import replace

import numpy as np
import pytest

from sim_jax.schedule import Schedule
from tuner.objective.segments import repeat_counts, segments_of, white_noise
from tuner.recordings.flight import Series


@pytest.mark.parametrize("sigma", [5e-4, 5e-3])
def test_noise_is_separated_from_motion_at_jittering_stamps(sigma):
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


def test_a_value_that_rests_is_one_reading():
    values = np.array([[1.0, 1.0], [1.0, 2.0], [1.0, 3.0], [2.0, 3.0], [np.nan, np.nan]])
    assert repeat_counts(values).tolist() == [[3, 1], [3, 1], [3, 2], [1, 2], [1, 1]]
    assert repeat_counts(values[:0]).shape == (0, 2)


def test_a_steady_rounded_command_counts_as_one_reading(flight):
    """A signal that rests between two steps is off by the same in all of its samples."""
    series = flight.series["command"]
    steady = np.full_like(series.values, 0.488)
    moving = np.round(0.3 + 0.4 * np.random.default_rng(4).random(series.values.shape), 3)
    weights = []
    for values in (steady, moving):
        at_rest = replace(
            flight, series={**flight.series, "command": replace(series, values=values)}
        )
        segments = segments_of([at_rest], noise={"command": 1e-3}, schedule=Schedule())
        weights.append(np.asarray(segments.measured["command"].weight)[..., 0])
    told = [(weight**2).sum(axis=0) * 1e-6 for weight in weights]
    assert told[0] == pytest.approx(np.ones(4))
    assert told[1] == pytest.approx(np.full(4, len(series.time)), rel=0.05)
