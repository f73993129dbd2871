"""What terms that are not in a model may do to it, on losses that are quadratic by construction."""

from dataclasses import replace

import numpy as np
import pytest

from tuner.terms.candidates import prior_presence_of
from tuner.terms.linearisation import LinearisedLoss
from tuner.terms.model_averaging import Evidence, selection_shifts

MODEL, TERM = np.array([0]), np.array([1])
PRESENT = (TERM, 1.0)
"""A term that is there, however small."""
FLIGHTS, STRETCHES, SAMPLES = 4, 12, 50
LIKE = 0.95
"""Correlation of what the term does with what the model does."""
USUAL = 5.0
"""Usual size of the term, in standard errors of an estimate of it."""
DRAWS = 200


def flown(random, usual=USUAL):
    """Return the loss of regressions on two columns that are much alike, the truth at zero.

    Residuals wander with gusts that last for a stretch. The term's unit is the standard error of
    an estimate of it.
    """
    shared = random.normal(size=(FLIGHTS * STRETCHES, SAMPLES, 1))
    own = random.normal(size=(FLIGHTS * STRETCHES, SAMPLES, 2))
    columns = np.sqrt(LIKE) * shared + np.sqrt(1.0 - LIKE) * own + 0.5 * random.normal(size=2)
    hessian = columns.transpose(0, 2, 1) @ columns
    gust = random.normal(size=FLIGHTS * STRETCHES)
    residual = random.normal(size=shared.shape[:2]) + gust[:, None]
    score = np.einsum("sip,si->sp", columns, residual)
    inverse = np.linalg.inv(hessian.sum(axis=0))
    meat = np.einsum("sp,sq->pq", columns.sum(axis=1), columns.sum(axis=1)) + hessian.sum(axis=0)
    errors = np.sqrt(np.diag(inverse @ meat @ inverse))
    unit = np.array([1.0, errors[1]])
    linear = LinearisedLoss(
        scaled=np.zeros(2),
        hessian=hessian * np.outer(unit, unit),
        score=score * unit,
        prior=np.diag([1e-6, usual**-2]),
        pull=np.zeros(2),
        prior_sd=np.array([1e3, usual]),
        flight=np.repeat(np.arange(FLIGHTS), STRETCHES),
        section=np.tile(np.arange(STRETCHES) * 3 // STRETCHES, FLIGHTS),
        loss=0.5 * float(np.sum(residual**2)),
    )
    across = columns[..., :1].transpose(0, 2, 1) @ columns[..., :1]
    alone = np.sqrt((columns[..., 0].sum(axis=1) ** 2).sum() + across.sum()) / across.sum()
    return linear, alone


def with_term(linear, size):
    """Return the loss of flights that had the term, about the point where the model has none."""
    return replace(linear, score=linear.score - size * linear.hessian[..., 1])


@pytest.fixture(scope="module")
def fits():
    random = np.random.default_rng(1)
    return [flown(random) for _ in range(DRAWS)]


def share(fits, size, *, with_part):
    """Return how often the model's 95 % interval holds the truth while a term is missing."""
    held = []
    for linear, alone in fits:
        fit = with_term(linear, size)
        off = fit.step(MODEL, inside=np.ones(len(fit.flight), bool))[0]
        error = np.hypot(alone, selection_shifts(fit, MODEL, [PRESENT])[0] if with_part else 0.0)
        held.append(abs(off) < 1.96 * error)
    return np.mean(held)


@pytest.mark.parametrize("size", [0.0, 1.0, 2.0, 3.0, 4.0])
def test_a_term_too_small_to_be_added_is_covered_whatever_its_size(fits, size):
    assert share(fits, size, with_part=True) > 0.84
    if size >= 2.0:
        assert share(fits, size, with_part=False) < 0.2


def test_the_ground_is_there_for_every_vehicle_and_stand_ins_are_seldom_needed():
    assert prior_presence_of(["ground_effect"]) == 1.0
    assert prior_presence_of(["linear_drag_x"]) < prior_presence_of(["fuselage_drag"]) < 1.0


def test_over_vehicles_of_which_half_have_the_term_in_some_size_intervals_hold(fits):
    """As a priori: absent or, as likely small as large, from what is as good as absent on."""
    random, presence = np.random.default_rng(6), prior_presence_of(["flapping_moment_coefficient"])
    held, parts = [], []
    for linear, alone in fits:
        there = random.random() < presence
        size = np.exp(random.uniform(np.log(0.4), np.log(USUAL))) if there else 0.0
        fit = with_term(linear, size)
        off = fit.step(MODEL, inside=np.ones(len(fit.flight), bool))[0]
        part = selection_shifts(fit, MODEL, [(TERM, presence)])[0]
        held.append([abs(off) < 1.96 * error for error in (alone, np.hypot(alone, part))])
        parts.append(part / selection_shifts(fit, MODEL, [PRESENT])[0])
    without, with_part = np.mean(held, axis=0)
    assert without < 0.75
    assert with_part > 0.91
    assert np.median(parts) < 0.9


def test_where_flights_say_little_of_a_term_chance_counts_for_less_than_a_refit_would_move():
    random = np.random.default_rng(2)
    parts, steps = [], []
    for linear, _ in (flown(random, usual=1.0) for _ in range(DRAWS)):
        every = np.ones(len(linear.flight), bool)
        moved = linear.step(np.array([0, 1]), inside=every) - linear.step(MODEL, inside=every)
        steps.append(moved[0] ** 2)
        parts.append(selection_shifts(linear, MODEL, [PRESENT])[0] ** 2)
    assert np.sqrt(np.mean(parts)) < 0.6 * np.sqrt(np.mean(steps))


def test_a_significant_omitted_term_shifts_in_full(fits):
    for linear, _ in fits[:20]:
        fit = with_term(replace(linear, prior_sd=np.array([1e3, 30.0])), 12.0)
        every = np.ones(len(fit.flight), bool)
        moved = fit.step(np.array([0, 1]), inside=every) - fit.step(MODEL, inside=every)
        assert selection_shifts(fit, MODEL, [PRESENT])[0] == pytest.approx(abs(moved[0]), rel=0.15)


def test_an_improbable_term_shifts_less_and_in_full_where_it_is_significant(fits):
    seldom = (TERM, 0.1)
    absent = [[selection_shifts(fit, MODEL, [g])[0] for g in (seldom, PRESENT)] for fit, _ in fits]
    assert np.median([one / other for one, other in absent]) < 0.4
    for linear, _ in fits[:20]:
        fit = with_term(replace(linear, prior_sd=np.array([1e3, 30.0])), 12.0)
        called_for = [selection_shifts(fit, MODEL, [group])[0] for group in (seldom, PRESENT)]
        assert called_for[0] == pytest.approx(called_for[1], rel=1e-3)


def test_a_term_collinear_with_the_model_shifts_by_its_prior(fits):
    """The flights leave it to the prior: as likely small as large, up to the usual size."""
    linear, _ = fits[0]
    same = replace(
        linear,
        hessian=linear.hessian[:, :1, :1] * np.ones((2, 2)),
        score=linear.score[:, :1] * np.ones(2),
    )
    sizes = np.exp(np.linspace(np.log(0.1), 0.0, 25))
    expected = USUAL * np.sqrt(np.mean(sizes**2))
    assert selection_shifts(same, MODEL, [PRESENT])[0] == pytest.approx(expected, rel=0.05)


def crowded(random, count, absent=1):
    """Return a loss of many columns and some that are absent, from a minute in gusts of seconds."""
    size, shape = count + absent, (3 * 9, 40)
    columns = random.normal(size=(*shape, size)) + random.normal(size=(shape[0], 1, size))
    gusts = np.zeros(shape[0])
    for stretch in range(shape[0]):
        before = gusts[stretch - 1] if stretch % 9 else random.normal()
        gusts[stretch] = 0.5 * before + np.sqrt(0.75) * random.normal()
    residual = random.normal(size=shape) + 2.0 * gusts[:, None]
    return LinearisedLoss(
        scaled=np.zeros(size),
        hessian=columns.transpose(0, 2, 1) @ columns,
        score=np.einsum("sip,si->sp", columns, residual),
        prior=np.diag([*[1e-9] * count, *[1.0] * absent]),
        pull=np.zeros(size),
        prior_sd=np.array([*[1e3] * count, *[1.0] * absent]),
        flight=np.repeat(np.arange(3), 9),
        section=np.tile(np.repeat(np.arange(3), 3), 3),
        loss=1.0,
    )


@pytest.mark.parametrize("count", [3, 20])
def test_the_evidence_of_an_absent_term_includes_gusts_that_the_fit_absorbed(count):
    random, model, term = np.random.default_rng(3), np.arange(count), np.array([count])
    held = []
    for linear in (crowded(random, count) for _ in range(DRAWS)):
        square = linear.information() + linear.prior
        alone = linear.step(model, inside=np.ones(len(linear.flight), bool))
        found = Evidence.of(linear, square, alone, model, term)
        held.append(abs(found.value[0]) < 1.96 * np.sqrt(found.variance[0]))
    assert np.mean(held) > 0.86  # 0.79 were twenty coefficients' leverage not allowed for


def test_no_axis_of_a_group_is_too_certain_by_the_scatter_of_a_few_stretches():
    """Six stretches of time always scatter little along some axis of six."""
    random, model, group = np.random.default_rng(5), np.arange(4), np.arange(4, 10)
    sizes = []
    for linear in (crowded(random, 4, absent=6) for _ in range(DRAWS)):
        square = linear.information() + linear.prior
        alone = linear.step(model, inside=np.ones(len(linear.flight), bool))
        found = Evidence.of(linear, square, alone, model, group)
        sizes.append(np.sort(np.abs(found.value) / np.sqrt(found.variance))[-1])
    assert np.median(sizes) < 2.5  # 1.6 of six normal ones


def test_groups_add_up_as_squares(fits):
    linear, _ = fits[1]
    one, both = (
        selection_shifts(linear, MODEL, [PRESENT])[0],
        selection_shifts(linear, MODEL, [PRESENT, PRESENT])[0],
    )
    assert both == pytest.approx(np.sqrt(2.0) * one)
    assert selection_shifts(linear, MODEL, [])[0] == 0.0


@pytest.mark.parametrize("said", [0.0, 1e-30])
def test_a_term_of_which_the_flights_say_nothing_changes_nothing(said):
    linear, _ = flown(np.random.default_rng(4))
    mute = np.diag([1.0, np.sqrt(said)])
    linear = replace(linear, hessian=mute @ linear.hessian @ mute, score=linear.score @ mute)
    assert selection_shifts(linear, MODEL, [PRESENT]) == pytest.approx([0.0, 0.0], abs=1e-9)
