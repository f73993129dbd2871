"""What the accelerations of all flights say of a vehicle: coefficients, terms, shares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tuner.core.numerics import Array
from tuner.equation_error.command_accelerations import CommandAccelerations, Commands
from tuner.equation_error.measured import Mask, Measured
from tuner.equation_error.model import Accelerations, ModelAccelerations, values_at
from tuner.equation_error.regression import (
    MEMORY,
    Regression,
    adding,
    convolved,
    predicting,
    regress,
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
AHEAD = 0.3
"""s over which `GAINS` are fitted to predict: between those at which predictions are compared."""
HORIZONS = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5)
"""s over which predictions are compared with holding the state."""
FORCES, TILTING = slice(0, 3), slice(3, 5)
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
    flights: Sequence[Measured],
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
    model = with_terms_computed(model, [n for n in space.free if _may_be_absent(model, n)])
    parts, noisy = tuple(flights), not commands
    made: ModelAccelerations = (
        Accelerations(model, space.parameters, parts)
        if noisy
        else CommandAccelerations(model, space.parameters, commands[0], parts)
    )
    names = np.array(space.names)
    begin = np.array([p.scaled(p.initial) for p in space.parameters])
    acts = np.any(
        [np.any(one.columns != 0.0, axis=(0, 1)) for one in made.at(begin, noise=False)], axis=0
    )
    free = acts & ~np.isin(names, GAINS)
    groups = {
        group: np.isin(names, members)
        for group, members in candidates.items()
        if np.all(free[np.isin(names, members)])
    }
    full = regress(made, begin, free=free, noisy=noisy)
    rows, out = _selected(full, groups, candidates, begin, free)
    free = free & ~out
    near = partial(regress, made, free=free, near=True)
    found = near(np.where(out, begin, full.point), noisy=noisy)
    halved = near(found.point, memory=0.5 * MEMORY, noisy=noisy)
    noiseless = near(found.point, noisy=False) if noisy else found
    coarser = found
    if commands:
        seldom = CommandAccelerations(model, space.parameters, commands[1], parts)
        coarser = regress(seldom, found.point, free=free, near=True, noisy=False)
    errors = np.sqrt(
        np.diag(found.covariance)
        + (halved.point - found.point) ** 2
        + np.where(free, full.point - found.point, 0.0) ** 2
        + (NOISE_KNOWN * (noiseless.point - found.point)) ** 2
        + (coarser.point - found.point) ** 2
    )
    predicted = predicting(made, found.point, free=acts & np.isin(names, GAINS), seconds=AHEAD)
    values = values_at(space.parameters, predicted)
    kept = {name for name, is_in in zip(names, free | np.isin(names, GAINS), strict=True) if is_in}
    return Estimate(
        values={
            name: values[name] for p in space.parameters if p.name in kept for name in p.ratios
        },
        errors={
            name: float(error)
            for p, error, is_in in zip(space.parameters, errors, free, strict=True)
            if is_in
            for name in p.ratios
        },
        rows=rows,
        explained=_explained(made, found.point),
        horizon=_horizon(made, predicted),
    )


def _may_be_absent(model: Model, name: str) -> bool:
    return COEFFICIENTS[name].is_effect and name not in model.vehicle.effects


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
        worth = {group: (float(g.sum()), _scatter(g)) for group, g in gains.items()}
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
    count = len(full.sums.slope)
    away = np.where(out, begin - full.point, 0.0)
    losses = []
    for unit in range(count):
        others = np.arange(count) != unit
        change = full.sums.solved(full.prior, full.pull, free=free & ~out, units=others, moved=away)
        losses.append(full.sums.losses(change, ~others)[0])
    return np.array(losses)


def _scatter(gains: Array) -> float:
    """Return the standard deviation of a sum over units."""
    return float(np.sqrt(len(gains)) * gains.std(ddof=1))


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
    left, there = [], []
    for one, part in zip(made.at(point, noise=False), made.flights, strict=True):
        left.append(one.left[part.known])
        there.append(part.accelerations[part.known])
    varies = np.concatenate(there).var(axis=0)
    return np.asarray(1.0 - np.mean(np.concatenate(left) ** 2, axis=0) / varies)


def _horizon(made: ModelAccelerations, point: Array) -> float | None:
    """Return the s up to which predictions of roll and pitch rate beat holding them."""
    linear, reached = made.at(point, noise=False), None
    for seconds in HORIZONS:
        squares = np.zeros(2)
        for one, part in zip(linear, made.flights, strict=True):
            kernel = adding(part, seconds)[0]
            for place, rows in enumerate((one.left, part.accelerations)):
                squares[place] += np.sum(convolved(rows[:, TILTING], part.known, kernel) ** 2)
        if squares[0] >= squares[1]:
            break
        reached = seconds
    return reached
