"""The selection of terms in words: what a group is worth, and why it is in the model or not."""

from __future__ import annotations

from collections.abc import Sequence

from tuner.selection.table import SelectionCode, SelectionRow
from tuner.wording.phrases import listed, percent

_REASONS = {
    SelectionCode.PREDICTS_FLIGHTS: "flights left out of the fit are predicted better with it",
    SelectionCode.PREDICTS_SECTIONS: "sections of flights left out of the fit are predicted better "
    "with it; no single flight is by the others",
    SelectionCode.SIGNIFICANT: "chance does not explain what it is worth, and no flight left out "
    "of the fit contradicts it",
    SelectionCode.ASKED_FOR: "the job file names it",
    SelectionCode.HOVERS_TILTED: "every recording shows a hover that is not level",
    SelectionCode.NOT_SIGNIFICANT: "residuals that are correlated in time gain as much from chance",
    SelectionCode.IMMATERIAL: "it lowers the loss by less than simulators of one vehicle differ",
    SelectionCode.NOT_PREDICTED: "flights left out of the fit are not predicted better by more "
    "than the scatter",
    SelectionCode.NO_INFORMATION: "the flights do not distinguish it from the coefficients in the "
    "model",
    SelectionCode.WORSE_AFTER_REFIT: "fitted again with it, flights left out of the fit are not "
    "predicted better",
}


def reason_in_words(row: SelectionRow) -> str:
    """Return why a group is in the model or not, as a clause."""
    return _REASONS[row.reason]


def gain_in_words(gain: float | None) -> str:
    """Return a gain as a share of the loss in percent; a dash where it was not computed."""
    if gain is None:
        return "–"
    return percent(gain) if abs(gain) >= 1e-4 else "0 %"


def selection_in_words(rows: Sequence[SelectionRow]) -> str:
    """Return a sentence on which groups of terms were added; empty where none was asked."""
    if not rows:
        return ""
    kept = [row.group for row in rows if row.kept]
    if not kept:
        return "The flights do not call for any term beyond Gazebo's motor model."
    return f"Added to Gazebo's motor model: {listed(kept)}."
