"""A search whose segments' starts are free: the losses it compares are those of its points."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from tests.tuner.uncertainty.making import PHYSICS, problem, truth, with_data
from tuner.objective.criterion import Point
from tuner.objective.initial_conditions import ROWS, start_sd_of_spin
from tuner.objective.segments import OFFSETS
from tuner.search.continuation import run_stages
from tuner.search.optimisers import MAX_STATE_SD, estimated_states, need_relinearising
from tuner.search.progress import criterion_of, initial_progress
from tuner.search.stages import plan

FREE = ("inertia_zz", "moment_constant", "rotor_drag_coefficient")
YAW = ROWS["rate_integral"].stop - 1
OFF = 3.0
"""Standard deviations by which the spin's integrator was off as the flight began."""


def begun_elsewhere():
    """Return a spin whose yaw integrator began far from where it is taken to begin, both free.

    So far that what it does to the flight is no line.
    """
    fit = problem(FREE)
    start_sd = start_sd_of_spin(np.array([0.0, 2.0]), PHYSICS, np.array([1e-4, 1e-4]))
    start_sd = {row: 10.0 * sd for row, sd in start_sd.items()}
    start = fit.segments.start
    turned = start.rate_integral.z + OFF * start_sd[YAW]
    there = replace(start, rate_integral=replace(start.rate_integral, z=turned))
    flown = with_data(replace(fit, segments=replace(fit.segments, start=there)), truth(fit))
    return replace(
        fit,
        segments=replace(
            fit.segments,
            measured=flown.segments.measured,
            start_sd=jnp.asarray(np.stack([*start_sd.values()])),
            free_rows=(*start_sd,),
        ),
    )


@pytest.mark.parametrize("away", [0.05, 0.4])
def test_a_search_ends_where_its_loss_is_least_from_the_start_that_it_found(away):
    fit = begun_elsewhere()
    rate = float(fit.schedule.log_rate)
    *_, last = plan("gradient", fit.samples, rate, windows=False, robust=False, steps=60)
    true = np.asarray(truth(fit).coefficients)
    progress = run_stages(
        fit,
        (last,),
        initial_progress(fit, true[None] + away),
        free=Point(np.ones(len(FREE), bool), np.zeros((len(OFFSETS), 2), bool)),
        undecided={},
        on_progress=lambda _: None,
    )
    found = Point(progress.points.coefficients[0], progress.points.offsets[0])
    criterion = criterion_of(last, progress.scales, np.asarray(found.offsets), progress.states)
    sums = fit.sums(found, criterion, derivatives=False)
    compared = sum(float(np.sum(n)) for n in sums.counts.values())
    assert progress.states[-1] == pytest.approx([0.0, OFF], abs=0.01)
    assert progress.losses[0] * compared == pytest.approx(0.5 * OFF**2, rel=0.01)  # its prior's
    assert float(jnp.sum(sums.loss)) == pytest.approx(0.5 * OFF**2, rel=0.01)
    assert np.asarray(found.coefficients) == pytest.approx(true, abs=1e-3)


def test_an_initial_state_is_limited_and_kept_where_it_has_no_estimate():
    fit = begun_elsewhere()
    criterion = replace(
        criterion_of(
            plan("gradient", fit.samples, 200.0, windows=False, robust=False, steps=1)[-1],
            {name: np.ones(2) for name in fit.segments.measured},
            np.zeros((len(OFFSETS), 2)),
        ),
        states=np.zeros((3, 2)),
    )
    sums = fit.sums(truth(fit), criterion, derivatives=False)
    before = np.array([[0.5, 0.0], [0.0, 0.0], [0.0, 0.0]])
    asked = replace(sums, states=np.array([[[np.nan, 1e9], [1.0, -2.0], [0.0, 0.0]]]))
    expected = [[0.5, MAX_STATE_SD], [1.0, -2.0], [0.0, 0.0]]
    np.testing.assert_array_equal(estimated_states(asked, 0, before), expected)
    assert estimated_states(asked, 0, None) is None
    assert need_relinearising(before, np.zeros((3, 2)))
    assert not need_relinearising(before, before + 0.1)
    assert not need_relinearising(None, None)
