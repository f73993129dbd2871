"""Records of a selection of terms: the fit under way, its table, and what it ends with."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from sim_jax.numeric import Array
from tuner.objective.normal import Objective
from tuner.search.fitted import Fitted
from tuner.search.problem import Job
from tuner.terms.linearisation import Linear
from tuner.terms.score import EARNING, Score
from tuner.vehicle.selection_table import Groups, SelectionCode, SelectionRow


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


@dataclass(frozen=True)
class Selected:
    """A job and its fit with the terms that were kept, and the table of all that were tried.

    Attributes
    ----------
    in_doubt
        Coefficient -> how far it would move, in the scaled coordinate, with terms that were tried
        and not kept; empty where none was tried.
    base
        Job and fit without any of them; None where none was tried.
    """

    job: Job
    fitted: Fitted
    rows: tuple[SelectionRow, ...] = ()
    in_doubt: Mapping[str, float] = field(default_factory=dict)
    base: tuple[Job, Fitted] | None = None

    @property
    def kept(self) -> tuple[str, ...]:
        """The groups that are in the fit."""
        return tuple(row.group for row in self.rows if row.kept)

    @property
    def left_out(self) -> tuple[tuple[str, ...], ...]:
        """Names of each group that was tried and not kept, if the flights say anything of it."""
        return tuple(
            row.names
            for row in self.rows
            if not row.kept and row.reason is not SelectionCode.NO_INFORMATION
        )

    def rows_given(self, held: Mapping[str, str]) -> tuple[SelectionRow, ...]:
        """Return the table once coefficients are held: a term that was chosen and is, is out.

        ``held`` is a coefficient -> its stand-in, as of `tuner.search.fitted.Fitted`.
        """
        return tuple(
            row.model_copy(update={"kept": False, "reason": SelectionCode.NO_INFORMATION})
            if row.reason in EARNING and all(held.get(name) == name for name in row.names)
            else row
            for row in self.rows
        )


@dataclass(frozen=True)
class LinearisedFit:
    """A fit with some groups in it, seen in linear approximation by all that could be in it.

    Attributes
    ----------
    fitted
        The fit; coefficients that only fill its space up stay at their neutral values.
    added
        Groups in it.
    linear
        The loss about it, by the base model's coefficients and all candidates.
    """

    fitted: Fitted
    added: Groups
    linear: Linear


def offsets_of(fitted: Fitted, objective: Objective, *, gone: Collection[str] = ()) -> Array:
    """Return a fit's offsets, without some, as the rows of another problem of the same flights."""
    rows = np.asarray(fitted.point.offsets)
    known = dict(zip(fitted.objective.of_flight, rows, strict=True))
    known = {name: row for name, row in known.items() if name not in gone}
    nothing = np.zeros(rows.shape[1])
    return np.asarray(np.stack([known.get(name, nothing) for name in objective.of_flight]))
