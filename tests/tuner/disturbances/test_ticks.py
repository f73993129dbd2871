"""Samples and set-points stand at the ticks at which they were taken and made."""

from __future__ import annotations

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.schedule import Schedule
from tuner.disturbances.ticks import (
    sampled,
    samples_of_ticks,
    setpoints_on_ticks,
    with_equal_weights,
)
from tuner.objective.segments import MeasuredChannel, repeat_counts
from tuner.recordings.flight import Flight, InitialState, Series

RATE = 400.0
TICKS = 400
NOT_LATE = np.zeros((2, 2))


def measured(time: np.ndarray, width: int = 3) -> MeasuredChannel:
    """Two segments whose second ends half-way; each value is its own time."""
    both = np.stack([time, time], axis=-1)
    weight = np.ones((len(time), width, 2))
    weight[len(time) // 2 :, :, 1] = 0.0
    values = np.repeat(both[:, None], width, axis=1)
    return MeasuredChannel(jnp.asarray(both), jnp.asarray(values), jnp.asarray(weight))


def test_a_sample_lies_between_its_tick_and_the_one_before() -> None:
    time = 0.004 + 0.0101 * np.arange(60)
    laid, rows = sampled("position", measured(time), NOT_LATE, TICKS, RATE)
    used = np.asarray(laid.weight)[:, 0] > 0
    tick = np.arange(TICKS)[:, None] * np.ones(2)
    at = (tick - 1.0 + np.asarray(laid.place)) / RATE
    np.testing.assert_allclose(at[used], np.asarray(laid.values)[:, 0][used], atol=1e-12)
    assert (used.sum(axis=0) == [60, 30]).all()
    np.testing.assert_array_equal(rows[:, 0], np.ceil(time * RATE - 1e-6))
    assert (rows[30:, 1] == -1).all()


def test_a_clock_that_is_late_moves_the_samples_and_a_command_holds() -> None:
    time = 0.01 * np.arange(1, 50) + 0.001
    late = np.array([[0.01, 0.01], [0.0, 0.0]])
    _, rows = sampled("position", measured(time), late, TICKS, RATE)
    np.testing.assert_array_equal(rows[:, 0], np.ceil((time - 0.01) * RATE))
    _, rows = sampled("command", measured(time, 4), late, TICKS, RATE)
    np.testing.assert_array_equal(rows[:, 0], np.floor(time * RATE))


def test_a_command_that_rests_weighs_in_a_filter_as_one_that_moves() -> None:
    commands = measured(0.01 * np.arange(1, 50), 4)
    values = 0.3 + np.round(10.0 * np.asarray(commands.values)) / 10.0  # some rest for ten samples
    is_at_rest = np.stack([repeat_counts(table) for table in np.moveaxis(values, -1, 0)], axis=-1)
    assert is_at_rest.max() > 5
    as_one = replace(
        commands,
        values=jnp.asarray(values),
        weight=commands.weight / jnp.asarray(np.sqrt(is_at_rest)),
    )
    np.testing.assert_allclose(with_equal_weights(as_one).weight, commands.weight)


def test_commands_of_which_one_is_cut_off_weigh_nothing_in_a_filter() -> None:
    commands = measured(0.01 * np.arange(1, 50), 4)
    values = np.array(0.3 + commands.values)
    values[7, 2, 0], values[9, 1, 1] = 1.0, 0.0
    weight = np.array(commands.weight)
    weight[7, :, 0] = weight[9, :, 1] = 0.0
    cut_off = replace(commands, values=jnp.asarray(values))
    np.testing.assert_allclose(with_equal_weights(cut_off).weight, weight)


def test_what_is_gathered_is_what_was_laid_out() -> None:
    channels = {
        "position": measured(0.0101 * np.arange(1, 30)),
        "body_rate": measured(0.007 * np.arange(1, 50)),
    }
    laid = {name: sampled(name, each, NOT_LATE, TICKS, RATE) for name, each in channels.items()}
    table = np.concatenate([np.asarray(each.values) for each, _ in laid.values()], axis=1)
    rows = {name: tick for name, (_, tick) in laid.items()}
    back = samples_of_ticks(np.stack([table, 2.0 * table]), {"position": 3, "body_rate": 3}, rows)
    for name, each in channels.items():
        expected = np.where(np.asarray(each.weight) > 0, np.asarray(each.values), 0.0)
        np.testing.assert_array_equal(back[name][0], expected)
        np.testing.assert_array_equal(back[name][1], 2.0 * expected)


def flight(time: np.ndarray, *, thrust: bool = True) -> Flight:
    """A second of set-points that are stamped so, each the number of its tick."""
    made = np.round(time * 100.0)
    series = {"rate_setpoint": Series(time, np.column_stack([made, -made, 0.0 * made]))}
    if thrust:
        series["thrust_setpoint"] = Series(time, made[:, None])
    unknown = np.full(4, np.nan)
    initial = InitialState(np.zeros(3), np.zeros(3), np.eye(4)[0], np.zeros(3), unknown, unknown)
    return Flight("f", "f.bag", "", 100.0, np.arange(101) / 100.0, {}, series, initial)


def test_setpoints_hold_from_the_tick_at_which_they_were_made() -> None:
    stamps = np.arange(101) / 100.0 + 0.00015
    kept = np.delete(stamps, [7, 40])
    schedule = Schedule(log_rate=400)
    inlet = setpoints_on_ticks([flight(kept)], schedule, 400)
    assert inlet is not None
    made = np.arange(400) // 4
    np.testing.assert_allclose(inlet.rate.x[:400, 0], made, atol=1e-9)
    np.testing.assert_allclose(inlet.thrust[:400, 0], made, atol=1e-9)
    np.testing.assert_allclose(inlet.rate.y[:400, 0], -made, atol=1e-9)


@pytest.mark.parametrize(
    "lacking",
    [
        flight(np.arange(0, 101, 2) / 100.0),
        flight(np.arange(101) / 100.0 + 0.004),
        flight(np.arange(101) / 100.0, thrust=False),
    ],
    ids=["every second one is missing", "stamped between ticks", "no thrust"],
)
def test_setpoints_that_were_not_recorded_as_they_were_made_do_not_go_in(lacking: Flight) -> None:
    assert setpoints_on_ticks([lacking], Schedule(log_rate=400), 400) is None
