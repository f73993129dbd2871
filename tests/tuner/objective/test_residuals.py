"""What a recording of a simulation would hold, where a signal jumps between its samples."""

import numpy as np
import pytest

from tuner.objective.criterion import OFFSET_UNIT
from tuner.objective.residuals import Reading, at_stamps, residuals
from tuner.objective.segments import CLOCK_OF, CLOCKS, Measured, Segments
from tuner.objective.simulation import Flown

RATE, TICKS = 400.0, 2000
HALF = 0.5 / RATE


def reading_of(late, read_exactly_at=0.0, **options):
    """Return how a recording of commands is read whose clock is late by so many s."""
    clocks = np.zeros((len(CLOCKS) + 3, 1))
    clocks[CLOCK_OF["command"]] = late
    exactly = np.zeros((len(CLOCKS), 1))
    exactly[CLOCK_OF["command"]] = read_exactly_at
    return Reading(clocks, exactly, RATE, TICKS, **options)


def commands_at(series, stamps, late, read_exactly_at):
    """Return the commands (n,) of a recording whose clock is late by so many s."""
    reading = reading_of(late, read_exactly_at)
    return at_stamps(series[None, :, None], "command", stamps[None], reading)[0, :, 0]


def series_of(seed):
    return np.random.default_rng(seed).normal(size=TICKS)


@pytest.mark.parametrize("late", [0.0, -0.2 * HALF, -HALF])
@pytest.mark.parametrize("read_exactly_at", [0.0, -HALF])
def test_samples_in_step_with_the_loop_let_a_clock_move_until_it_passes_a_jump(
    late, read_exactly_at
):
    series, ticks = series_of(1), np.arange(40, 1900, 4)
    read = commands_at(series, ticks / RATE, late, read_exactly_at)
    assert read == pytest.approx(series[ticks], abs=1e-9)


def test_a_jump_that_a_clock_passes_is_seen_and_has_a_slope():
    series, ticks = series_of(2), np.arange(40, 1900, 4)
    early = commands_at(series, ticks / RATE, 0.5 * HALF, 0.0)  # late stamps: the tick before
    assert early == pytest.approx(series[ticks - 1], abs=1e-9)
    late, step = 0.1 * HALF, 1e-3 * HALF
    there, here = (commands_at(series, ticks / RATE, late + by, 0.0) for by in (step, -step))
    stamps = (ticks / RATE)[:, None]
    measured = Measured(
        stamps, np.zeros((*stamps.shape, 1)).swapaxes(1, 2), np.ones((len(ticks), 1, 1))
    )
    segments = Segments(None, None, {"command": measured}, np.zeros(1, int))
    flown = Flown({"command": series[None, :, None]}, {"command": None}, np.full(1, np.inf))
    (block,) = residuals(flown, segments, "command", reading_of(late, coefficients=0))
    slope = block.columns[0, :, 0, CLOCK_OF["command"]] / OFFSET_UNIT
    assert np.abs(slope).max() > 1.0
    assert slope == pytest.approx((there - here) / (2.0 * step), rel=1e-6, abs=1e-6)


def test_samples_at_any_times_move_with_the_signal_in_the_mean():
    stamps = np.sort(np.random.default_rng(3).uniform(0.1, 4.8, 20000))
    rising, late = np.arange(TICKS) * 1.0, 0.6 * HALF
    moved = commands_at(rising, stamps, late, 0.0) - commands_at(rising, stamps, 0.0, 0.0)
    assert float(np.mean(moved)) == pytest.approx(-late * RATE, rel=0.05)


def test_where_it_is_read_exactly_a_command_holds():
    stamps = np.sort(np.random.default_rng(4).uniform(0.1, 4.8, 500))
    series, late = series_of(5), 0.3 * HALF
    held = series[np.floor((stamps - late) * RATE).astype(int)]
    assert commands_at(series, stamps, late, late) == pytest.approx(held, abs=1e-9)
