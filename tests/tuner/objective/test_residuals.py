"""What a recording of a simulation would hold, where a signal jumps between its samples."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tuner.objective.residuals import Trace, simulated_at_stamps
from tuner.objective.segments import CLOCK_OF, CLOCKS, Measured

RATE, TICKS = 400.0, 2000
HALF = 0.5 / RATE


def commands_at(series, stamps, late, read_exactly_at):
    """Return the commands (n,) of a recording whose clock is late by so many s."""
    trace = Trace({"command": jnp.asarray(series)[:, None, None]}, jnp.full(1, jnp.inf))
    shape = len(stamps), 1
    measured = Measured(jnp.asarray(stamps)[:, None], jnp.zeros((*shape, 1)), jnp.ones((*shape, 1)))
    clocks = jnp.zeros((len(CLOCKS) + 3, 1)).at[CLOCK_OF["command"]]
    exactly = clocks.set(read_exactly_at)[: len(CLOCKS)]
    return simulated_at_stamps(trace, "command", measured, clocks.set(late), exactly, rate=RATE)[
        :, 0, 0
    ]


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
    late = 0.1 * HALF
    slope = jax.grad(lambda by: jnp.sum(commands_at(series, ticks / RATE, by, 0.0) ** 2))(late)
    step = 1e-3 * HALF
    there, here = (
        float(jnp.sum(commands_at(series, ticks / RATE, late + by, 0.0) ** 2))
        for by in (step, -step)
    )
    assert float(slope) == pytest.approx((there - here) / (2.0 * step), rel=1e-4)


def test_samples_at_any_times_move_with_the_signal_in_the_mean():
    stamps = np.sort(np.random.default_rng(3).uniform(0.1, 4.8, 20000))
    rising, late = np.arange(TICKS) * 1.0, 0.6 * HALF
    moved = commands_at(rising, stamps, late, 0.0) - commands_at(rising, stamps, 0.0, 0.0)
    assert float(jnp.mean(moved)) == pytest.approx(-late * RATE, rel=0.05)


def test_where_it_is_read_exactly_a_command_holds():
    stamps = np.sort(np.random.default_rng(4).uniform(0.1, 4.8, 500))
    series, late = series_of(5), 0.3 * HALF
    held = series[np.floor((stamps - late) * RATE).astype(int)]
    assert commands_at(series, stamps, late, late) == pytest.approx(held, abs=1e-9)
