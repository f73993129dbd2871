"""The score of a group of terms: its gain in the fit, its significance, its gain in held-out data.

`score` tests one group beside a model, `surviving` eliminates groups backwards.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc  # scipy.stats takes a quarter of a second to import

from tuner.core.numerics import scaled_solve, symmetric_eigen, unit_diagonal
from tuner.objective.information import BLOCK
from tuner.terms.linearisation import RIDGE, SECTIONS, Columns, Linear
from tuner.uncertainty.covariance import STRETCH
from tuner.vehicle.selection_table import SelectionCode, SelectionRow


def chance_of_gusts(
    linear: Linear, model: Columns, group: Columns, begin: NDArray[np.float64]
) -> float:
    """Return the probability of such values of flights if they are means of what varies in them.

    Gusts have a mean over a flight, and a flight's own columns take it out of the residuals, which
    then no longer show how far such means scatter: wind is found that nobody would meet again. How
    far they do is seen inside flights, where each section gets columns of its own. What columns for
    each flight are worth is compared with what those of its sections are worth beside them, each
    for as many as they are: an analysis of variance, nested (Scheffé, "The analysis of variance",
    1959, ch. 5), whose ratio has Snedecor's F distribution if sections are independent.

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
    """Return the section of each stretch (S,): a third of its flight, eight seconds of a long one.

    They are numbered through all flights.
    """
    numbers, count = np.empty(len(flight), np.intp), 0
    for own in np.unique(flight):
        stretches = np.flatnonzero(flight == own)
        many = max(SECTIONS, round(len(stretches) * BLOCK / STRETCH))
        for part in np.array_split(stretches, min(many, len(stretches))):
            numbers[part] = count
            count += 1
    return numbers


def _with_columns_for(linear: Linear, own: NDArray[np.intp], sections: NDArray[np.intp]) -> Linear:
    """Return the same loss where sections have columns of their own, behind all others.

    Each section counts as a flight then. ``own`` says which of the columns that a stretch sees
    they double.
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
        seen=np.hstack([seen, columns]),
    )


SIGNIFICANCE = 0.01
"""Probability with which chance alone would add any term at all, over all candidates together."""
MATERIAL = 0.01
"""Share of the loss below which a gain is no evidence: two simulators of a vehicle differ, too."""
SMALLEST = 1e-6
"""Share of the loss that a flight has at least, where flights count alike."""
SIGNIFICANT_GAIN = 2.0
"""Standard deviations by which what was left out must be predicted better."""
MEMORY = 2
"""Stretches over which residuals are taken to be correlated."""
EARNING = (
    SelectionCode.PREDICTS_FLIGHTS,
    SelectionCode.PREDICTS_SECTIONS,
    SelectionCode.SIGNIFICANT,
    SelectionCode.PREDICTS_SAMPLES,
)
NO_COLUMNS = np.empty(0, np.intp)
"""No columns."""
DETERMINED = 1e-8
"""Share of a group's information that must be left once the model's coefficients follow it."""


@dataclass(frozen=True)
class Score:
    """What a group is worth beside a model, all gains as shares of the loss.

    Attributes
    ----------
    gain_fit
        In the loss of the fit, in one linear step.
    gain_holdout, scatter
        In the loss of what is left out of linear fits to the rest, and its standard deviation over
        stretches.
    chance
        Probability of such a score if the group's coefficients were neutral (Hotelling's T² of the
        stretches' scores: residuals that are correlated in time count as they scatter).
    reason
        Whether it earns its place.
    """

    gain_fit: float
    gain_holdout: float
    scatter: float
    chance: float
    reason: SelectionCode

    @property
    def earns_place(self) -> bool:
        """Whether it may stay in the model, or come into it."""
        return self.reason in EARNING


def row_of(
    group: str,
    names: tuple[str, ...],
    found: Score,
    reason: SelectionCode | None = None,
    *,
    kept: bool,
) -> SelectionRow:
    """Return the row of a group; its reason is the score's unless another is known.

    One that would earn its place, and is not kept, did not hold it beside the others.
    """
    if not kept and found.earns_place:
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
    linear: Linear,
    model: Columns,
    group: Columns,
    *,
    candidates: int,
    inside: bool = False,
    gone: Columns = NO_COLUMNS,
    no_gust: bool = False,
    material: float = MATERIAL,
) -> Score:
    """Return what a group is worth beside a model.

    What is in the model stays where chance does not explain it and nothing left out contradicts it:
    flights that are fitted without the one that shows most can predict hardly anything for sure.
    All of such a flight's stretches share one error, that of the fit to the others; so flights, not
    stretches, have to contradict it, and surely. What is not in the model has to predict.

    A group with columns for each flight is nothing that other flights could predict: sections of
    the flight's own do, and flights count alike however strongly each shows it. It has to differ
    between flights by more than gusts would let it (`chance_of_gusts`).

    Of a flight that is alone sections are left out, too: it has to predict itself in time.

    Where sections, or no flights for sure, speak for a group, a gust during one manoeuvre might do
    what it would; so chance must not explain it whichever section is left out. What a recorded
    signal says a gust does not know.

    Parameters
    ----------
    linear
        The loss about the point.
    model
        Columns of the coefficients in the model, without the group's.
    group
        Columns of the group.
    candidates
        Among how many groups it was picked: the level of significance is shared by them.
    inside
        Whether the point holds fitted values of the group, rather than its neutral ones.
    gone
        Columns of coefficients that go to their neutral values with the group and without it.
    no_gust
        Whether no gust can pass for the group: its law reads a recorded signal, or the fit with it
        leaves measurement noise alone.
    material
        Share of the loss below which a gain is no evidence.
    """
    columns = (model, np.concatenate([model, group]))
    begin = linear.away(gone)
    without = linear.away(_joined([gone, group])) if inside else begin
    alone, with_group = _steps(linear, columns, (without, begin))
    fit = _Gain.of(linear, alone, with_group)
    by_flight = linear.sees_alike(group)
    across = by_flight and linear.flights > 1
    folds = linear.flight if across else linear.section
    held_out = _held_out(linear, columns, (without, begin), folds)
    reason, patience = SelectionCode.PREDICTS_FLIGHTS, SIGNIFICANT_GAIN if inside else 1.0
    if by_flight and inside:
        held_out = held_out.with_flights_apart(linear.flight)
    if not across:
        held_out = held_out.with_flights_alike(linear.flight)
        reason = SelectionCode.PREDICTS_SECTIONS
    elif not held_out.is_sure(material) and held_out.share > -patience * held_out.scatter:
        by_section = _held_out(linear, columns, (without, begin), linear.section)
        if by_section.is_sure(material):
            held_out, reason = by_section, SelectionCode.PREDICTS_SECTIONS
    limit = SIGNIFICANCE / max(candidates, 1)
    stays = inside and held_out.share > -patience * held_out.scatter  # nothing contradicts it
    of_few = reason is SelectionCode.PREDICTS_SECTIONS or (stays and not held_out.is_sure(material))
    gusty = of_few and by_flight and not no_gust
    chance = _chance(linear, model, group, (alone, with_group), one_section_may_err=gusty)
    if not by_flight:
        chance = max(chance, chance_of_gusts(linear, model, group, without))
    if not _is_determined(linear, model, group):
        reason = SelectionCode.NO_INFORMATION
    elif fit.share < material:
        reason = SelectionCode.IMMATERIAL
    elif chance > limit:
        reason = SelectionCode.NOT_SIGNIFICANT
    elif not held_out.is_sure(material):
        reason = SelectionCode.SIGNIFICANT if stays else SelectionCode.NOT_PREDICTED
    return Score(fit.share, held_out.share, held_out.scatter, chance, reason)


def surviving(
    linear: Linear,
    model: Columns,
    groups: Mapping[str, Columns],
    *,
    candidates: int,
    without: Columns = NO_COLUMNS,
    stand_ins: Collection[str] = (),
    no_gusts: Collection[str] = (),
    material: float = MATERIAL,
    at_once: bool = False,
) -> tuple[dict[str, Score], dict[str, Score]]:
    """Return the scores of the groups that a backward elimination leaves, and of those it takes.

    Of those that do not predict, the group that chance explains best is taken away first, then all
    others are scored without it: a few flights left out say little about which of two it should be,
    where one flight alone shows something. Of groups that can do without each other the stand-ins
    go first: with more coefficients they do what one term of the vehicle does, and noise would
    choose between the two. Then go those without which the fit loses nothing. Of the others one
    goes at a time, and none beside those, before it is fitted without them: beside what is there in
    vain all else looks like chance.

    Parameters
    ----------
    linear, candidates, material
        As of `score`; the point is the fit with all groups.
    model
        Columns of the coefficients that stay.
    groups
        Group -> columns.
    without
        Columns of what the point holds and is given up beforehand.
    stand_ins
        Names of groups that describe as a whole what others do one by one.
    no_gusts
        Names of groups for which no gust can pass.
    at_once
        Whether all go that have to, without a fit between.
    """
    left, taken = dict(groups), dict[str, Score]()
    while True:
        gone = _joined([without, *(groups[name] for name in taken)])
        scores = {}
        for name, columns in left.items():
            others = _joined([model, *(c for other, c in left.items() if other != name)])
            scores[name] = score(
                linear,
                others,
                columns,
                candidates=candidates,
                inside=True,
                gone=gone,
                no_gust=name in no_gusts,
                material=material,
            )
        idle = [name for name, found in scores.items() if not found.earns_place]
        if not idle:
            return scores, taken
        vain = [name for name in idle if scores[name].reason is SelectionCode.IMMATERIAL]
        least = max(
            idle,
            key=lambda name: (
                name in stand_ins,
                name in vain,
                1.0 if name in vain else scores[name].chance,
                -scores[name].gain_fit,
            ),
        )
        if taken and not (at_once or least in vain or least in stand_ins):
            return scores, taken
        taken[least] = scores[least]
        del left[least]


def _joined(parts: Sequence[Columns]) -> Columns:
    return np.concatenate([NO_COLUMNS, *parts])


@dataclass(frozen=True)
class _Gain:
    """By how much each stretch's loss (S,) is lower with a group, and its loss (S,) without it.

    ``of_flight`` is the first summed over flights (N,), where their errors are one each.
    """

    of_stretch: NDArray[np.float64]
    without: NDArray[np.float64]
    of_flight: NDArray[np.float64] | None = None

    @staticmethod
    def of(
        linear: Linear,
        alone: NDArray[np.float64],
        with_group: NDArray[np.float64],
        inside: NDArray[np.bool_] | bool = True,
    ) -> _Gain:
        """Return the gain of one change (K,) over another in some stretches, none elsewhere."""
        without = linear.change_of_loss(alone)
        gain = np.where(inside, without - linear.change_of_loss(with_group), 0.0)
        return _Gain(gain, np.where(inside, linear.loss / len(without) + without, 0.0))

    def with_flights_apart(self, flight: NDArray[np.intp]) -> _Gain:
        """Return the gain whose scatter is that of the flights, if that is larger."""
        return replace(self, of_flight=np.asarray(np.bincount(flight, self.of_stretch), np.float64))

    def with_flights_alike(self, flight: NDArray[np.intp]) -> _Gain:
        """Return the gain as a mean over flights (S,) of shares of their own losses."""
        of_flight = np.bincount(flight, self.without)
        least = SMALLEST * self.loss_without
        weight = 1.0 / np.maximum(of_flight, least)[flight] / len(of_flight)
        return _Gain(self.of_stretch * weight, self.without * weight)

    @property
    def loss_without(self) -> float:
        """The loss of all stretches without the group."""
        return float(self.without.sum())

    @property
    def share(self) -> float:
        """Of the loss without the group."""
        return float(self.of_stretch.sum() / self.loss_without)

    @property
    def scatter(self) -> float:
        """Standard deviation of ``share`` if stretches are independent, or flights alone are."""
        several = [
            parts
            for parts in (self.of_stretch, self.of_flight)
            if parts is not None and len(parts) > 1
        ]
        deviations = [np.sqrt(len(parts)) * np.std(parts, ddof=1) for parts in several]
        return float(max(deviations, default=np.inf) / self.loss_without)

    def is_sure(self, material: float) -> bool:
        """Whether it is material and exceeds its scatter."""
        return self.share > max(SIGNIFICANT_GAIN * self.scatter, material)


def _steps(
    linear: Linear,
    columns: tuple[Columns, Columns],
    begin: tuple[NDArray[np.float64], NDArray[np.float64]],
    inside: NDArray[np.bool_] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the changes (K,) that fit some stretches, without and with a group."""
    without, with_group = (
        linear.step(free, inside=inside, from_=change)
        for free, change in zip(columns, begin, strict=True)
    )
    return without, with_group


def _held_out(
    linear: Linear,
    columns: tuple[Columns, Columns],
    begin: tuple[NDArray[np.float64], NDArray[np.float64]],
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


def _is_determined(linear: Linear, model: Columns, group: Columns) -> bool:
    """Return whether all of a group's directions differ from what the model's coefficients do."""
    information = linear.information()
    if not np.all(np.diag(information)[group] > 0.0):
        return False
    unit = unit_diagonal(information)
    information = information * np.outer(unit, unit)
    own, across = information[np.ix_(group, group)], information[np.ix_(group, model)]
    left = own - across @ scaled_solve(information[np.ix_(model, model)], across.T, 1e-13)
    return bool(symmetric_eigen(left)[0][0] > DETERMINED)


def _chance(
    linear: Linear,
    model: Columns,
    group: Columns,
    minima: tuple[NDArray[np.float64], NDArray[np.float64]],
    *,
    one_section_may_err: bool = False,
) -> float:
    """Return the probability of such a score if the group were neutral, by Hotelling's T².

    Gusts that a loop answers to are still there a stretch later: how much the sum of all stretches
    scatters is Newey and West's (1987) estimate, in which neighbours count.

    Parameters
    ----------
    linear, model, group
        As of `score`.
    minima
        The changes (K,) that lead to the minimum without and with the group. The score of the
        group's coefficients, the model's following them, is that of the first; how much it scatters
        from stretch to stretch is seen at the second, where only what is no such term is left.
    one_section_may_err
        Whether the others have to speak for the group whichever section is left out.
    """
    total = linear.information() + linear.prior
    follow = scaled_solve(total[np.ix_(model, model)], total[np.ix_(model, group)])
    without, with_group = (
        (at := linear.slopes(change))[:, group] - at[:, model] @ follow for change in minima
    )
    seen = np.any(linear.diagonals[:, group] > 0.0, axis=1)
    parts = [seen]
    if one_section_may_err:
        parts += [seen & ~out for out in linear.folds(_sections(linear.flight))]
    called = without - with_group
    return max(_chance_in(part, called, with_group, linear.flight) for part in parts)


def _chance_in(
    part: NDArray[np.bool_],
    called: NDArray[np.float64],
    scores: NDArray[np.float64],
    flight: NDArray[np.intp],
) -> float:
    """Return Hotelling's probability of a sum (S, L) over a part (S,), by how scores scatter there.

    A stretch outside it lies between its neighbours all the same.
    """
    count, size = float(part.sum()), scores.shape[1]
    if count <= size + 1:
        return 1.0
    scores = scores * part[:, None]
    unit = 1.0 / np.sqrt(np.maximum((scores**2).sum(axis=0), 1e-300))
    spread = long_run(scores * unit, flight) * count / (count - 1.0)
    along = called[part].sum(axis=0) * unit
    hotelling = max(float(along @ scaled_solve(spread + RIDGE * np.eye(size), along)), 0.0)
    return float(fdtrc(size, count - size, hotelling * (count - size) / (size * (count - 1.0))))


def long_run(scores: NDArray[np.float64], flight: NDArray[np.intp]) -> NDArray[np.float64]:
    """Return the covariance (L, L) of the sum of scores (S, L) that are correlated in a flight."""
    spread = scores.T @ scores
    for apart in range(1, MEMORY + 1):
        same = flight[apart:] == flight[:-apart]
        across = scores[apart:][same].T @ scores[:-apart][same]
        spread = spread + (1.0 - apart / (MEMORY + 1.0)) * (across + across.T)
    return np.asarray(spread)
