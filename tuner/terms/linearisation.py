"""A fit linearised about its point, to predict the effect of adding or removing terms and flights.

The loss of each stretch of time is a quadratic in the coefficients, from one Jacobian:
``L(x + δ) = L(x) + sᵀδ + ½ δᵀHδ`` in the scaled coordinates, each segment's start and each flight's
offsets eliminated. A group of coefficients is added by freeing its δ, and removed by the δ that
leads back to its neutral value. Per-flight conditions (wind, battery) have a column for each
flight, which no other flight sees.

Cross-validation by flights (`predicted_losses`) simulates each with the coefficients of a fit to
the others, one linear step from the joint fit. A single flight is predicted section by section, by
fits to its other sections.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from tuner.core.numerics import Array, scaled_solve
from tuner.objective.criterion import OFFSET_SD, Criterion, Jacobian, Point, SegmentSums, units_of
from tuner.objective.information import BLOCK_S, FisherInformation, information_at, with_secants
from tuner.objective.normal_equations import Objective, flight_batch, flight_batches
from tuner.objective.residuals import huber_loss
from tuner.objective.space import Space
from tuner.search.continuation import RIDGE
from tuner.search.progress import Fit
from tuner.uncertainty.covariance import Stretches
from tuner.vehicle import COEFFICIENTS, REGISTRY
from tuner.vehicle.coefficient import Parameter
from tuner.vehicle.selection_table import Groups

Columns = NDArray[np.intp]

FLIGHT_SECTIONS = 3
"""Sections in time of a flight, each held out in turn where flights cannot be."""


@dataclass(frozen=True)
class LinearisedLoss:
    """The loss about a point, stretch by stretch; P columns, S stretches that see L of them each.

    Attributes
    ----------
    scaled
        (P,) the point.
    hessian, score
        (S, L, L) and (S, L).
    prior, pull
        (P, P) information of all priors, and (P,) gradient of those of the coefficients.
    prior_sd
        (P,) of each coefficient's own prior.
    flight, section
        (S,) where each stretch belongs.
    loss
        Half the robust sum of squares of all flights.
    columns_seen
        (S, L) which columns each stretch sees; None where all see all.
    condition_columns
        How many of the last columns are per-flight conditions.
    names
        (P,) of the columns, a condition's once for each flight; empty if not needed.
    neutral
        (P,) scaled neutral values, at which a term is absent; zero by default.
    readings
        (D, P) changes of the gradient with readings of the battery's voltmeter drawn again.
    """

    scaled: Array
    hessian: Array
    score: Array
    prior: Array
    pull: Array
    prior_sd: Array
    flight: NDArray[np.intp]
    section: NDArray[np.intp]
    loss: float
    columns_seen: NDArray[np.intp] | None = None
    condition_columns: int = 0
    names: tuple[str, ...] = ()
    neutral: Array | None = None
    readings: Array | None = None

    @cached_property
    def _by_name(self) -> dict[str, list[int]]:
        places: dict[str, list[int]] = {}
        for column, name in enumerate(self.names):
            places.setdefault(name, []).append(column)
        return places

    def columns_of(self, names: Iterable[str]) -> Columns:
        """Return the columns of some names, in their order."""
        return np.array([column for name in names for column in self._by_name[name]], np.intp)

    def seen(self, group: Columns) -> Columns:
        """Return the columns of a group that the flights see, all if they see none.

        A coefficient that acts only beside another of its group is not seen while that is neutral.
        """
        seen = np.diag(self.information())[group] > 0.0
        return group[seen] if seen.any() else group

    def to_neutral(self, gone: Columns) -> Array:
        """Return the change (P,) that leads some columns to their neutral values."""
        change = np.zeros(len(self.scaled))
        change[gone] = ((0.0 if self.neutral is None else self.neutral) - self.scaled)[gone]
        return change

    @property
    def flights(self) -> int:
        """How many flights there are."""
        return len(np.unique(self.flight))

    @property
    def columns(self) -> NDArray[np.intp]:
        """Which columns (S, L) each stretch sees."""
        if self.columns_seen is not None:
            return self.columns_seen
        return np.broadcast_to(np.arange(len(self.scaled)), self.score.shape)

    def is_shared_by_flights(self, group: Columns) -> bool:
        """Return whether every flight's stretches see a group's columns: it is the vehicle's."""
        if self.flights == 1:
            return bool((group < len(self.scaled) - self.condition_columns).all())
        return self.columns_seen is None or bool(
            np.isin(group, np.intersect1d(*self.columns_seen[[0, -1]])).all()
        )

    def information(self, inside: NDArray[np.bool_] | None = None) -> Array:
        """Return the information (P, P) of some stretches (S,), of all by default."""
        inside = np.ones(len(self.flight), bool) if inside is None else inside
        cache, key = self._informations, inside.tobytes()
        if key not in cache:
            total = np.zeros((len(self.scaled), len(self.scaled)))
            for number in np.unique(self.flight[inside]):
                of_flight = inside & (self.flight == number)
                columns_seen = self.columns[np.argmax(of_flight)]
                total[np.ix_(columns_seen, columns_seen)] += self.hessian[of_flight].sum(axis=0)
            cache[key] = total
        return cache[key]

    @cached_property
    def _informations(self) -> dict[bytes, Array]:
        """Stretches, as bytes -> their information: every group is scored in the same folds."""
        return {}

    def gradients(self, change: Array) -> Array:
        """Return the gradient (S, P) of each stretch's loss after a change (P,)."""
        local = self.score + np.einsum("spq,sq->sp", self.hessian, change[self.columns])
        return self._expanded(local)

    @cached_property
    def _scores(self) -> Array:
        return self._expanded(self.score)

    @cached_property
    def diagonals(self) -> Array:
        """The information (S, P) of each stretch about each column by itself."""
        return self._expanded(np.einsum("spp->sp", self.hessian))

    def stretches(self, columns: Columns, change: Array, seconds: float) -> Stretches:
        """Return information and score of some columns in longer stretches, after a change (P,).

        Each flight is cut into equal stretches, as close to ``seconds`` as possible.
        """
        gradients, information, score = self.gradients(change), [], []
        for number in np.unique(self.flight):
            of_flight = np.flatnonzero(self.flight == number)
            columns_seen = self.columns[of_flight[0]]
            mine = np.flatnonzero(np.isin(columns, columns_seen))
            local = np.searchsorted(columns_seen, columns[mine])
            for part in np.array_split(
                of_flight, max(round(len(of_flight) * BLOCK_S / seconds), 1)
            ):
                square = np.zeros((len(columns), len(columns)))
                square[np.ix_(mine, mine)] = self.hessian[part].sum(axis=0)[np.ix_(local, local)]
                information.append(square)
                score.append(gradients[part].sum(axis=0)[columns])
        return Stretches(np.stack(information), np.stack(score))

    def _expanded(self, local: Array) -> Array:
        """Return rows (S, L) of the columns seen as rows (S, P), zero elsewhere."""
        rows = np.zeros((len(local), len(self.scaled)))
        np.put_along_axis(rows, self.columns, local, axis=1)
        return rows

    def step(
        self, free: Columns, *, inside: NDArray[np.bool_] | None = None, from_: Array | None = None
    ) -> Array:
        """Return the change (P,) that minimises the loss of some stretches.

        Parameters
        ----------
        free
            Columns that may move.
        inside
            (S,) which stretches are fitted; all by default.
        from_
            (P,) change that is given; zero by default.
        """
        free = np.sort(free)
        change = np.zeros(len(self.scaled)) if from_ is None else from_.copy()
        key = free.tobytes(), b"" if inside is None else inside.tobytes(), change.tobytes()
        if key not in self._steps:
            self._steps[key] = self._stepped(free, inside, change)
        return self._steps[key].copy()

    @cached_property
    def _steps(self) -> dict[tuple[bytes, ...], Array]:
        """What `step` was given, as bytes -> its result: all groups are scored beside one model."""
        return {}

    def _stepped(self, free: Columns, inside: NDArray[np.bool_] | None, change: Array) -> Array:
        hessian = self.information(inside) + self.prior
        score = (self._scores if inside is None else self._scores[inside]).sum(axis=0)
        slope = score + self.pull + hessian @ change
        square = hessian[np.ix_(free, free)]
        change[free] -= scaled_solve(square, slope[free], RIDGE)
        return change

    def change_of_loss(self, change: Array) -> Array:
        """Return by how much each stretch's loss (S,) changes."""
        key = change.tobytes()
        if key not in self._changes:
            local = change[self.columns]
            quadratic = (local * (self.hessian @ local[..., None])[..., 0]).sum(axis=1)
            self._changes[key] = (self.score * local).sum(axis=1) + 0.5 * quadratic
        return self._changes[key]

    @cached_property
    def _changes(self) -> dict[bytes, Array]:
        """A change, as bytes -> what `change_of_loss` makes of it."""
        return {}

    def folds(self, by: NDArray[np.intp]) -> Iterator[NDArray[np.bool_]]:
        """Return which stretches (S,) each fold leaves out."""
        for number in np.unique(by):
            yield by == number


@dataclass(frozen=True)
class LinearisedFit:
    """A fit with some groups added, and its loss linearised by all candidates.

    Attributes
    ----------
    fitted
        The fit; candidates that were not added are in its space at their neutral values.
    added
        The groups added.
    linear
        The loss about the fit, by the base model's coefficients and all candidates.
    """

    fitted: Fit
    added: Groups
    linear: LinearisedLoss


def linearise(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    *,
    offsets_fitted: NDArray[np.bool_],
    conditions: Sequence[str] = (),
    readings: Collection[Objective] = (),
) -> LinearisedLoss:
    """Return the linear approximation of a fit, from one Jacobian by all of its parameters.

    Secants replace derivatives of coefficients that act like another at their neutral values.

    Flights whose Jacobian would not fit half of the objective's memory take turns: reordering its
    columns copies them.

    Parameters
    ----------
    objective, point, criterion
        The fit. Its last conditions are those of ``conditions``.
    offsets_fitted
        (offsets, N) which offsets move with the others.
    conditions
        Names of conditions, whose columns follow those of the coefficients, N for each.
    readings
        The problem with readings of the battery's voltmeter drawn again.
    """
    parts, loss = [], 0.0
    half = replace(objective, memory=objective.memory // 2)
    for flights, batch in flight_batches(half, point, criterion):
        scale = batch[2].scale
        jacobian = with_secants(
            batch[0].jacobian(*batch[1:]),
            batch[0].space,
            batch[1],
            partial(batch[0].residuals, criterion=batch[2]),
        )
        fitted = offsets_fitted[: len(offsets_fitted) - len(conditions), flights]
        others = {
            str(number): flight_batch(other, point, criterion, flights)[0].residuals(*batch[1:])
            for number, other in enumerate(readings)
        }
        parts.append(
            information_at(
                *_with_free_conditions(*batch, jacobian, conditions),
                offsets_fitted=fitted,
                alternatives=others,
            )
        )
        loss += sum(
            0.5 * float(huber_loss(of / scale[name][batch[0].flight], criterion.huber).sum())
            for name, of in jacobian.residuals.items()
        )
    information = FisherInformation.joined(parts)
    rows = np.asarray(point.offsets)[len(point.offsets) - len(conditions) :]
    scaled = np.concatenate(
        [objective.space.scaled(point.coefficients), (rows * units_of(conditions)[:, None]).ravel()]
    )
    mean = np.concatenate([objective.space.prior_mean, np.zeros(rows.size)])
    names = (*objective.space.names, *(name for name in conditions for _ in rows[0]))
    neutral = np.concatenate([neutral_of(objective.space), np.zeros(rows.size)])
    return linearised_from(
        information,
        scaled,
        mean,
        loss,
        condition_count=len(conditions),
        names=names,
        neutral=neutral,
    )


def neutral_of(space: Space) -> Array:
    """Return the scaled neutral values (K,) of the terms' coefficients; zero for others."""
    rows = [(parameter, COEFFICIENTS[parameter.name].unselected) for parameter in space.parameters]
    return np.array(
        [
            0.0
            if value is None or (value <= 0.0 and parameter.scale == "log")
            else parameter.scaled(value)
            for parameter, value in rows
        ]
    )


def _with_free_conditions(
    objective: Objective,
    point: Point,
    criterion: Criterion,
    jacobian: Jacobian,
    conditions: Sequence[str],
) -> tuple[Objective, Point, Criterion, Jacobian]:
    """Return a problem in which some conditions are coefficients, and its Jacobian.

    Only its columns' order and scale are meaningful: do not simulate it.
    """
    if not conditions:
        return objective, point, criterion, jacobian
    count, offsets = len(objective.space), len(point.offsets)
    left = offsets - len(conditions)
    some = next(iter(jacobian.columns.values()))
    order = np.concatenate(
        [
            np.arange(count),
            np.arange(count + left, count + offsets),
            np.arange(count, count + left),
            np.arange(count + offsets, len(some)),
        ]
    )
    beside = [  # a unit step is that of a point's offsets
        Parameter(
            name=name,
            ratios={name: 1.0},
            initial=0.0,
            lower=-REGISTRY[name].prior_sd,
            upper=REGISTRY[name].prior_sd,
            scale="linear",
            prior_mean=0.0,
            prior_sd=REGISTRY[name].prior_sd,
            prior_given=False,
            unit_step=unit,
        )
        for name, unit in zip(conditions, units_of(conditions), strict=True)
    ]
    space = Space((*objective.space.parameters, *beside), objective.space.fixed)
    return (
        replace(objective, space=space, conditions=objective.conditions[: -len(conditions)]),
        Point(
            np.concatenate([np.asarray(point.coefficients), np.zeros(len(conditions))]),
            point.offsets[:left],
        ),
        criterion,
        replace(
            jacobian, columns={name: np.asarray(c)[order] for name, c in jacobian.columns.items()}
        ),
    )


def linearised_from(
    information: FisherInformation,
    scaled: Array,
    mean: Array,
    loss: float,
    *,
    condition_count: int = 0,
    names: tuple[str, ...] = (),
    neutral: Array | None = None,
) -> LinearisedLoss:
    """Return the linear approximation from the information at a point and its loss.

    Parameters
    ----------
    information
        The last ``condition_count`` of its coefficients are conditions.
    scaled, mean
        (P,) the point, and the mean of the priors: of K coefficients, then of each condition for
        each flight.
    loss
        Half the robust sum of squares.
    condition_count
        How many conditions.
    names, neutral
        As of `LinearisedLoss`.
    """
    size = information.score.shape[-1]
    count, flights = size - condition_count, int(information.flight.max()) + 1
    # windows that begin in the same stretch count as one: their residuals are as dependent as those
    # of a flight simulated whole
    blocks = information.begins[:, None] / BLOCK_S + np.arange(information.blocks.shape[2])
    numbers = np.floor(blocks + 1e-9).astype(np.intp)
    hessian, score, flight, number = information.in_stretches(numbers)
    section = np.minimum(number * FLIGHT_SECTIONS // (number.max() + 1), FLIGHT_SECTIONS - 1)
    flown = np.einsum("spp->s", hessian) > 0
    flight = flight[flown]
    of_prior = np.diag(information.prior)
    own = np.concatenate([of_prior[:count], np.repeat(of_prior[count:], flights)])
    prior = np.diag(own)
    prior[:count, :count] += information.nuisance_prior[:count, :count]
    columns_seen = np.hstack(
        [
            np.tile(np.arange(count), (len(flight), 1)),
            count + flights * np.arange(condition_count) + flight[:, None],
        ]
    )
    changes = np.array([change.across.sum(axis=(0, 2)) for change in information.changes.values()])
    readings = None
    if len(changes):
        readings = np.zeros((len(changes), len(scaled)))
        for segment, number_of in enumerate(information.flight):
            seen = [*range(count), *(count + flights * np.arange(condition_count) + number_of)]
            readings[:, seen] += changes[:, segment]
    return LinearisedLoss(
        scaled=scaled,
        hessian=hessian[flown],
        score=score[flown],
        prior=prior,
        pull=own * (scaled - mean),
        prior_sd=1.0 / np.sqrt(own),
        flight=flight,
        section=section[flown],
        loss=loss,
        columns_seen=columns_seen if condition_count else None,
        condition_columns=condition_count * flights,
        names=names,
        neutral=neutral,
        readings=readings,
    )


MAX_STEP_PRIOR_SD = 1.0
"""Prior standard deviations that a coefficient may move in one step: the linear range."""


def predicted_losses(
    fitted: Fit, linear: LinearisedLoss, model: Columns, own: Columns, scale: Mapping[str, Array]
) -> Array:
    """Return the loss (N,) of each flight with the coefficients of a fit to the others.

    One linear step leads from the joint fit to the fit without the flight; there the flight is
    simulated, and its own offsets follow. A single flight is simulated with the joint fit; the loss
    of its sections with fits to the others is that of the linear approximation.

    Parameters
    ----------
    fitted, linear
        The joint fit, and the loss about it.
    model, own
        Columns of ``linear`` that may move, and those of the fit's own space in its order.
    scale
        Channel -> (N,) factor on the standard deviations.
    """
    objective, criterion = fitted.objective, replace(fitted.criterion, scale=dict(scale))
    space, flight = objective.space, objective.flight
    movable, losses = offsets_fitted(fitted), []
    alone = objective.flights == 1
    for number in range(objective.flights):
        change = np.zeros(len(own))
        if not alone:
            change = linear.step(model, inside=linear.flight != number)[own]
        vector = vector_after(space, fitted.point.coefficients, change)
        sums = objective.sums(
            Point(vector, fitted.point.offsets),
            criterion,
            derivatives=bool(movable.any()),
            still=True,
        )
        inside = flight == number
        loss = float(np.asarray(sums.loss)[inside].sum())
        losses.append(loss - _gain_of_offsets(sums, inside, movable[:, number]))
    return np.array(losses) * (section_loss_ratio(linear, model) if alone else 1.0)


def section_loss_ratio(linear: LinearisedLoss, model: Columns) -> float:
    """Return the held-out loss of sections over their loss in the fit to all."""
    change = 0.0
    for out in linear.folds(linear.section):
        change += float(linear.change_of_loss(linear.step(model, inside=~out))[out].sum())
    return 1.0 + change / linear.loss


def vector_after(space: Space, vector: Array, change: Array) -> Array:
    """Return the search vector (K,) after a change of the scaled coordinates, inside the bounds."""
    far = MAX_STEP_PRIOR_SD * space.prior_sd
    scaled = space.scaled(vector) + np.clip(change, -far, far)
    return space.vector_at(scaled)


def offsets_fitted(fitted: Fit) -> NDArray[np.bool_]:
    """Return which offsets (offsets, N) a fit moved: those that are not exactly zero."""
    return np.asarray(np.asarray(fitted.point.offsets) != 0.0)


def _gain_of_offsets(
    sums: SegmentSums, inside: NDArray[np.bool_], movable: NDArray[np.bool_]
) -> float:
    """Return by how much a flight's loss falls when its offsets follow, in one linear step."""
    free = np.flatnonzero(movable)
    if not len(free):
        return 0.0
    gradient = np.asarray(sums.gradient)[free][:, inside].sum(axis=-1)
    hessian = np.asarray(sums.hessian)[np.ix_(free, free)][..., inside].sum(axis=-1)
    hessian = hessian + np.eye(len(free)) / OFFSET_SD**2
    return float(0.5 * gradient @ scaled_solve(hessian, gradient))
