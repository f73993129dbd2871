"""Gradient and Hessian against finite differences, on two short simulated flights."""

from dataclasses import replace
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from sim_jax.schedule import Schedule
from tests.tuner.uncertainty.making import criterion_of, problem, truth, with_data
from tuner.objective.criterion import OFFSET_UNIT, Point
from tuner.objective.normal_equations import (
    VECTORS_AT_ONCE,
    evaluate,
    normal_equations,
    root_mean_squares,
)
from tuner.objective.residuals import Reading, at_stamps, gauss_newton, residuals
from tuner.objective.segments import (
    CLOCK_OF,
    CLOCKS,
    MeasuredChannel,
    Segments,
    repeat_counts,
    segments_of,
    white_noise,
)
from tuner.objective.simulation import SimulatedChannels
from tuner.recordings.flight import Series

FREE = ("inertia_xx", "time_constant_up", "motor_constant", "estimate_latency")


@pytest.fixture(scope="module")
def fit():
    return problem(FREE)


def loss_at(fit, coefficients, offsets, criterion):
    point = Point(jnp.asarray(coefficients), jnp.asarray(offsets))
    sums = fit.sums(point, criterion, derivatives=True)
    return normal_equations(fit, point, criterion, sums)


def test_gradient_equals_finite_differences(fit):
    criterion = criterion_of(fit)
    at = np.asarray(fit.space.initial) + 0.1
    late = np.full((5, 2), 0.05)
    _, gradient, _ = loss_at(fit, at, late, criterion)
    for index in range(len(at)):
        step = np.zeros_like(at)
        step[index] = 1e-5
        up, _, _ = loss_at(fit, at + step, late, criterion)
        down, _, _ = loss_at(fit, at - step, late, criterion)
        assert float(gradient[index]) == pytest.approx(float(up - down) / 2e-5, rel=2e-3, abs=1e-8)


def test_offset_gradient_equals_finite_differences(fit):
    criterion = criterion_of(fit)
    at = np.asarray(fit.space.initial)
    late = np.full((5, 2), 0.03)
    _, gradient, _ = loss_at(fit, at, late, criterion)
    by_offset = gradient[len(at) :].reshape(5, 2)
    step = np.zeros((5, 2))
    step[0, 0] = 1e-4
    up, _, _ = loss_at(fit, at, late + step, criterion)
    down, _, _ = loss_at(fit, at, late - step, criterion)
    assert float(by_offset[0, 0]) == pytest.approx(float(up - down) / 2e-4, rel=1e-2)


def test_the_truth_has_no_residual_and_no_gradient(fit):
    criterion = criterion_of(fit, prior=0.0)
    point = truth(fit)
    sums = fit.sums(point, criterion, derivatives=True)
    assert float(jnp.sum(sums.loss)) < 1e-12
    assert not np.any(np.isfinite(sums.crash_time))


def test_hessian_is_symmetric_and_positive(fit):
    criterion = criterion_of(fit)
    _, _, hessian = loss_at(fit, np.asarray(fit.space.initial), np.zeros((5, 2)), criterion)
    np.testing.assert_allclose(hessian, hessian.T, rtol=1e-12)
    assert np.linalg.eigvalsh(np.asarray(hessian)).min() > 0


class _InTurn:
    """One thread, which begins with a block as the one before has ended."""

    map = staticmethod(map)


class _LastFirst:
    """Threads of which those that are given work last end first."""

    @staticmethod
    def map(work, blocks):
        return [work(block) for block in list(blocks)[::-1]][::-1]


def test_sums_are_the_same_in_whatever_order_threads_end(fit, monkeypatch):
    monkeypatch.setattr("tuner.objective.residuals.STAMPS_AT_ONCE", 100)  # several blocks a flight
    at = Point(np.asarray(fit.space.initial) + 0.1, np.full((5, 2), 0.05))

    def computed(threads):
        monkeypatch.setattr("tuner.objective.normal_equations._threads", threads)
        return fit.sums(at, criterion_of(fit)), fit.jacobian(at, criterion_of(fit))

    assert eqx.tree_equal(computed(_InTurn), computed(_LastFirst))


def test_a_horizon_cuts_the_compared_samples(fit):
    criterion = criterion_of(fit)
    short = replace(criterion, horizon=400)
    point = Point(jnp.asarray(fit.space.initial + 0.2), jnp.zeros((5, 2)))
    whole = fit.sums(point, criterion, derivatives=True)
    part = fit.sums(point, short, derivatives=True)
    assert float(part.counts["position"][0]) == pytest.approx(
        float(whole.counts["position"][0]) / 3, rel=0.02
    )
    assert float(part.squares["position"][0]) < float(whole.squares["position"][0])


@pytest.mark.parametrize(("late", "missed"), [(0.0, 0), (0.004, 0), (0.03, 1), (-0.03, 0)])
def test_what_a_late_clock_stamps_before_the_start_is_not_compared(fit, late, missed):
    """Two flights of three rates each; a clock that is late by less than a sample misses none."""
    point, criterion = truth(fit), criterion_of(fit)
    at = np.where(np.arange(2)[:, None] == CLOCK_OF["body_rate"], late, np.zeros((2, 2)))
    counts = [
        fit.sums(point, one, derivatives=False).counts
        for one in (criterion, replace(criterion, reference_offset=at))
    ]
    assert np.all(counts[0]["body_rate"] - counts[1]["body_rate"] == 3 * missed)
    assert np.all(counts[0]["position"] == counts[1]["position"])


def test_huber_counts_large_residuals_linearly(fit):
    criterion = criterion_of(fit)
    robust = replace(criterion, huber=2.0)
    point = Point(jnp.asarray(fit.space.initial + 0.5), jnp.zeros((5, 2)))
    plain = fit.sums(point, criterion, derivatives=True)
    bounded = fit.sums(point, robust, derivatives=True)
    assert float(jnp.sum(bounded.loss)) < float(jnp.sum(plain.loss))
    assert float(jnp.sum(bounded.squares["position"])) == pytest.approx(
        float(jnp.sum(plain.squares["position"]))
    )


def test_a_late_clock_is_found_in_its_own_column(fit):
    late = Point(truth(fit).coefficients, jnp.zeros((5, 2)).at[:2].set(0.02 / OFFSET_UNIT))
    shifted = with_data(fit, truth(fit))
    moved = eqx.tree_at(
        lambda o: [m.time for m in o.segments.measured.values()],
        shifted,
        [m.time + 0.02 for m in shifted.segments.measured.values()],
    )
    criterion = criterion_of(fit, prior=0.0)
    with_offset = moved.sums(late, criterion, derivatives=True)
    without = moved.sums(truth(fit), criterion, derivatives=True)
    assert float(jnp.sum(with_offset.loss)) < 1e-3 * float(jnp.sum(without.loss))


def test_a_flight_on_which_the_vehicle_tumbles_has_a_loss_and_no_slope(fit):
    """Derivatives grow a million millionfold there, and would be all that a step goes by."""
    values, criterion = fit.space.numbers(fit.space.initial), criterion_of(fit)
    values["inertia_xx"] *= 0.1
    light, flies, tumbles = fit.start(fit.space.vector_of(values)), 0, 1
    columns = fit.jacobian(light, criterion).columns["body_rate"]
    assert np.abs(columns[..., tumbles]).max() > 1e8
    sums = fit.sums(light, criterion)
    assert sums.loss[tumbles] > 0.0
    assert not sums.gradient[:, tumbles].any()
    assert not sums.hessian[..., tumbles].any()
    assert sums.gradient[:, flies].any()


# many vectors at once against one after the other

FOUR = ("inertia_xx", "time_constant_up", "motor_constant", "estimate_latency")


@pytest.fixture(scope="module")
def problem_of_four():
    return problem(FOUR)


def test_each_vector_of_a_batch_gives_the_same_as_alone(problem_of_four):
    criterion = replace(criterion_of(problem_of_four), huber=2.0)
    steps = np.random.default_rng(1).normal(0.0, 0.2, (VECTORS_AT_ONCE + 1, len(FOUR)))
    vectors = np.asarray(problem_of_four.space.initial) + steps
    late = jnp.full((5, 2), 0.1)
    batch = evaluate(problem_of_four, vectors, Point(jnp.asarray(vectors[0]), late), criterion)
    assert batch.loss.shape == (VECTORS_AT_ONCE + 1, 2)
    for number in (0, 3, VECTORS_AT_ONCE):
        alone = problem_of_four.sums(
            Point(jnp.asarray(vectors[number]), late), criterion, derivatives=False
        )
        np.testing.assert_allclose(batch.loss[number], alone.loss, rtol=1e-9)
        for name, squares in alone.squares.items():
            np.testing.assert_allclose(batch.squares[name][number].sum(axis=0), squares, rtol=1e-9)


# what a recording of a simulation would hold, where a signal jumps between its samples

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
    measured = MeasuredChannel(
        stamps, np.zeros((*stamps.shape, 1)).swapaxes(1, 2), np.ones((len(ticks), 1, 1))
    )
    segments = Segments(None, None, {"command": measured}, np.zeros(1, int))
    flown = SimulatedChannels(
        {"command": series[None, :, None]}, {"command": None}, np.full(1, np.inf)
    )
    (block_of,) = residuals(flown, segments, "command", reading_of(late, coefficients=0))
    block = block_of()
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


# the standard deviation of noise


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


def test_a_flight_that_is_off_without_bound_leaves_the_others_residuals():
    objective = SimpleNamespace(flights=3, flight=np.array([0, 1, 1]))
    squares = {"position": np.array([[8.0, 2.0, np.inf], [8.0, 2.0, 6.0]])}
    counts = {"position": np.array([[2.0, 1.0, 1.0]] * 2)}
    found = root_mean_squares(objective, SimpleNamespace(squares=squares, counts=counts))
    np.testing.assert_array_equal(found["position"], [[2.0, np.inf, np.nan], [2.0, 2.0, np.nan]])


def test_derivatives_without_bound_count_nothing():
    columns = np.array([[[[1e200, np.inf]]], [[[1.0, 2.0]]]])
    gradient, hessian = gauss_newton(columns, np.ones((2, 1, 1)), np.ones(2), 3.0)
    np.testing.assert_array_equal(gradient, [[0.0, 0.0], [1.0, 2.0]])
    np.testing.assert_array_equal(hessian, [np.zeros((2, 2)), [[1.0, 2.0], [2.0, 4.0]]])
