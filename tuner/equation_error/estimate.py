"""What the accelerations of all flights say of a vehicle: coefficients, terms, shares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from tuner.core.numerics import Array
from tuner.equation_error.model_accelerations import ModelAccelerations, values_at
from tuner.equation_error.recorded_accelerations import Commands, Mask, Steps
from tuner.equation_error.regression import (
    MEMORY,
    Regression,
    convolved,
    minimised,
    misled,
    regress,
    summing,
)
from tuner.objective.space import Space
from tuner.vehicle import COEFFICIENTS
from tuner.vehicle.model import Model, with_terms_computed
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow

GAINS = ("torque_gain_x", "torque_gain_y", "torque_gain_z")
"""What of a moment predicts turning: no part of the vehicle."""
NOISE_KNOWN = 0.25
"""Share of what the noise of rotor speeds makes of a coefficient by which that may be wrong: a
guess, for noise that is not white or not as large as samples say."""
POWER = "thrust_exponent"
"""Forces tell it, and in them what air does to all rotors of a vehicle that flies faster the faster
they turn passes for it. Moments are of differences among rotors: that these follow it as well is
not known."""
AHEAD = 0.3
"""s over which `GAINS` are fitted to predict: between those at which predictions are compared."""
HORIZONS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
"""s over which predictions are compared with holding the state."""
TILTING = slice(3, 5)
"""Axes of accelerations."""


@dataclass(frozen=True)
class Estimate:
    """What recorded accelerations say, before anything is simulated.

    Attributes
    ----------
    values
        Coefficient -> value: physical ones without regard to what predicts best, and `GAINS` at
        which they predict best.
    errors
        Coefficient -> standard error of its scaled coordinate, of the physical ones.
    explained
        (6,) share of the recorded specific force and angular acceleration, axis by axis, that the
        physical values explain; below zero where they make it worse.
    horizon
        s up to which a prediction of roll and pitch rate, along the recorded motion, beats that
        they stay; None if none does.
    """

    values: Mapping[str, float]
    errors: Mapping[str, float]
    rows: tuple[SelectionRow, ...]
    explained: Array
    horizon: float | None

    @property
    def turning(self) -> float:
        """The share of roll's and pitch's angular acceleration that is explained."""
        return float(np.mean(self.explained[TILTING]))


def estimate(
    model: Model,
    space: Space,
    candidates: Groups,
    flights: Sequence[Steps],
    commands: Sequence[Commands] = (),
) -> Estimate:
    """Return what some flights' accelerations say.

    Parameters
    ----------
    model
        Holds what does not move.
    space
        Free coefficients, those of candidates and `GAINS` among them, at neutral values.
    candidates
        Groups that are added if flights left out are predicted better with them.
    commands
        Where rotors follow these: all, and every second, which tells what is not known of the time
        between two.
    """
    absent = [n for n in space.free if COEFFICIENTS[n].is_effect and n not in model.vehicle.effects]
    made = ModelAccelerations(
        with_terms_computed(model, absent), space.parameters, tuple(flights), *commands[:1]
    )
    names, quiet = np.array(space.names), made.noiseless
    begin = np.array([p.scaled(p.initial) for p in space.parameters])
    acts = np.any([np.any(one.columns != 0.0, axis=(0, 1)) for one in quiet.at(begin)], axis=0)
    is_gain = np.isin(names, GAINS)
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
    others = [(1.0, again(made, memory=times * MEMORY)) for times in (0.5, 2.0)]
    as_read = again(quiet) if made.noisy else found
    others.append((NOISE_KNOWN, as_read))
    if commands:
        others.append((1.0, again(replace(made, commands=commands[1]))))
    of_power, by_squares = free & (names == POWER), as_read
    if of_power.any():
        of_squares = np.where(of_power, begin, as_read.point)
        by_squares = regress(quiet, of_squares, free=free & ~of_power, near=True)
    errors = np.sqrt(
        np.diag(found.covariance)
        + misled(quiet, found, free=free, memory=MEMORY) ** 2
        + np.where(of_power, 0.0, by_squares.point - as_read.point) ** 2
        + np.where(free, full.point - found.point, 0.0) ** 2
        + sum((share * (other.point - found.point)) ** 2 for share, other in others)
    )
    predicted = minimised(
        quiet,
        found.point,
        lambda one: [summing(one.steps.step, AHEAD)] * 6,
        mean=found.point,
        free=acts & is_gain,
    )

    def named(numbers: Array, which: Mask) -> dict[str, float]:
        rows = zip(space.parameters, numbers, which, strict=True)
        return {name: float(x) for p, x, is_in in rows if is_in for name in p.ratios}

    values, kept = values_at(space.parameters, predicted), named(errors, free | is_gain)
    return Estimate(
        values={name: values[name] for name in kept},
        errors=named(errors, free),
        rows=rows,
        explained=_explained(quiet, found.point),
        horizon=_horizon(quiet, predicted),
    )


def _selected(
    full: Regression,
    groups: Mapping[str, Mask],
    candidates: Groups,
    begin: Array,
    free: Mask,
) -> tuple[tuple[SelectionRow, ...], Mask]:
    """Return the table of the groups, and which coordinates (K,) are none of the model.

    Backward elimination: of the groups the one goes first without which units that were left out
    are predicted best, as long as they are not predicted worse by more than the scatter.
    """
    out, rows = np.zeros(len(free), bool), list[SelectionRow]()
    left = dict(groups)
    while left:
        whole = _left_out(full, begin, free, out)
        gains = {
            group: _left_out(full, begin, free, out | members) - whole
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


def _left_out(full: Regression, begin: Array, free: Mask, out: Mask) -> Array:
    """Return each unit's (U,) loss with what meets the others, some coordinates at the start."""
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


def _explained(made: ModelAccelerations, point: Array) -> Array:
    """Return the shares (6,) of recorded accelerations that are explained."""
    linear = made.at(point)
    left = np.concatenate([one.left[one.steps.known] for one in linear])
    there = np.concatenate([one.steps.accelerations[one.steps.known] for one in linear])
    return np.asarray(1.0 - np.mean(left**2, axis=0) / there.var(axis=0))


def _horizon(made: ModelAccelerations, point: Array) -> float | None:
    """Return the s up to which predictions of roll and pitch rate beat holding them."""
    linear, reached = made.at(point), None
    for seconds in HORIZONS:
        missed, turned = np.sum(
            [
                [
                    np.sum(convolved(rows[:, TILTING], one.steps.known, kernel) ** 2)
                    for rows in (one.left, one.steps.accelerations)
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
