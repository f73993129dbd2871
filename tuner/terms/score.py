"""The score of a group of terms: its gain in the fit, its significance, its gain in held-out data.

`score` tests one group beside a model, `backward_elimination` eliminates groups backwards.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc, fdtrc  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import Array, scaled_solve, symmetric_eigen, unit_diagonal
from tuner.objective.information import BLOCK_S
from tuner.search.continuation import RIDGE
from tuner.terms.linearisation import FLIGHT_SECTIONS, Columns, LinearisedLoss
from tuner.uncertainty.covariance import STRETCH_S
from tuner.uncertainty.estimates import STUDENT_FACTOR
from tuner.vehicle.selection_table import SelectionCode, SelectionRow


def chance_of_gusts(linear: LinearisedLoss, model: Columns, group: Columns, begin: Array) -> float:
    """Return the probability of such per-flight values if they are means of gusts.

    Gusts have a mean over a flight. A flight's own columns take that mean out of the residuals,
    which then no longer show how far such means scatter: wind is found that no other flight would
    meet. Their scatter is seen within flights, where each section gets columns of its own. The
    gain per column of those of flights is compared with that of those of sections beside them: a
    nested analysis of variance (Scheffé, "The analysis of variance", 1959, ch. 5), whose ratio has
    Snedecor's F distribution if sections are independent.

    Parameters
    ----------
    linear
        The loss about the point.
    model
        Columns of the coefficients in the model, without the group's.
    group
        Columns for each flight.
    begin
        (P,) change that leads the group to its neutral values.
    """
    sections = _sections(linear.flight)
    cut = _with_columns_for(linear, np.flatnonzero(np.isin(linear.columns[0], group)), sections)
    of_sections = np.arange(len(linear.scaled), len(cut.scaled))
    freedom = len(of_sections) - len(group)
    if freedom < 1:
        return 1.0
    at = np.pad(begin, (0, len(of_sections)))
    alone, with_flights, with_sections = (
        float(cut.change_of_loss(cut.step(free, from_=at)).sum())
        for free in (model, np.append(model, group), np.append(model, of_sections))
    )
    between = (alone - with_flights) / len(group)
    within = (with_flights - with_sections) / freedom
    return float(fdtrc(len(group), freedom, max(between / max(within, 1e-300), 0.0)))


def _sections(flight: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the section number of each stretch (S,), unique over flights.

    A section is a third of its flight, or eight seconds of a long one.
    """
    numbers, count = np.empty(len(flight), np.intp), 0
    for own in np.unique(flight):
        stretches = np.flatnonzero(flight == own)
        many = max(FLIGHT_SECTIONS, round(len(stretches) * BLOCK_S / STRETCH_S))
        for part in np.array_split(stretches, min(many, len(stretches))):
            numbers[part] = count
            count += 1
    return numbers


def _with_columns_for(
    linear: LinearisedLoss, own: NDArray[np.intp], sections: NDArray[np.intp]
) -> LinearisedLoss:
    """Return the same loss with columns for each section, behind all others.

    Each section counts as a flight then. ``own`` are the columns of a stretch that are doubled.
    """
    seen, size, count = linear.columns, len(linear.scaled), sections.max() + 1
    local = np.append(np.arange(seen.shape[1]), own)
    columns = size + sections[:, None] * len(own) + np.arange(len(own))
    more = count * len(own)
    prior = np.zeros((size + more, size + more))
    prior[:size, :size] = linear.prior
    prior[range(size, size + more), range(size, size + more)] = np.tile(
        np.diag(linear.prior)[seen[0, own]], count
    )
    return replace(
        linear,
        scaled=np.pad(linear.scaled, (0, more)),
        hessian=linear.hessian[:, local][:, :, local],
        score=linear.score[:, local],
        prior=prior,
        pull=np.pad(linear.pull, (0, more)),
        prior_sd=np.append(linear.prior_sd, np.tile(linear.prior_sd[seen[0, own]], count)),
        flight=sections,
        columns_seen=np.hstack([seen, columns]),
    )


SIGNIFICANCE = 0.01
"""Probability of adding any term by chance, over all candidates together (Bonferroni)."""
MIN_GAIN = 0.01
"""Share of the loss below which a gain is no evidence: simulators of a vehicle differ by more."""
MIN_FLIGHT_LOSS_SHARE = 1e-6
"""Least share of the loss of one flight where flights have equal weights: avoids division by 0."""
MIN_GAIN_SD = 2.0
"""Standard deviations by which held-out data must be predicted better: the usual 95 %."""
CORRELATED_STRETCHES = 2
"""Lags, in stretches, up to which residuals count as correlated: gusts in a loop fade within."""
ACCEPTED = (
    SelectionCode.PREDICTS_FLIGHTS,
    SelectionCode.PREDICTS_SECTIONS,
    SelectionCode.SIGNIFICANT,
    SelectionCode.PREDICTS_SAMPLES,
)
NO_COLUMNS = np.empty(0, np.intp)
MIN_OWN_INFORMATION = 1e-8
"""Least share of a group's information that the model's coefficients do not explain."""


@dataclass(frozen=True)
class Score:
    """The gains of a group beside a model, as shares of the loss, and its significance.

    Attributes
    ----------
    gain_fit
        Gain in the loss of the fit, in one linear step.
    gain_holdout, scatter
        Gain in the loss of held-out data by linear fits to the rest, and its standard deviation
        over stretches.
    chance
        p-value: probability of such a score if the group's coefficients were neutral (Hotelling's
        T² of the stretches' scores, robust to correlation in time).
    reason
        Why the group is accepted or rejected.
    """

    gain_fit: float
    gain_holdout: float
    scatter: float
    chance: float
    reason: SelectionCode

    @property
    def is_accepted(self) -> bool:
        """Whether the group may stay in the model, or be added."""
        return self.reason in ACCEPTED


def row_of(
    group: str,
    names: tuple[str, ...],
    found: Score,
    reason: SelectionCode | None = None,
    *,
    kept: bool,
) -> SelectionRow:
    """Return the table row of a group; ``reason`` overrides the score's."""
    if not kept and found.is_accepted:
        reason = reason or SelectionCode.WORSE_AFTER_REFIT
    return SelectionRow(
        group=group,
        names=names,
        gain_fit=found.gain_fit,
        gain_holdout=found.gain_holdout,
        scatter=found.scatter,
        kept=kept,
        reason=reason or found.reason,
    )


def score(
    linear: LinearisedLoss,
    model: Columns,
    group: Columns,
    *,
    candidates: int,
    inside: bool = False,
    dropped: Columns = NO_COLUMNS,
    excludes_gusts: bool = False,
    min_gain: float = MIN_GAIN,
    white: bool = False,
) -> Score:
    """Return the score of a group beside a model.

    A group outside the model must predict held-out data. A group in the model stays where it is
    significant and no held-out data contradict it: fits without the flight that shows it best
    predict little. All stretches of a held-out flight share one error, that of the fit to the
    others; so the scatter over flights, not stretches, decides whether they contradict it.

    A group with columns for each flight cannot be predicted by other flights: sections of the same
    flight predict it, all flights have equal weights, and its values have to differ between flights
    by more than gusts explain (`chance_of_gusts`). A single flight, too, is predicted by sections.

    A coefficient that acts only beside another of its group is not seen where both are neutral: the
    others are tested without it.

    Where only sections, or no flights significantly, support a group, one gust during a manoeuvre
    might imitate it; so it must be significant whichever section is left out. This does not apply
    to laws that read a recorded signal.

    Parameters
    ----------
    linear
        The loss about the point.
    model
        Columns of the coefficients in the model, without the group's.
    group
        Columns of the group.
    candidates
        Number of groups tested, which share the level of significance.
    inside
        Whether the group is in the model: the point has its fitted values, not neutral ones.
    dropped
        Columns that go to their neutral values both with the group and without it.
    excludes_gusts
        Whether no gust can imitate the group: its law reads a recorded signal, or the residuals of
        the fit with it are at the noise level.
    min_gain
        Share of the loss below which a gain is no evidence.
    white
        Whether the loss is the negative log-likelihood of white innovations: twice the gain then
        has a χ² distribution by chance (Wilks 1938), and has to be significant by that, too. The
        scatter of few stretches may be too small.
    """
    group = linear.seen(group)
    columns = (model, np.concatenate([model, group]))
    begin = linear.to_neutral(dropped)
    without = linear.to_neutral(_concatenated([dropped, group])) if inside else begin
    alone, with_group = _steps(linear, columns, (without, begin))
    fit = _Gain.of(linear, alone, with_group)
    by_flight = linear.is_shared_by_flights(group)
    across = by_flight and linear.flights > 1
    folds = linear.flight if across else linear.section
    held_out = _held_out(linear, columns, (without, begin), folds)
    reason, patience = SelectionCode.PREDICTS_FLIGHTS, MIN_GAIN_SD if inside else 1.0
    if by_flight and inside:
        held_out = held_out.with_scatter_of_flights(linear.flight)
    if not across:
        held_out = held_out.with_flights_weighted_equally(linear.flight)
        reason = SelectionCode.PREDICTS_SECTIONS
    elif not held_out.is_significant(min_gain) and held_out.share > -patience * held_out.scatter:
        by_section = _held_out(linear, columns, (without, begin), linear.section)
        if by_section.is_significant(min_gain):
            held_out, reason = by_section, SelectionCode.PREDICTS_SECTIONS
    limit = SIGNIFICANCE / max(candidates, 1)
    stays = inside and held_out.share > -patience * held_out.scatter  # nothing contradicts it
    of_few = reason is SelectionCode.PREDICTS_SECTIONS or (
        stays and not held_out.is_significant(min_gain)
    )
    gusty = of_few and by_flight and not excludes_gusts
    chance = _hotelling_chance(linear, model, group, (alone, with_group), one_section_may_err=gusty)
    if not by_flight:
        chance = max(chance, chance_of_gusts(linear, model, group, without))
    if white:
        chance = max(chance, float(chdtrc(len(group), 2.0 * max(fit.of_stretch.sum(), 0.0))))
    if not _is_determined(linear, model, group):
        reason = SelectionCode.NO_INFORMATION
    elif fit.share < min_gain:
        reason = SelectionCode.IMMATERIAL
    elif chance > limit:
        reason = SelectionCode.NOT_SIGNIFICANT
    elif not held_out.is_significant(min_gain):
        reason = SelectionCode.SIGNIFICANT if stays else SelectionCode.NOT_PREDICTED
    return Score(fit.share, held_out.share, held_out.scatter, chance, reason)


def backward_elimination(
    linear: LinearisedLoss,
    model: Columns,
    groups: Mapping[str, Columns],
    *,
    candidates: int,
    without: Columns = NO_COLUMNS,
    lumped: Collection[str] = (),
    excluding_gusts: Collection[str] = (),
    min_gain: float = MIN_GAIN,
    white: bool = False,
    without_refits: bool = False,
) -> tuple[dict[str, Score], dict[str, Score]]:
    """Return the scores of the groups that backward elimination keeps, and of those it removes.

    The least significant of the rejected groups goes first, then the others are scored without it:
    held-out gains of a few flights hardly rank two groups that only one flight shows. Lumped groups
    go before others: with more coefficients they describe the effect of one term, and noise would
    choose between the two. Then go the groups without any gain in the fit. Of the others one goes
    at a time, and none together with those: beside superfluous groups, others seem insignificant,
    so a refit comes first.

    Where a group is needed without the one that goes, and that one without it, noise chooses
    between the two. Then the one with more coefficients goes.

    Parameters
    ----------
    linear, candidates, min_gain, white
        As of `score`; the point is the fit with all groups.
    model
        Columns of the coefficients that stay.
    groups
        Group -> columns.
    without
        Columns to remove beforehand.
    lumped
        Names of groups that lump effects of others.
    excluding_gusts
        Names of groups that no gust can imitate.
    without_refits
        Whether to remove all rejected groups without a refit between.
    """

    def scored(left: Mapping[str, Columns]) -> dict[str, Score]:
        gone = [columns for name, columns in groups.items() if name not in left]
        return {
            name: score(
                linear,
                _concatenated([model, *(c for other, c in left.items() if other != name)]),
                columns,
                candidates=candidates,
                inside=True,
                dropped=_concatenated([without, *gone]),
                excludes_gusts=name in excluding_gusts,
                min_gain=min_gain,
                white=white,
            )
            for name, columns in left.items()
        }

    taken = dict[str, Score]()
    left, scores = dict(groups), scored(groups)
    while True:
        idle = [name for name, found in scores.items() if not found.is_accepted]
        if not idle:
            return scores, taken
        vain = [name for name in idle if scores[name].reason is SelectionCode.IMMATERIAL]
        least = max(
            idle,
            key=lambda name: (
                name in lumped,
                name in vain,
                1.0 if name in vain else scores[name].chance,
                -scores[name].gain_fit,
            ),
        )
        if taken and not (without_refits or least in vain or least in lumped):
            return scores, taken
        rest = {name: columns for name, columns in left.items() if name != least}
        after = scored(rest)
        for name in idle:
            if len(left[name]) > len(left[least]) and after[name].is_accepted:
                others = {other: columns for other, columns in left.items() if other != name}
                instead = scored(others)
                if instead[least].is_accepted:
                    least, rest, after = name, others, instead
                    break
        taken[least] = scores[least]
        left, scores = rest, after


def _concatenated(parts: Sequence[Columns]) -> Columns:
    return np.concatenate([NO_COLUMNS, *parts])


@dataclass(frozen=True)
class _Gain:
    """The gain of each stretch (S,) by a group, and its loss (S,) without the group.

    ``of_flight`` is the gain of each flight (N,), where the stretches of a flight share an error.
    """

    of_stretch: Array
    without: Array
    of_flight: Array | None = None

    @staticmethod
    def of(
        linear: LinearisedLoss,
        alone: Array,
        with_group: Array,
        inside: NDArray[np.bool_] | bool = True,
    ) -> _Gain:
        """Return the gain of one change (K,) over another in some stretches, none elsewhere."""
        without = linear.change_of_loss(alone)
        gain = np.where(inside, without - linear.change_of_loss(with_group), 0.0)
        return _Gain(gain, np.where(inside, linear.loss / len(without) + without, 0.0))

    def with_scatter_of_flights(self, flight: NDArray[np.intp]) -> _Gain:
        """Return the gain whose scatter is that of the flights, if that is larger."""
        return replace(self, of_flight=np.asarray(np.bincount(flight, self.of_stretch), np.float64))

    def with_flights_weighted_equally(self, flight: NDArray[np.intp]) -> _Gain:
        """Return the gain as a mean over flights (S,) of shares of their own losses."""
        of_flight = np.bincount(flight, self.without)
        least = MIN_FLIGHT_LOSS_SHARE * self.loss_without
        weight = 1.0 / np.maximum(of_flight, least)[flight] / len(of_flight)
        return _Gain(self.of_stretch * weight, self.without * weight)

    @property
    def loss_without(self) -> float:
        """The loss of all stretches without the group."""
        return float(self.without.sum())

    @property
    def share(self) -> float:
        """Gain as a share of the loss without the group."""
        return float(self.of_stretch.sum() / self.loss_without)

    @property
    def scatter(self) -> float:
        """Standard deviation of ``share`` over independent stretches, or over flights."""
        several = [
            parts
            for parts in (self.of_stretch, self.of_flight)
            if parts is not None and len(parts) > 1
        ]
        deviations = [np.sqrt(len(parts)) * np.std(parts, ddof=1) for parts in several]
        return float(max(deviations, default=np.inf) / self.loss_without)

    def is_significant(self, min_gain: float) -> bool:
        """Whether the gain exceeds ``min_gain`` and its scatter."""
        return self.share > max(MIN_GAIN_SD * self.scatter, min_gain)


def _steps(
    linear: LinearisedLoss,
    columns: tuple[Columns, Columns],
    begin: tuple[Array, Array],
    inside: NDArray[np.bool_] | None = None,
) -> tuple[Array, Array]:
    """Return the changes (K,) that fit some stretches, without and with a group."""
    without, with_group = (
        linear.step(free, inside=inside, from_=change)
        for free, change in zip(columns, begin, strict=True)
    )
    return without, with_group


def _held_out(
    linear: LinearisedLoss,
    columns: tuple[Columns, Columns],
    begin: tuple[Array, Array],
    by: NDArray[np.intp],
) -> _Gain:
    """Return the gain in each fold's stretches of linear fits to the other folds' stretches."""
    if len(np.unique(by)) < 2:
        return _Gain(np.zeros(len(by)), np.full(len(by), linear.loss / len(by)))
    folds = [
        _Gain.of(linear, *_steps(linear, columns, begin, ~out), out) for out in linear.folds(by)
    ]
    return _Gain(
        np.sum([fold.of_stretch for fold in folds], axis=0),
        np.sum([fold.without for fold in folds], axis=0),
    )


def _is_determined(linear: LinearisedLoss, model: Columns, group: Columns) -> bool:
    """Return whether no direction of a group is collinear with the model's coefficients."""
    information = linear.information()
    if not np.all(np.diag(information)[group] > 0.0):
        return False
    unit = unit_diagonal(information)
    information = information * np.outer(unit, unit)
    own, across = information[np.ix_(group, group)], information[np.ix_(group, model)]
    left = own - across @ scaled_solve(information[np.ix_(model, model)], across.T, 1e-13)
    return bool(symmetric_eigen(left)[0][0] > MIN_OWN_INFORMATION)


def _hotelling_chance(
    linear: LinearisedLoss,
    model: Columns,
    group: Columns,
    minima: tuple[Array, Array],
    *,
    one_section_may_err: bool = False,
) -> float:
    """Return the p-value of a group's score by Hotelling's T².

    Gusts in a closed loop outlast a stretch, so the covariance of the summed score is Newey and
    West's (1987) estimate, with correlated neighbours. Errors of the battery's voltage outlast a
    manoeuvre: their covariance, from readings of the voltmeter drawn again, is added.

    Parameters
    ----------
    linear, model, group
        As of `score`.
    minima
        The changes (K,) that lead to the minimum without and with the group. The score of the
        group's coefficients, the model's eliminated, is taken at the first; its scatter over
        stretches is taken at the second, where the effect of the group itself is gone.
    one_section_may_err
        Whether to return the largest p-value over leaving out each section.
    """
    total = linear.information() + linear.prior
    follow = scaled_solve(total[np.ix_(model, model)], total[np.ix_(model, group)])
    without, with_group = (
        (at := linear.gradients(change))[:, group] - at[:, model] @ follow for change in minima
    )
    seen = np.any(linear.diagonals[:, group] > 0.0, axis=1)
    parts = [seen]
    if one_section_may_err:
        parts += [seen & ~out for out in linear.folds(_sections(linear.flight))]
    called, read = without - with_group, np.zeros((1, len(group)))
    if linear.readings is not None:
        read = linear.readings[:, group] - linear.readings[:, model] @ follow
    read = STUDENT_FACTOR / np.sqrt(len(read)) * read
    return max(
        _hotelling_chance_in(part, called, with_group, linear.flight, read) for part in parts
    )


def _hotelling_chance_in(
    part: NDArray[np.bool_], called: Array, scores: Array, flight: NDArray[np.intp], read: Array
) -> float:
    """Return the p-value of ``called`` (S, L) summed over a part (S,), by scatter of ``scores``.

    Stretches outside the part still separate their neighbours. ``read`` (D, L) has the covariance
    of errors that all stretches share: the sum of its rows' squares.
    """
    count, size = float(part.sum()), scores.shape[1]
    if count <= size + 1:
        return 1.0
    scores = scores * part[:, None]
    unit = 1.0 / np.sqrt(np.maximum((scores**2).sum(axis=0), 1e-300))
    spread = long_run_covariance(scores * unit, flight) * count / (count - 1.0)
    spread += (read * unit).T @ (read * unit)
    along = called[part].sum(axis=0) * unit
    hotelling = max(float(along @ scaled_solve(spread + RIDGE * np.eye(size), along)), 0.0)
    return float(fdtrc(size, count - size, hotelling * (count - size) / (size * (count - 1.0))))


def long_run_covariance(scores: Array, flight: NDArray[np.intp]) -> Array:
    """Return the covariance (L, L) of the sum of scores (S, L) that are correlated in a flight."""
    spread = scores.T @ scores
    for apart in range(1, CORRELATED_STRETCHES + 1):
        same = flight[apart:] == flight[:-apart]
        across = scores[apart:][same].T @ scores[:-apart][same]
        spread = spread + (1.0 - apart / (CORRELATED_STRETCHES + 1.0)) * (across + across.T)
    return np.asarray(spread)
