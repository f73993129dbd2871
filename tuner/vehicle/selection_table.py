"""The table of a selection, as ``result.json`` holds it: codes and numbers, no prose."""

from __future__ import annotations

from collections.abc import Mapping

from tuner.core.files import Part
from tuner.core.phrases import CodeWithText

Groups = Mapping[str, tuple[str, ...]]
"""Group -> its coefficients."""


class SelectionCode(CodeWithText):
    """Why a group of coefficients is in the model, or is not; texts are clauses on the group."""

    # kept
    PREDICTS_FLIGHTS = (
        "predicts_flights",
        "flights left out of the fit are predicted better with it",
    )
    PREDICTS_SECTIONS = (
        "predicts_sections",
        (
            "sections of flights left out of the fit are predicted better with it, where no flight "
            "is by others"
        ),
    )
    SIGNIFICANT = (
        "significant",
        (
            "chance does not explain what it is worth, and no flight left out of the fit "
            "contradicts it"
        ),
    )
    PREDICTS_SAMPLES = (
        "predicts_samples",
        (
            "once disturbances are estimated, samples are predicted better with it by more than "
            "chance"
        ),
    )
    ASKED_FOR = "asked_for", "the job file names it"
    OPEN_LOOP = (
        "open_loop",
        "it is from the beginning: inputs are fed in below the loop that would hide it",
    )
    HOVERS_TILTED = "hovers_tilted", "every recording shows a hover that is not level"
    # not kept
    NOT_SIGNIFICANT = (
        "not_significant",
        "residuals that are correlated in time gain as much from chance",
    )
    IMMATERIAL = (
        "immaterial",
        "it lowers the loss by less than simulators of one vehicle differ",
    )
    NOT_PREDICTED = (
        "not_predicted",
        "flights left out of the fit are not predicted better by more than the scatter",
    )
    NO_INFORMATION = (
        "no_information",
        "the flights do not distinguish it from the coefficients in the model",
    )
    WORSE_AFTER_REFIT = (
        "worse_after_refit",
        "fitted again with it, flights left out of the fit are not predicted better",
    )
    REFUTED = "refuted", "recorded commands have the gains of the controller file"


class SelectionRow(Part):
    """One group of coefficients, beside the model that the selection ended with.

    Attributes
    ----------
    group, names
        Its name, and its coefficients.
    gain_fit
        Share by which it lowers the loss of the fitted flights.
    gain_holdout
        Share by which it lowers the loss of data left out of a fit; None if not computed.
    scatter
        Standard deviation of ``gain_holdout`` over stretches of the flights.
    kept
        Whether it is in the model.
    reason
        Why.
    """

    group: str
    names: tuple[str, ...]
    gain_fit: float | None = None
    gain_holdout: float | None = None
    scatter: float | None = None
    kept: bool
    reason: SelectionCode
