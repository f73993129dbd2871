"""Sets of flights are drawn, flown and ranked as simulation-based calibration wants it."""

import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks import calibration as cal
from benchmarks.air import gauss_markov
from benchmarks.oracle import simulate_like
from tuner.search.progress import criterion_of
from tuner.search.stages import plan

NOISE, GUSTS, *_ = cal.KINDS


def ranked(*off, converged=True):
    names = [f"c{i}" for i in range(len(off))]
    quoted, oracle = dict.fromkeys(names, 3.0), dict.fromkeys(names, 2.0)
    return cal.RankedSet(dict(zip(names, off, strict=True)), quoted, oracle, 1.0, converged)


def test_of_truths_that_are_where_the_interval_says_the_level_lies_inside():
    off = np.random.default_rng(1).normal(size=20_000)
    for level in cal.COVERAGE_LEVELS:
        assert cal.share_within(off, level) == pytest.approx(float(level) / 100, abs=0.01)


def test_the_band_is_that_of_as_many_tosses():
    low, high = cal.band("95", 20)
    many = np.random.default_rng(2).binomial(20, 0.95, 50_000) / 20
    assert np.mean((many >= low) & (many <= high)) >= 0.95
    assert np.mean((many > low) & (many < high)) < 0.95


def test_the_table_says_what_was_found_of_all_and_of_each():
    sets = [ranked(0.1, 3.0), ranked(-0.1, 1.0)]
    rows = cal.section({"gusts": sets}, "2026-01-02").rows
    assert [row[:3] for row in rows] == [["gusts", n, "2"] for n in ("all", "c0", "c1")]
    assert rows[0][5].startswith("75 %")
    assert [row[5].split(" (")[0] for row in rows[1:]] == ["100 %", "50 %"]
    assert [row[6] for row in rows] == ["+1.00", "+0.00", "+2.00"]
    assert rows[2][7] == f"{np.sqrt(5):.3g}"
    assert [row[8] for row in rows] == ["1.5 ×"] * 3


def test_a_search_that_did_not_converge_is_counted_and_not_ranked():
    sets = [ranked(0.1, 0.2), ranked(9.0, 9.0, converged=False)]
    found = cal.section({"gusts": sets, "noise alone": sets[:1]}, "2026-01-02")
    assert [row[2] for row in found.rows] == ["1"] * 6
    assert found.rows[0][5].startswith("100 %")
    assert "1 and 0 searches say that they did not converge" in found.text


def test_what_wanders_has_its_size_and_forgets_in_its_time():
    series = gauss_markov(
        np.random.default_rng(3), (100_000, 1), deviation=2.0, seconds=0.5, rate=10.0
    )[:, 0]
    assert series.std() == pytest.approx(2.0, rel=0.03)
    kept = np.corrcoef(series[:-5], series[5:])[0, 1]
    assert kept == pytest.approx(np.exp(-1.0), abs=0.03)


@pytest.mark.long
def test_a_truth_meets_its_recordings_to_within_noise_and_is_found():
    """Fitted flights with noise alone: white residuals at the truth, which the intervals hold."""
    objective = cal.problem(terms=False)
    truth = cal.draw_truth(objective.space, np.random.default_rng(4))
    flown = simulate_like(objective, truth, np.random.default_rng(5), gusts=False)
    assert flown is not None
    stage = plan("gradient", flown.samples, 100.0, windows=False, robust=False, steps=8)[-1]
    scales = {name: np.ones(flown.flights) for name in flown.segments.measured}
    point = flown.start(truth)
    sums = flown.sums(point, criterion_of(stage, scales, np.asarray(point.offsets)))
    for name, squares in sums.squares.items():
        counted = np.asarray(sums.counts[name]) > 0
        mean = np.asarray(squares)[counted] / np.asarray(sums.counts[name])[counted]
        assert mean == pytest.approx(1.0, abs=0.1), name
    found = cal.fitted(flown)
    off = np.asarray(found.point.coefficients) - truth
    assert float(jnp.abs(off).max()) < 0.2


@pytest.mark.long
def test_intervals_of_flights_in_gusts_hold_the_truth():
    """Three sets: of some thirty intervals at 95 % none of three in four would be chance."""
    sets = [cal.ranked_set(GUSTS, seed) for seed in range(3)]
    off = [off for ranked in sets for off in ranked.off.values()]
    assert cal.share_within(off, "95") >= 0.75
    assert 0.1 < np.std(off) < 2.0
