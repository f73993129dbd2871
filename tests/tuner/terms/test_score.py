"""What a group is worth, on losses that are quadratic by construction."""

from dataclasses import replace

import numpy as np
import pytest

from tuner.terms.linearisation import LinearisedLoss, section_loss_ratio
from tuner.terms.model_averaging import selection_shifts
from tuner.terms.score import Score, _Gain, backward_elimination, chance_of_gusts, row_of, score
from tuner.vehicle.selection_table import SelectionCode

MODEL, FIRST, SECOND, COPY = (np.array([i]) for i in range(4))
FLIGHTS, STRETCHES, SAMPLES = 4, 12, 200


def linear_fit(*effects, seed=0, correlated=False, shown_by=FLIGHTS, gusts=False, alike=False):
    """Return the loss of straight regressions: each stretch has its own regressors.

    The truth moves the second column by the effect of each flight. Correlated residuals are
    constant over a stretch; gusts are, too, last for several, and are worst in a few, unless they
    are alike everywhere. Flights from ``shown_by`` on do not excite the second column.
    """
    random = np.random.default_rng(seed)
    gust = 0.0
    hessian, score_, loss = [], [], 0.0
    flight = np.repeat(np.arange(FLIGHTS), STRETCHES)
    for number in flight:
        columns = random.normal(size=(SAMPLES, 3)) + 1.0
        columns[:, 1] *= number < shown_by
        columns = np.column_stack([columns, columns[:, 0] * (1 + 1e-12)])
        noise = random.normal() if correlated else random.normal(size=SAMPLES)
        if gusts:
            gust = 0.6 * gust + random.normal()
            noise = noise + gust * (1.0 if alike else random.standard_gamma(0.5))
        residual = noise - columns[:, 1] * effects[number % len(effects)]
        hessian.append(columns.T @ columns)
        score_.append(columns.T @ residual)
        loss += 0.5 * float(residual @ residual)
    return LinearisedLoss(
        scaled=np.zeros(4),
        hessian=np.array(hessian),
        score=np.array(score_),
        prior=np.eye(4) * 1e-6,
        pull=np.zeros(4),
        prior_sd=np.full(4, 1e3),
        flight=flight,
        section=np.tile(np.arange(STRETCHES) * 3 // STRETCHES, FLIGHTS),
        loss=loss,
    )


def moved_to_minimum(linear, free):
    """Return the same loss about the minimum over some columns."""
    change = linear.step(free, inside=np.ones(len(linear.flight), bool))
    return replace(
        linear,
        scaled=change,
        score=linear.score + linear.hessian @ change,
        pull=linear.pull + linear.prior @ change,
        loss=linear.loss + linear.change_of_loss(change).sum(),
    )


def test_a_coefficient_that_is_not_seen_yet_hides_no_other_of_its_group():
    linear = linear_fit(0.5)
    hessian, gradient = linear.hessian.copy(), linear.score.copy()
    hessian[:, 3], hessian[:, :, 3], gradient[:, 3] = 0.0, 0.0, 0.0
    linear = replace(linear, hessian=hessian, score=gradient)
    both = np.array([*FIRST, 3])
    alone, beside = (score(linear, MODEL, group, candidates=2) for group in (FIRST, both))
    assert beside == alone
    assert beside.is_accepted
    idle = np.array([3])
    assert score(linear, MODEL, idle, candidates=2).reason is SelectionCode.NO_INFORMATION
    moves = [selection_shifts(linear, MODEL, [(group, 0.5)]) for group in (FIRST, both)]
    np.testing.assert_array_equal(*moves)


def test_a_term_of_the_truth_earns_its_place():
    first = score(linear_fit(0.5), MODEL, FIRST, candidates=2)
    assert first.reason is SelectionCode.PREDICTS_FLIGHTS
    assert first.gain_fit == pytest.approx(first.gain_holdout, rel=0.05)


@pytest.mark.parametrize(("size", "accepted"), [(0.1, True), (1.0, False)])
def test_a_term_that_the_voltmeters_errors_explain_is_not_significant(size, accepted):
    """They act in all stretches at once, so that no scatter between these shows them."""
    linear = linear_fit(0.5)
    follow = np.linalg.solve(linear.information()[:1, :1], linear.information()[:1, 1:2])
    read = size * linear.information()[1] * np.array([[1.0], [-1.0]])
    read[:, 0] += 100.0 * read[:, 1]
    read[:, 1:2] += 100.0 * read[:, 1:2] @ follow  # a change that the model takes up counts not
    found = score(replace(linear, readings=read), MODEL, FIRST, candidates=2)
    assert found.is_accepted is accepted
    assert found.gain_fit == score(linear, MODEL, FIRST, candidates=2).gain_fit


@pytest.mark.parametrize(("size", "accepted"), [(1.0, True), (0.1, False)])
def test_a_gain_of_a_likelihood_has_to_be_significant_by_itself(size, accepted):
    """However little it scatters: residuals of a tenth of the noise scatter as little."""
    linear = linear_fit(0.2)
    little = replace(linear, score=size * linear.score, loss=size**2 * linear.loss)
    assert score(little, MODEL, FIRST, candidates=2).is_accepted
    assert score(little, MODEL, FIRST, candidates=2, white=True).is_accepted is accepted
    columns = {"first": FIRST}
    inside = moved_to_minimum(little, np.concatenate([MODEL, FIRST]))
    kept, _ = backward_elimination(inside, MODEL, columns, candidates=2, white=True)
    assert bool(kept) is accepted


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("correlated", [False, True])
def test_noise_buys_no_term_even_where_it_is_correlated_in_time(seed, correlated):
    linear = linear_fit(0.0, seed=seed, correlated=correlated)
    for group in (FIRST, SECOND):
        assert not score(linear, MODEL, group, candidates=2).is_accepted


@pytest.mark.parametrize("shown_by", [1, FLIGHTS])
def test_gusts_that_last_buy_a_term_no_more_often_than_chance_is_let(shown_by):
    fits = [linear_fit(0.0, seed=seed, gusts=True, shown_by=shown_by) for seed in range(200)]
    both = np.concatenate([FIRST, SECOND])
    bought = [score(linear, MODEL, both, candidates=1).is_accepted for linear in fits]
    assert np.mean(bought) <= 0.02


def test_insignificant_groups_are_removed_before_significant_ones(monkeypatch):
    """Whichever predicts more by chance: a flight that alone shows something is a poor judge."""

    def scored(_, others, columns, **__):
        alone = len(others) == len(MODEL)
        reason = SelectionCode.PREDICTS_FLIGHTS if alone else SelectionCode.NOT_PREDICTED
        gain, chance = (0.15, 1e-20) if columns is FIRST else (0.2, 1e-4)
        return Score(0.1, gain, 0.1, chance, reason)

    monkeypatch.setattr("tuner.terms.score.score", scored)
    groups = {"first": FIRST, "second": SECOND}
    kept, taken = backward_elimination(linear_fit(0.0), MODEL, groups, candidates=2)
    assert (list(kept), list(taken)) == (["first"], ["second"])


def test_beside_a_group_without_gain_no_other_is_removed(monkeypatch):
    """Whatever chance says of it there: it is judged once the fit is without the others."""

    def scored(_, __, columns, **___):
        if columns is FIRST:
            return Score(1e-3, 0.0, 0.1, 0.5, SelectionCode.IMMATERIAL)
        return Score(0.5, 0.4, 0.1, 1.0, SelectionCode.NOT_SIGNIFICANT)

    monkeypatch.setattr("tuner.terms.score.score", scored)
    of = {"candidates": 2}
    kept, taken = backward_elimination(
        linear_fit(0.0), MODEL, {"first": FIRST, "second": SECOND}, **of
    )
    assert (list(kept), list(taken)) == (["second"], ["first"])
    kept, taken = backward_elimination(linear_fit(0.0), MODEL, {"second": SECOND}, **of)
    assert (list(kept), list(taken)) == ([], ["second"])
    # what stands in for others goes all the same, and before all
    groups = {"first": FIRST, "second": SECOND}
    kept, taken = backward_elimination(linear_fit(0.0), MODEL, groups, **of, lumped=["second"])
    assert list(taken) == ["second", "first"]


def test_backward_elimination_leaves_the_term_of_the_truth_at_the_fit_with_both():
    linear = moved_to_minimum(linear_fit(0.5), np.concatenate([MODEL, FIRST, SECOND]))
    kept, taken = backward_elimination(
        linear,
        MODEL,
        {"first": FIRST, "second": SECOND},
        candidates=2,
    )
    assert (list(kept), list(taken)) == (["first"], ["second"])


@pytest.mark.parametrize("stand_in", ["first", "copy"])
def test_of_two_equivalent_groups_the_lumped_one_is_removed(stand_in):
    linear = moved_to_minimum(linear_fit(0.5), FIRST)
    twin = replace(linear, **_with_a_twin(linear))
    kept, taken = backward_elimination(
        twin,
        np.array([0]),
        {"first": FIRST, "copy": np.array([len(linear.scaled)])},
        candidates=2,
        lumped=[stand_in],
    )
    assert list(taken) == [stand_in]
    assert len(kept) == 1


def test_of_two_groups_that_replace_each_other_the_larger_is_removed(monkeypatch):
    """Noise would choose between them: the larger seems the more significant here."""

    def scored(_, others, columns, **__):
        beside_the_other = len(others) > len(MODEL)
        reason = SelectionCode.NOT_SIGNIFICANT if beside_the_other else needed
        return Score(0.1, 0.1, 0.1, 0.3 if columns is FIRST else 0.2, reason)

    monkeypatch.setattr("tuner.terms.score.score", scored)
    groups = {"first": FIRST, "two": np.concatenate([SECOND, COPY])}
    of = {"candidates": 2, "without_refits": True}
    needed = SelectionCode.PREDICTS_FLIGHTS
    kept, taken = backward_elimination(linear_fit(0.0), MODEL, groups, **of)
    assert (list(kept), list(taken)) == (["first"], ["two"])
    needed = SelectionCode.NOT_SIGNIFICANT  # neither replaces anything
    kept, taken = backward_elimination(linear_fit(0.0), MODEL, groups, **of)
    assert (list(kept), list(taken)) == ([], ["first", "two"])


def test_a_larger_group_stays_that_a_smaller_one_replaces_in_part(monkeypatch):
    def scored(_, others, columns, **__):
        beside_the_other = len(others) > len(MODEL)
        suffices = columns is not FIRST and not beside_the_other
        reason = SelectionCode.PREDICTS_FLIGHTS if suffices else SelectionCode.NOT_SIGNIFICANT
        return Score(0.1, 0.1, 0.1, 0.3 if columns is FIRST else 0.2, reason)

    monkeypatch.setattr("tuner.terms.score.score", scored)
    groups = {"first": FIRST, "two": np.concatenate([SECOND, COPY])}
    kept, taken = backward_elimination(
        linear_fit(0.0), MODEL, groups, candidates=2, without_refits=True
    )
    assert (list(kept), list(taken)) == (["two"], ["first"])


def _with_a_twin(linear):
    """Return the fields of a loss in which one more coefficient does what the first term does."""
    (first,) = FIRST
    columns = [*range(len(linear.scaled)), first]
    prior = linear.prior[np.ix_(columns, columns)] * np.eye(len(columns))
    return {
        "scaled": linear.scaled[columns],
        "hessian": linear.hessian[:, columns][:, :, columns],
        "score": linear.score[:, columns],
        "prior": prior + 1e-3 * np.eye(len(columns)),
        "pull": linear.pull[columns],
    }


def test_a_term_that_flights_disagree_about_lowers_the_loss_and_is_not_added():
    found = score(linear_fit(1.0, 0.0, 0.0, 0.0), MODEL, FIRST, candidates=1)
    assert found.gain_fit > 0.01 > found.gain_holdout
    assert not found.is_accepted


def test_a_term_that_one_flight_alone_shows_is_predicted_by_sections():
    linear = linear_fit(0.5, shown_by=1)
    found = score(linear, MODEL, FIRST, candidates=1)
    assert found.reason is SelectionCode.PREDICTS_SECTIONS


def alone(linear, number=0):
    """Return the loss of one flight of some, without the others."""
    own = linear.flight == number
    seen = None if linear.columns_seen is None else linear.columns_seen[own]
    parts = {name: getattr(linear, name)[own] for name in ("hessian", "score", "section")}
    return replace(
        linear, **parts, flight=linear.flight[own], columns_seen=seen, loss=linear.loss / 4
    )


def test_a_flight_that_is_alone_predicts_itself_section_by_section():
    found = score(alone(linear_fit(0.5)), MODEL, FIRST, candidates=14)
    assert found.reason is SelectionCode.PREDICTS_SECTIONS
    assert found.gain_holdout == pytest.approx(found.gain_fit, rel=0.2)
    both = np.concatenate([MODEL, FIRST])
    inside = score(
        moved_to_minimum(alone(linear_fit(0.5)), both),
        MODEL,
        FIRST,
        candidates=14,
        inside=True,
    )
    assert inside.reason is SelectionCode.PREDICTS_SECTIONS


@pytest.mark.parametrize("given", [{}, {"correlated": True}, {"gusts": True}])
def test_a_flight_that_is_alone_is_bought_a_term_no_more_often_than_chance_is_let(given):
    both, bought = np.concatenate([MODEL, FIRST]), []
    for seed in range(200):
        linear = alone(linear_fit(0.0, seed=seed, **given))
        after = moved_to_minimum(linear, both)
        found = score(linear, MODEL, FIRST, candidates=1)
        stayed = score(after, MODEL, FIRST, candidates=1, inside=True)
        bought.append((found.is_accepted, stayed.is_accepted))
    assert np.mean(bought) <= 0.01


def test_a_condition_of_a_single_flight_must_exceed_its_gusts(monkeypatch):
    """Its column is no term of the vehicle's, though all stretches see it."""
    own = replace(alone(by_flight(linear_fit(0.5), 1)), condition_columns=FLIGHTS)
    group = np.array([3])
    assert score(own, MODEL, group, candidates=1).reason is SelectionCode.PREDICTS_SECTIONS
    monkeypatch.setattr("tuner.terms.score.chance_of_gusts", lambda *_: 0.5)
    assert score(own, MODEL, group, candidates=1).reason is SelectionCode.NOT_SIGNIFICANT


def test_sections_of_a_flight_that_is_alone_are_met_worse_by_fits_without_them():
    linear = alone(linear_fit(0.0))
    fitted = moved_to_minimum(linear, np.concatenate([MODEL, FIRST]))
    lost = [section_loss_ratio(fitted, free) for free in (MODEL, np.concatenate([MODEL, FIRST]))]
    assert 1.0 < lost[0] < lost[1] < 1.1


def test_a_term_that_a_coefficient_of_the_model_copies_is_not_distinguished():
    found = score(linear_fit(0.5), MODEL, COPY, candidates=1)
    assert found.reason is SelectionCode.NO_INFORMATION


def test_the_gain_of_a_term_in_the_model_is_the_loss_without_it():
    before = linear_fit(0.5)
    added = score(before, MODEL, FIRST, candidates=1)
    after = moved_to_minimum(before, np.concatenate([MODEL, FIRST]))
    inside = score(after, MODEL, FIRST, candidates=1, inside=True)
    assert inside.gain_fit == pytest.approx(added.gain_fit, rel=1e-6)
    assert inside.gain_holdout == pytest.approx(added.gain_holdout, rel=1e-6)
    assert inside.is_accepted


def test_a_term_in_the_model_stays_where_held_out_flights_disagree():
    """Flights that show it unequally, in gusts: chance does not explain it, nor do they predict."""
    before = linear_fit(0.8, 0.0, 0.8, 0.4, seed=14, gusts=True)
    assert score(before, MODEL, FIRST, candidates=1).reason is SelectionCode.NOT_PREDICTED
    after = moved_to_minimum(before, np.concatenate([MODEL, FIRST]))
    inside = score(after, MODEL, FIRST, candidates=1, inside=True)
    assert inside.reason is SelectionCode.SIGNIFICANT
    assert inside.is_accepted
    shared = score(after, MODEL, FIRST, candidates=10, inside=True)
    assert shared.reason is SelectionCode.NOT_SIGNIFICANT


def test_a_gust_cannot_imitate_a_term_that_reads_a_recorded_signal():
    """One flight shows it, in gusts that are worst in one of its sections."""
    both = np.concatenate([MODEL, FIRST])
    after = moved_to_minimum(linear_fit(0.8, seed=6, gusts=True, shown_by=1), both)
    groups, of = {"first": FIRST}, {"candidates": 14}
    kept, taken = backward_elimination(after, MODEL, groups, **of)
    assert not kept
    assert taken["first"].reason is SelectionCode.NOT_SIGNIFICANT
    kept, taken = backward_elimination(after, MODEL, groups, **of, excluding_gusts=["first"])
    assert not taken
    assert kept["first"].reason is SelectionCode.PREDICTS_SECTIONS
    assert kept["first"].chance < 1e-5


@pytest.mark.parametrize(("shown_by", "seed"), [(2, 33), (FLIGHTS, 14)])
def test_a_term_that_all_sections_call_for_stays_though_few_stretches_scatter(shown_by, seed):
    """Gusts make a few stretches scatter most; the others see it as surely."""
    both = np.concatenate([MODEL, FIRST])
    after = moved_to_minimum(linear_fit(0.8, seed=seed, gusts=True, shown_by=shown_by), both)
    found = score(after, MODEL, FIRST, candidates=14, inside=True)
    assert found.is_accepted
    assert found.chance < 1e-9


def test_gusts_let_a_term_stay_whose_signal_was_recorded_hardly_more_often():
    """Of neutral terms in the model: one in two hundred, where one in fourteen hundred was let."""
    both, stayed = np.concatenate([MODEL, FIRST]), []
    for seed in range(200):
        after = moved_to_minimum(linear_fit(0.0, seed=seed, gusts=True), both)
        found = score(after, MODEL, FIRST, candidates=14, inside=True, excludes_gusts=True)
        stayed.append(found.is_accepted)
    assert np.mean(stayed) <= 0.01


@pytest.mark.parametrize(
    ("gains", "stays"), [((0.5, 0.5, 0.5, -4), True), ((-1, -1, -2, 0), False)]
)
def test_one_flight_that_the_others_predict_badly_takes_no_term_away(monkeypatch, gains, stays):
    """All of its stretches lose by one error, that of the fit to the others."""
    after = moved_to_minimum(linear_fit(0.8), np.concatenate([MODEL, FIRST]))
    lost = np.repeat(gains, STRETCHES) * 0.002 * after.loss / STRETCHES
    held_out = _Gain(lost, np.full(len(lost), after.loss / len(lost)))
    monkeypatch.setattr("tuner.terms.score._held_out", lambda *_: held_out)
    outside = score(linear_fit(0.8), MODEL, FIRST, candidates=1)
    assert outside.reason is SelectionCode.NOT_PREDICTED
    inside = score(after, MODEL, FIRST, candidates=1, inside=True)
    assert inside.is_accepted is stays


def by_flight(linear, column):
    """Return the same loss seen by a column of its own for each flight in the place of one."""
    others = np.delete(np.arange(4), column)
    order = np.append(others, column)
    wide = len(others) + FLIGHTS
    return replace(
        linear,
        scaled=np.zeros(wide),
        hessian=linear.hessian[:, order][:, :, order],
        score=linear.score[:, order],
        prior=np.eye(wide) * 1e-6,
        pull=np.zeros(wide),
        columns_seen=np.column_stack(
            [np.tile(np.arange(len(others)), (len(linear.flight), 1)), 3 + linear.flight]
        ),
    )


def test_the_p_value_of_flights_that_differ_by_noise_alone_is_uniform():
    begin, group = np.zeros(3 + FLIGHTS), np.arange(3, 3 + FLIGHTS)
    fits = (by_flight(linear_fit(0.0, seed=seed), 1) for seed in range(200))
    chances = np.array([chance_of_gusts(fit, MODEL, group, begin) for fit in fits])
    for level in (0.1, 0.2, 0.5):
        assert np.mean(chances < level) == pytest.approx(level, abs=0.07)


def test_longer_stretches_have_the_given_length_and_the_same_sum():
    linear = linear_fit(0.5)
    longer = linear.stretches(FIRST, np.zeros(4), 8.0)
    assert longer.score.shape == (3 * FLIGHTS, 1)  # of twelve times two seconds
    np.testing.assert_allclose(longer.score.sum(axis=0), linear.score.sum(axis=0)[FIRST])
    whole = linear.information()[np.ix_(FIRST, FIRST)]
    np.testing.assert_allclose(longer.information.sum(axis=0), whole)


def dense(linear):
    """Return the same loss where every stretch sees every column, most of them for nothing."""
    count, wide = len(linear.flight), len(linear.scaled)
    hessian, slope = np.zeros((count, wide, wide)), np.zeros((count, wide))
    for number, seen in enumerate(linear.columns_seen):
        hessian[number][np.ix_(seen, seen)] = linear.hessian[number]
        slope[number, seen] = linear.score[number]
    return replace(linear, hessian=hessian, score=slope, columns_seen=None)


def test_columns_that_one_flight_sees_are_columns_like_others():
    own = by_flight(linear_fit(0.5, -0.3, 0.0, 0.2), 1)
    group, inside = 3 + np.arange(FLIGHTS), own.flight != 1
    step = own.step(np.concatenate([MODEL, group]), inside=inside)
    np.testing.assert_allclose(
        step, dense(own).step(np.concatenate([MODEL, group]), inside=inside), rtol=1e-12
    )
    assert step[3 + 1] == 0.0
    np.testing.assert_allclose(own.change_of_loss(step), dense(own).change_of_loss(step))
    found, wanted = (score(one, MODEL, group, candidates=2) for one in (own, dense(own)))
    assert found.reason is SelectionCode.PREDICTS_SECTIONS
    assert found.gain_fit == pytest.approx(wanted.gain_fit, rel=1e-6)
    assert max(found.chance, wanted.chance) < 1e-10


def test_flights_show_conditions_of_any_strength():
    """One flight shows a hundred times more than another: sections of both are predicted."""
    own = by_flight(linear_fit(5.0, -0.5, 0.5, -0.5), 1)
    found = score(own, MODEL, 3 + np.arange(FLIGHTS), candidates=2)
    assert found.reason is SelectionCode.PREDICTS_SECTIONS


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("correlated", [False, True])
def test_noise_buys_no_column_for_each_flight(seed, correlated):
    own = by_flight(linear_fit(0.0, seed=seed, correlated=correlated), 1)
    assert not score(own, MODEL, 3 + np.arange(FLIGHTS), candidates=2).is_accepted


@pytest.mark.parametrize(
    ("found", "kept", "reason"),
    [
        (SelectionCode.PREDICTS_FLIGHTS, True, SelectionCode.PREDICTS_FLIGHTS),
        (SelectionCode.PREDICTS_FLIGHTS, False, SelectionCode.WORSE_AFTER_REFIT),
        (SelectionCode.IMMATERIAL, False, SelectionCode.IMMATERIAL),
    ],
)
def test_the_table_does_not_call_omitted_groups_predictive(found, kept, reason):
    """A group may earn its place beside one fit, and not hold it beside what came with it."""
    worth = Score(0.1, 0.1, 0.01, 1e-6, found)
    assert row_of("drag", ("drag_x",), worth, kept=kept).reason is reason
    given = row_of("drag", ("drag_x",), worth, SelectionCode.NOT_SIGNIFICANT, kept=kept)
    assert given.reason is SelectionCode.NOT_SIGNIFICANT
