"""Stretches of time as a selection sees them: of whole flights, and of flights cut into windows."""

import numpy as np

from tests.tuner.uncertainty.making import controller_file, vehicle_file
from tuner.config import JobFile
from tuner.objective.information import BLOCK_S, FisherInformation
from tuner.objective.space import space_of
from tuner.terms.linearisation import linearised_from, neutral_of
from tuner.terms.score import score

FLIGHTS, SECONDS, WINDOW, STRIDE, RATE = 3, 24.0, 0.5, 0.25, 40


def in_windows(columns, residual):
    """Return the linear approximation of regressions (flights, n, 2), cut into windows."""
    size = columns.shape[-1]
    begins = np.arange(0.0, SECONDS - WINDOW, STRIDE)
    rows = (begins[:, None] * RATE).astype(int) + np.arange(round(WINDOW * RATE))
    of_windows, left = columns[:, rows].reshape(-1, rows.shape[1], size), residual[:, rows]
    information = FisherInformation(
        channels=("only",),
        flight=np.repeat(np.arange(FLIGHTS), len(begins)),
        blocks=np.einsum("fnp,fnq->fpq", of_windows, of_windows)[None, :, None],
        score=np.einsum("fnp,fn->fp", of_windows, left.reshape(-1, rows.shape[1]))[None, :, None],
        spread=np.ones((1, FLIGHTS * len(begins))),
        nuisance_prior=np.zeros((size, size)),
        prior=1e-9 * np.eye(size),
        crashed=np.zeros(FLIGHTS * len(begins), bool),
        begins=np.tile(begins, FLIGHTS),
        scale=np.ones((1, FLIGHTS * len(begins))),
    )
    loss = 0.5 * float((left**2).sum())
    return information, linearised_from(information, np.zeros(size), np.zeros(size), loss)


def slow(random, count):
    """Return series (flights, count) that forget within a second."""
    keep, series = np.exp(-1.0 / RATE), np.zeros((FLIGHTS, count))
    series[:, 0] = random.normal(size=FLIGHTS)
    for place in range(1, count):
        fresh = np.sqrt(1.0 - keep**2) * random.normal(size=FLIGHTS)
        series[:, place] = keep * series[:, place - 1] + fresh
    return series


def experiment(seed):
    random, count = np.random.default_rng(seed), round(SECONDS * RATE)
    columns = np.stack([slow(random, count) for _ in range(2)], axis=-1)
    return in_windows(columns, slow(random, count))


def test_windows_that_begin_within_two_seconds_are_one_stretch():
    information, linear = experiment(0)
    stretches = round(SECONDS / BLOCK_S)
    assert linear.flight.tolist() == np.repeat(np.arange(FLIGHTS), stretches).tolist()
    assert (
        linear.section.tolist() == np.tile(np.repeat([0, 1, 2], stretches // 3), FLIGHTS).tolist()
    )
    first = information.blocks[0, : round(BLOCK_S / STRIDE), 0]
    np.testing.assert_allclose(linear.hessian[0], first.sum(axis=0))
    np.testing.assert_allclose(linear.score.sum(axis=0), information.score.sum(axis=(0, 1, 2)))
    np.testing.assert_allclose(linear.information(), information.data)


def test_overlapping_windows_are_not_taken_for_independent():
    """One in a hundred is meant; each window by itself would find something in 13 of a hundred."""
    chances = [
        score(experiment(seed)[1], np.array([0]), np.array([1]), candidates=1).chance
        for seed in range(150)
    ]
    assert np.mean(np.array(chances) < 0.01) < 0.07


def test_a_flight_that_is_flown_whole_keeps_its_stretches():
    random = np.random.default_rng(1)
    blocks = random.normal(size=(1, 2, 7, 1, 1)) ** 2
    information = FisherInformation(
        channels=("only",),
        flight=np.arange(2),
        blocks=blocks,
        score=random.normal(size=(1, 2, 7, 1)),
        spread=np.ones((1, 2)),
        nuisance_prior=np.zeros((1, 1)),
        prior=np.eye(1),
        crashed=np.zeros(2, bool),
        begins=np.zeros(2),
        scale=np.ones((1, 2)),
    )
    linear = linearised_from(information, np.zeros(1), np.zeros(1), 1.0)
    np.testing.assert_array_equal(linear.hessian.ravel(), blocks.ravel())
    np.testing.assert_array_equal(linear.score.ravel(), information.score.ravel())
    assert linear.section.tolist() == [0, 0, 0, 1, 1, 2, 2] * 2


def test_a_term_is_taken_away_to_where_it_does_nothing_of_the_base_model_too():
    """A thrust exponent that a job names counts against thrust by the square of the speed."""
    names = ("motor_constant", "thrust_exponent", "rotor_drag_ratio_y", "linear_drag_x")
    space = space_of(vehicle_file(), controller_file(), JobFile(free=names))
    neutral = dict(zip(space.names, neutral_of(space), strict=True))
    assert [neutral[name] for name in names] == [0.0, 2.0, 0.0, 0.0]
