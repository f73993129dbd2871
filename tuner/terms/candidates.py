"""Candidate terms: the groups that a fit may add, problems with them free, and the selection.

Bayesian model averaging gives the shift of a fit's coefficients by the terms left out of it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import expit

from tuner.config import JobFile
from tuner.core.numerics import Z95, Array, scaled_solve, symmetric_eigen
from tuner.objective.criterion import Point
from tuner.objective.inlets import bypassed_by
from tuner.objective.normal_equations import Objective, with_conditions
from tuner.objective.space import Space, extended
from tuner.search.continuation import RIDGE
from tuner.search.problem import Job
from tuner.search.progress import Fitted, loop_of, with_loop
from tuner.terms.linearisation import Columns, LinearisedLoss
from tuner.terms.score import ACCEPTED, long_run_covariance
from tuner.uncertainty.covariance import STRETCH_S, overdispersion_factors, scatter
from tuner.vehicle import COEFFICIENTS, condition_rows, term_groups, values_of
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

PRIOR_PRESENCE = 0.5
"""Prior probability that a vehicle has an effect large enough to be seen: no preference."""
PRIOR_PRESENCE_OF_LUMPED = 0.1
"""The same for a lumped group: other candidates describe its effect term by term, more likely."""


def candidate_groups(job: Job) -> Groups:
    """Return the groups that act, none of whose coefficients is given, free or fixed."""
    values, groups = values_of(job.settings.vehicle), term_groups()
    taken = {*job.space.free, *job.settings.job.fixed, *bypassed_by(job.inlets, job.fitted)}
    return {
        group: names
        for group, names in groups.items()
        if not taken.intersection(names)
        and all(values.get(name) in (None, COEFFICIENTS[name].neutral) for name in names)
    }


def condition_groups(objective: Objective, *, closed_loop: bool) -> Groups:
    """Return the groups of per-flight conditions (wind, battery) that a fit may add.

    They are nuisance parameters with a value for each flight: wind where flights are simulated
    whole in closed loop (over a window, the initial state explains as much), and there a battery's
    decline if no voltage was recorded.
    """
    if not closed_loop:
        return {}
    groups: dict[str, tuple[str, ...]] = {"wind": ("wind_x", "wind_y")}
    if objective.segments.log_voltage is None:
        groups["battery_decline"] = ("battery_decline",)
    return {
        group: names
        for group, names in groups.items()
        if not set(names).intersection(objective.conditions)
    }


def names_of(groups: Groups) -> tuple[str, ...]:
    """Return the names in some groups: coefficients and per-flight conditions."""
    return tuple(name for names in groups.values() for name in names)


def coefficients_of(groups: Groups) -> tuple[str, ...]:
    """Return the coefficients of some groups."""
    return tuple(name for name in names_of(groups) if name not in condition_rows())


def conditions_of(groups: Groups) -> tuple[str, ...]:
    """Return the per-flight conditions of some groups."""
    return tuple(name for name in names_of(groups) if name in condition_rows())


def groups_named(terms: Sequence[str], space: Space) -> Groups:
    """Return the groups, or coefficients, that a job file names and that are not free yet.

    Per-flight conditions are not among them: those are estimated from the start of the search.
    """
    groups = term_groups()
    named: dict[str, tuple[str, ...]] = {}
    taken = {*space.free, *condition_rows()}
    for term in terms:
        members = groups.get(term, (term,) if term in COEFFICIENTS else ())
        names = tuple(name for name in members if name not in taken)
        if names:
            named[term] = names
            taken.update(names)
    return named


def is_lumped(group: str) -> bool:
    """Return whether a group lumps effects that other terms describe one by one."""
    return any(COEFFICIENTS[name].is_aggregate for name in term_groups().get(group, ()))


def prior_presence_of(names: Collection[str]) -> float:
    """Return the prior probability that a vehicle has a group in a size that flights can show."""
    rows = [COEFFICIENTS[name] for name in names if name in COEFFICIENTS]
    if any(row.expected for row in rows):
        return 1.0
    return PRIOR_PRESENCE_OF_LUMPED if any(row.is_aggregate for row in rows) else PRIOR_PRESENCE


def neutral_values(names: Sequence[str]) -> dict[str, float]:
    """Return the neutral values of some coefficients; each of a term has one."""
    return {n: value for n in names if (value := COEFFICIENTS[n].neutral) is not None}


def with_terms(
    objective: Objective, point: Point, names: Sequence[str], job: JobFile
) -> tuple[Objective, Point]:
    """Return a problem with more coefficients free, and its point with them at neutral values."""
    if not names:
        return objective, point
    space = extended(objective.space, names, job, neutral_values(names))
    return replace(objective, space=space), Point(
        np.concatenate([np.asarray(point.coefficients), np.asarray(space.initial[-len(names) :])]),
        point.offsets,
    )


def with_free(
    job: Job, fitted: Fitted, names: Sequence[str], *, conditions_added: Sequence[str] = ()
) -> tuple[Job, Fitted]:
    """Return job and fit with more coefficients and conditions free, at neutral values."""
    objective, point = with_terms(fitted.objective, fitted.point, names, job.settings.job)
    objective, point = with_conditions(objective, point, conditions_added)
    return (
        replace(
            job,
            space=objective.space,
            objective=replace(
                job.objective, space=objective.space, conditions=objective.conditions
            ),
        ),
        replace(fitted, objective=objective, point=point),
    )


def with_groups(
    base: tuple[Job, Fitted],
    groups: Groups,
    fitted: Fitted,
    *,
    vector: Mapping[str, float] | None = None,
) -> tuple[Job, Fitted]:
    """Return a base job with some groups added, and its fit at the values of another fit.

    Parameters
    ----------
    base
        Job and fit without any groups.
    groups
        The groups to add.
    fitted
        The fit whose values are taken.
    vector
        Coefficient -> value in the search vector; that of ``fitted`` by default.
    """
    job, grown = with_free(*base, coefficients_of(groups), conditions_added=conditions_of(groups))
    vector = fitted.vector if vector is None else vector
    moved = replace(
        fitted,
        objective=with_loop(grown.objective, loop_of(fitted.objective)),
        point=Point(
            np.asarray([vector[name] for name in job.space.names]),
            offsets_of(fitted, grown.objective),
        ),
    )
    return job, moved


def offsets_of(fitted: Fitted, objective: Objective, *, reset: Collection[str] = ()) -> Array:
    """Return a fit's offsets as rows of another problem of the same flights; some reset to zero."""
    rows = np.asarray(fitted.point.offsets)
    by_name = dict(zip(fitted.objective.of_flight, rows, strict=True))
    zeros = np.zeros(rows.shape[1])
    by_name |= dict.fromkeys(reset, zeros)
    return np.stack([by_name.get(name, zeros) for name in objective.of_flight])


@dataclass(frozen=True)
class Selected:
    """A job and its fit with the terms that were kept, and the table of all that were tried.

    Attributes
    ----------
    selection_shifts
        Coefficient -> its root mean square shift, scaled, by terms that were tried and not kept
        (`selection_shifts`); empty if none was tried.
    base
        Job and fit without any term; None if none was tried.
    refuted
        Whether the flights contradict the fit: neither terms nor disturbances explain them.
    substitutes
        Kept group -> values of coefficients that were left out and that flights do not exclude in
        its place.
    """

    job: Job
    fitted: Fitted
    rows: tuple[SelectionRow, ...] = ()
    selection_shifts: Mapping[str, float] = field(default_factory=dict)
    base: tuple[Job, Fitted] | None = None
    refuted: bool = False
    substitutes: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def kept(self) -> tuple[str, ...]:
        """The groups that are in the fit."""
        return tuple(row.group for row in self.rows if row.kept)

    @property
    def left_out(self) -> tuple[tuple[str, ...], ...]:
        """Names of each group that was tried and not kept, if the flights determine it."""
        return tuple(
            row.names
            for row in self.rows
            if not row.kept and row.reason is not SelectionCode.NO_INFORMATION
        )

    @property
    def rows_after_holding(self) -> tuple[SelectionRow, ...]:
        """The table, with chosen terms not kept if all their coefficients are held."""
        return tuple(
            row.model_copy(update={"kept": False, "reason": SelectionCode.NO_INFORMATION})
            if row.reason in ACCEPTED
            and all(self.fitted.held.get(name) == name for name in row.names)
            else row
            for row in self.rows
        )


NEGLIGIBLE_SE, NEGLIGIBLE_SIZE = 0.4, 0.1
"""Shares of a term's standard error and of its usual size (its prior's standard deviation): below
the smaller of the two a term makes no difference that flights could show."""
SIZE_GRID_POINTS = 40
"""Sizes averaged over, from negligible to usual, equally spaced in logarithm."""
MIN_RELATIVE_INFORMATION = 1e-10
"""Least information of a direction, relative to the group's largest and its prior's: anything less
is rounding, and the prior decides."""


def selection_shifts(
    linear: LinearisedLoss,
    model: Columns,
    groups: Iterable[tuple[Columns, float]],
    substitutes: Iterable[Substitute] = (),
) -> Array:
    """Return the root mean square shift of each parameter (P,) of the model by omitted groups.

    Each group is added by itself, to first order. A priori it is absent, or its coefficients are
    normal about their neutral values with a log-uniform size, from negligible to usual. Models
    without the group and with it in each size are averaged by their posterior probabilities. So an
    insignificant term adds little however far a refit would move, and one that is likely but not
    significant adds its full shift. A group in place of one in the model (`substitutes_of`) adds
    its shift by its probability, and so much that the interval holds it where flights do not
    exclude it. The mean squares of all groups add up.

    Parameters
    ----------
    linear
        The loss about the fit.
    model
        Columns of the model's parameters.
    groups
        Columns of each omitted group, and the prior probability that the vehicle has it.
    substitutes
        Omitted groups that may be there in place of one in the model.

    Notes
    -----
    Hoeting, Madigan, Raftery and Volinsky, "Bayesian model averaging: a tutorial", 1999. The
    errors in the evidence include gusts: they come from the scatter of stretches of time about a
    fit with the group, corrected for the fitted degrees of freedom
    (`tuner.uncertainty.covariance.scatter`; twenty coefficients and a group fitted to a minute of
    flight leave a fraction of it). They are compared with noise as a fit's own errors are
    (`tuner.uncertainty.covariance`), along the axes of the noise: the scatter of a few stretches
    always has an axis along which it is far too small. The shift of a refit alone is no measure:
    where flights hardly separate a term from the model it is chance.
    """
    square = linear.information() + linear.prior
    alone = linear.step(model)
    squares = np.zeros(len(linear.scaled))
    for group, presence in groups:
        evidence = Evidence.of(linear, square, alone, model, linear.seen(group))
        squares[model] += evidence.mean_square(presence)
    for one in substitutes:
        share = max(one.probability, Z95**-2 if one.is_not_excluded else 0.0)
        squares[model] += share * one.change[model] ** 2
    return np.asarray(np.sqrt(squares))


MAX_CHANCE = 0.05
"""Probability below which flights exclude a group in place of another."""


@dataclass(frozen=True)
class Substitute:
    """A fit with an omitted group in place of a group in the model, to first order.

    Attributes
    ----------
    kept
        The group in the model.
    values
        Coefficient of the omitted group -> its value in that fit.
    change
        (P,) change from the model's minimum to that fit's.
    probability
        Of that fit, if one of the two is true and both are equally likely a priori.
    """

    kept: str
    values: Mapping[str, float]
    change: Array
    probability: float

    @property
    def is_not_excluded(self) -> bool:
        """Whether flights leave it possible."""
        return self.probability > MAX_CHANCE


def substitutes_of(
    linear: LinearisedLoss,
    space: Space,
    model: Columns,
    kept: Mapping[str, Columns],
    left_out: Iterable[Columns],
) -> list[Substitute]:
    """Return the fits with each omitted group in place of each kept one.

    Notes
    -----
    The likelihood ratio of two models that are not nested (Cox, "Tests of separate families of
    hypotheses", 1961). Errors that are correlated in time scatter the scores of stretches more
    than noise would along the change from one minimum to the other, and the logarithm of the ratio
    is divided by that factor.
    """

    def loss(change: Array) -> float:
        prior = (linear.pull + 0.5 * linear.prior @ change) @ change
        return float(linear.change_of_loss(change).sum() + prior)

    alone, square = linear.step(model), linear.information()
    scores, before, found = linear.gradients(alone), loss(alone), list[Substitute]()
    outside = list(left_out)
    for group, own in kept.items():
        without, rest = linear.to_neutral(own), np.setdiff1d(model, own)
        for columns in outside:
            there = linear.step(np.append(rest, linear.seen(columns)), from_=without)
            change = there - alone
            spread = float(long_run_covariance((scores @ change)[:, None], linear.flight)[0, 0])
            excess = max(spread / max(float(change @ square @ change), 1e-300), 1.0)
            probability = float(expit((before - loss(there)) / excess))
            scaled = linear.scaled + there
            values = {  # conditions of flights are columns beyond the space's
                linear.names[i]: space.from_scaled(i, scaled[i]) for i in columns if i < len(space)
            }
            found.append(Substitute(group, values, change, probability))
    return found


def values_instead(substitutes: Iterable[Substitute]) -> dict[str, dict[str, float]]:
    """Return kept group -> values of coefficients that flights do not exclude in its place."""
    found: dict[str, dict[str, float]] = {}
    for one in substitutes:
        if one.is_not_excluded:
            found.setdefault(one.kept, {}).update(one.values)
    return found


@dataclass(frozen=True)
class Evidence:
    """Estimates of a group's coefficients in units of their usual sizes, along independent axes.

    Attributes
    ----------
    moves
        (K, L) shift of the model's coefficients per unit along each axis.
    value, variance
        (L,) the estimate along each axis.
    """

    moves: Array
    value: Array
    variance: Array

    @staticmethod
    def of(
        linear: LinearisedLoss, square: Array, alone: Array, model: Columns, group: Columns
    ) -> Evidence:
        """Return the evidence beside a model whose minimum is at ``alone`` (P,)."""
        usual = linear.prior_sd[group]
        own, across = square[np.ix_(model, model)], square[np.ix_(model, group)]
        follow = -scaled_solve(own, across, RIDGE)
        left = square[np.ix_(group, group)] + square[np.ix_(group, model)] @ follow
        pull = linear.pull + linear.prior @ alone
        slope = (linear.gradients(alone).sum(axis=0) + pull)[group] * usual
        known = left * np.outer(usual, usual) - np.eye(len(group))  # by the flights alone
        values, axes = symmetric_eigen(known)
        values = np.maximum(values, MIN_RELATIVE_INFORMATION * max(values[-1], 1.0))
        slope, moves = axes.T @ slope, follow * usual @ axes
        both = np.concatenate([model, group])
        along = np.zeros((len(square), len(group)))
        along[both] = np.vstack([moves, usual[:, None] * axes])
        wider = alone - along @ (slope / (values + 1.0))
        turned = np.hstack([np.eye(len(square))[:, model], along])[both]
        meat, freedom = scatter(
            linear.stretches(both, wider, STRETCH_S).projected(turned),
            turned.T @ square[np.ix_(both, both)] @ turned,
        )
        seen, freedom = np.diag(meat)[len(model) :] / values, freedom[len(model) :]
        alike = np.ones(len(group))
        allowed = overdispersion_factors(seen, freedom, np.diag(alike), alike)
        return Evidence(moves, -slope / values, allowed**2 / values)

    def mean_square(self, presence: float) -> Array:
        """Return the mean square shifts (K,) over the posterior of the group's size.

        ``presence`` is the prior probability of a size other than zero.
        """
        std_error = np.exp(0.5 * np.mean(np.log(np.maximum(self.variance, 1e-300))))
        smallest = min(NEGLIGIBLE_SIZE, NEGLIGIBLE_SE * float(std_error))
        present = np.exp(2.0 * np.linspace(np.log(smallest), 0.0, SIZE_GRID_POINTS))
        sizes = np.append(present, 0.0)[:, None]
        prior = np.append(np.full(SIZE_GRID_POINTS, presence / SIZE_GRID_POINTS), 1.0 - presence)
        allowed = np.maximum(sizes + self.variance, 1e-300)
        log_likelihood = -0.5 * (np.log(allowed) + self.value**2 / allowed).sum(axis=1)
        weight = prior * np.exp(log_likelihood - log_likelihood.max())
        weight /= weight.sum()
        centres = (sizes / allowed * self.value) @ self.moves.T
        scatters = (sizes * self.variance / allowed) @ (self.moves**2).T
        return np.asarray(weight @ (centres**2 + scatters))
