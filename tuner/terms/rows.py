"""A row of a selection's table, from what a group is worth."""

from __future__ import annotations

from tuner.terms.score import Score
from tuner.vehicle.selection_table import SelectionCode, SelectionRow


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
