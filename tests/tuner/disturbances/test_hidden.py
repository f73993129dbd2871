"""What set-points hide is known as well as least squares knew it beside all the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.tuner.uncertainty import making
from tuner.disturbances.disturbances import MAX_STRENGTHS, MIN_STRENGTHS, STRENGTHS
from tuner.disturbances.predictor import (
    STRENGTH_PRIOR_SD,
    hidden_by_setpoints,
    with_hidden_coefficients,
    with_strengths,
)
from tuner.objective.information import FisherInformation, ResidualChange
from tuner.uncertainty.estimates import _shares
from tuner.vehicle import ControllerFile
from tuner.vehicle.model import model_of

NAMES = ("inertia_xx", "estimate_latency", "motor_constant", "moment_constant")
FITTED, HIDDEN = 3, 1
"""The last one is fixed: what is known of it does not count."""
UPSTREAM = np.arange(len(NAMES)) == HIDDEN


def looped() -> FisherInformation:
    """Return the information of two channels, three flights and four stretches."""
    rng = np.random.default_rng(0)
    rows = rng.standard_normal((2, 3, 4, 30, len(NAMES)))
    return FisherInformation(
        channels=("position", "body_rate"),
        flight=np.arange(3),
        blocks=np.einsum("cfbnp,cfbnq->cfbpq", rows, rows),
        score=rng.standard_normal((2, 3, 4, len(NAMES))),
        spread=np.ones((2, 3)),
        nuisance_prior=np.zeros((len(NAMES), len(NAMES))),
        prior=np.eye(len(NAMES)) * 0.1,
        crashed=np.zeros(3, bool),
        begins=np.zeros(3),
        scale=np.ones((2, 3)),
    )


def predicted() -> FisherInformation:
    """Return what innovations say: ten times as much, of the hidden one nothing."""
    found, sees = looped(), np.arange(len(NAMES)) != HIDDEN
    return replace(
        found, blocks=10.0 * found.blocks * np.outer(sees, sees), score=found.score * sees
    )


def test_its_error_is_that_of_least_squares_with_all_others_free():
    joined = with_hidden_coefficients(predicted(), looped(), UPSTREAM, FITTED)
    own = np.linalg.inv(joined.total[:FITTED, :FITTED])[HIDDEN, HIDDEN]
    beside = np.linalg.inv(looped().total[:FITTED, :FITTED])[HIDDEN, HIDDEN]
    # the prior of the others counts for a little of what they leave
    np.testing.assert_allclose(own, beside, rtol=0.01)


def test_what_innovations_say_of_the_others_stays():
    joined, others = with_hidden_coefficients(predicted(), looped(), UPSTREAM, FITTED), [0, 2, 3]
    np.testing.assert_array_equal(
        joined.blocks[..., others, :][..., others], predicted().blocks[..., others, :][..., others]
    )
    np.testing.assert_array_equal(joined.blocks[..., HIDDEN, others], 0.0)
    np.testing.assert_array_equal(joined.score[..., others], predicted().score[..., others])


@pytest.mark.parametrize("sees_markers", [False, True])
def test_a_loop_tells_how_high_markers_sit_if_it_does_not_see_them(sees_markers: bool) -> None:
    file = ControllerFile()
    file = file.replace(sensing=file.sensing.replace(sees_markers=sees_markers))
    names = ("inertia_xx", "estimate_latency", "marker_offset_x", "marker_offset_z")
    hidden = hidden_by_setpoints(names, model_of(making.vehicle_file(), file))
    assert hidden.tolist() == [False, True, False, not sees_markers]


def coupled_with_strengths(size: float) -> tuple[FisherInformation, FisherInformation, np.ndarray]:
    """Return information without and with strengths eliminated, and the whole covariance."""
    random, said, count = np.random.default_rng(1), looped(), len(STRENGTHS)
    nothing = np.zeros((1, 3, 1))
    across = {
        name: ResidualChange(5.0 * random.standard_normal((1, 3, 1, len(NAMES))), nothing, nothing)
        for name in STRENGTHS
    }
    coupling = size * random.standard_normal((count, len(NAMES)))
    learnt = with_strengths(
        replace(said, changes=across),
        100.0 * np.eye(count),
        0.5 * (MIN_STRENGTHS + MAX_STRENGTHS),
        coupling,
        len(NAMES),
    )
    both = np.array([across[name].gradient for name in STRENGTHS])
    own = (100.0 + STRENGTH_PRIOR_SD**-2) * np.eye(count)
    scatter = np.block([[said.total, both.T], [both, own]])
    slope = np.linalg.inv(np.block([[said.total, both.T], [both + coupling, own]]))
    return said, learnt, slope @ scatter @ slope.T


@pytest.mark.parametrize("size", [0.0, 30.0])
def test_errors_are_those_of_innovations_and_their_sizes_as_equations(size: float) -> None:
    _, learnt, covariance = coupled_with_strengths(size)
    known = covariance[: len(NAMES), : len(NAMES)]
    np.testing.assert_allclose(np.linalg.inv(learnt.total), known, rtol=1e-9, atol=1e-12)


def test_what_strengths_take_is_taken_from_the_flights_and_shares_still_add_up() -> None:
    """Nothing of it counts as the priors'."""
    said, learnt, _ = coupled_with_strengths(0.0)
    assert not learnt.changes
    error, wider = (np.sqrt(np.diag(np.linalg.inv(i.total))) for i in (said, learnt))
    assert (wider > error).all()
    assert (np.linalg.eigvalsh(learnt.prior + learnt.nuisance_prior) > 0.0).all()
    flights, priors = _shares(learnt, 3)
    np.testing.assert_allclose(flights.sum(axis=(0, 1)) + priors, 1.0)
    assert (priors > 0.0).all()
