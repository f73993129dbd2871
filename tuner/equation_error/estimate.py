"""Estimation of coefficients and terms from the accelerations of all flights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tuner.core.numerics import Array
from tuner.equation_error.model_accelerations import ModelAccelerations, values_at
from tuner.equation_error.recorded_accelerations import Commands, Mask, Steps
from tuner.equation_error.regression import (
    Regression,
    convolved,
    feedback_bias,
    minimised,
    regress,
    summing,
)
from tuner.objective.space import Space
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.model import Model, with_terms_computed
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

TORQUE_GAINS = ("torque_gain_x", "torque_gain_y", "torque_gain_z")
"""Factors on the moments that predict turning best: not part of the vehicle."""
THRUST_EXPONENT = "thrust_exponent"
"""Estimated from forces, where effects of airspeed on all rotors imitate it. Whether moments, which
are differences among rotors, follow the same exponent is not known."""
PREDICTION_S = 0.3
"""Time ahead for which `TORQUE_GAINS` are fitted: amid `HORIZONS_S`."""
HORIZONS_S = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
"""Times ahead at which predictions are compared with holding the state."""
TILTING = slice(3, 5)
"""Roll and pitch among the axes of accelerations."""


@dataclass(frozen=True)
class RegressionEstimate:
    """Estimates from recorded accelerations.

    Attributes
    ----------
    values
        Coefficient -> value: physical ones, and the `TORQUE_GAINS` with which these predict best.
    errors
        Coefficient -> standard error of its scaled coordinate, of the physical ones.
    explained
        (6,) share of the variance of recorded specific force and angular acceleration that the
        physical values explain; negative where they make it worse.
    turning
        Largest share of roll's and pitch's angular acceleration that any values explain, those of
        ordinary least squares: the rest are disturbances and noise.
    horizon
        s up to which a prediction of roll and pitch rate, along the recorded motion, is better than
        holding them; None if none is.
    """

    values: Mapping[str, float]
    errors: Mapping[str, float]
    rows: tuple[SelectionRow, ...]
    explained: Array
    turning: float
    horizon: float | None


def estimate(
    model: Model,
    space: Space,
    candidates: Groups,
    flights: Sequence[Steps],
    commands: Sequence[Commands] = (),
) -> RegressionEstimate:
    """Return the estimates from some flights' accelerations.

    Parameters
    ----------
    model
        Gives the fixed coefficients.
    space
        Free coefficients, those of candidates and `TORQUE_GAINS` among them, at neutral values.
    candidates
        Groups that are added if held-out flights are predicted better with them.
    commands
        All commands, and every second one, which shows the error by their times in between; none
        where rotor speeds were recorded.
    """
    absent = [n for n in space.free if COEFFICIENTS[n].is_effect and n not in model.vehicle.effects]
    made = ModelAccelerations(
        with_terms_computed(model, absent), space.parameters, tuple(flights), *commands[:1]
    )
    names = np.array(space.names)
    begin = np.array([p.scaled(p.initial) for p in space.parameters])
    acts = np.any([np.any(one.columns != 0.0, axis=(0, 1)) for one in made.at(begin)], axis=0)
    is_gain = np.isin(names, TORQUE_GAINS)
    free = acts & ~is_gain
    groups = {
        group: np.isin(names, members)
        for group, members in candidates.items()
        if np.all(free[np.isin(names, members)])
    }
    full = regress(made, begin, free=free)
    rows, out = _selected(full, groups, candidates, begin, free)
    free = free & ~out
    found = regress(made, np.where(out, begin, full.point), free=free, near=True)
    again = partial(regress, begin=found.point, free=free, near=True)
    others = [again(made, times=2)]
    if commands:
        others.append(again(replace(made, commands=commands[1])))
    of_power, by_squares = free & (names == THRUST_EXPONENT), found
    if of_power.any():
        of_squares = np.where(of_power, begin, found.point)
        by_squares = regress(made, of_squares, free=free & ~of_power, near=True)
    errors = np.sqrt(
        np.diag(found.covariance)
        + feedback_bias(made, found, free=free) ** 2
        + np.where(of_power, 0.0, by_squares.point - found.point) ** 2
        + np.where(free, full.point - found.point, 0.0) ** 2
        + sum((other.point - found.point) ** 2 for other in others)
    )
    predicted = minimised(
        made,
        found.point,
        lambda one: [summing(one.steps.step, PREDICTION_S)] * 6,
        mean=found.point,
        free=acts & is_gain,
    )

    def named(numbers: Array, which: Mask) -> dict[str, float]:
        rows = zip(space.parameters, numbers, which, strict=True)
        return {name: float(x) for p, x, is_in in rows if is_in for name in p.ratios}

    values, kept = values_at(space.parameters, predicted), named(errors, free | is_gain)
    return RegressionEstimate(
        values={name: values[name] for name in kept},
        errors=named(errors, free),
        rows=rows,
        explained=_explained_shares(made, found.point),
        turning=float(np.mean(_explained_shares(made, full.ordinary)[TILTING])),
        horizon=_horizon(made, predicted),
    )


def _selected(
    full: Regression, groups: Mapping[str, Mask], candidates: Groups, begin: Array, free: Mask
) -> tuple[tuple[SelectionRow, ...], Mask]:
    """Return the table of the groups, and which coordinates (K,) are eliminated.

    Backward elimination: the group goes first without which held-out units are predicted best, as
    long as they are not predicted worse by more than the scatter.
    """
    out, rows = np.zeros(len(free), bool), list[SelectionRow]()
    left = dict(groups)
    while left:
        whole = _held_out_losses(full, begin, free, out)
        gains = {
            group: _held_out_losses(full, begin, free, out | members) - whole
            for group, members in left.items()
        }
        worth = {
            group: (float(g.sum()), float(np.sqrt(len(g)) * g.std(ddof=1)))
            for group, g in gains.items()
        }
        worst = min(worth, key=lambda group: worth[group][0] - worth[group][1])
        gain, scatter = worth[worst]
        if gain > scatter:
            rows += [_row(group, candidates, *worth[group], full, kept=True) for group in left]
            break
        rows.append(_row(worst, candidates, gain, scatter, full, kept=False))
        out = out | left.pop(worst)
    return tuple(sorted(rows, key=lambda row: (not row.kept, -(row.gain_holdout or 0.0)))), out


def _held_out_losses(full: Regression, begin: Array, free: Mask, out: Mask) -> Array:
    """Return each unit's (U,) loss with a fit to the others, ``out`` at their start values."""
    away = np.where(out, begin - full.point, 0.0)
    units = np.eye(len(full.sums.slope), dtype=bool)
    return np.concatenate(
        [full.sums.losses(full.sums.solved(free & ~out, ~unit, away), unit) for unit in units]
    )


def _row(
    group: str, candidates: Groups, gain: float, scatter: float, full: Regression, *, kept: bool
) -> SelectionRow:
    whole = float(full.sums.loss.sum())
    return SelectionRow(
        group=group,
        names=candidates[group],
        gain_holdout=gain / whole,
        scatter=scatter / whole,
        kept=kept,
        reason=SelectionCode.PREDICTS_FLIGHTS if kept else SelectionCode.NOT_PREDICTED,
    )


def _explained_shares(made: ModelAccelerations, point: Array) -> Array:
    """Return the explained shares (6,) of the variance of recorded accelerations."""
    linear = made.at(point)
    left = np.concatenate([one.errors[one.steps.known] for one in linear])
    there = np.concatenate([one.steps.accelerations[one.steps.known] for one in linear])
    return np.asarray(1.0 - np.mean(left**2, axis=0) / there.var(axis=0))


def _horizon(made: ModelAccelerations, point: Array) -> float | None:
    """Return the s up to which predictions of roll and pitch rate are better than holding them."""
    linear, reached = made.at(point), None
    for seconds in HORIZONS_S:
        missed, turned = np.sum(
            [
                [
                    np.sum(convolved(rows[:, TILTING], one.steps.known, kernel) ** 2)
                    for rows in (one.errors, one.steps.accelerations)
                ]
                for one in linear
                for kernel in [summing(one.steps.step, seconds)]
            ],
            axis=0,
        )
        if missed >= turned:
            break
        reached = seconds
    return reached
