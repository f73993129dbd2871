"""The table of a selection, as ``result.json`` holds it: codes and numbers, no prose.

Sentences are made from them in `tuner.report.result_texts`.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from tuner.core.files import Part

Groups = Mapping[str, tuple[str, ...]]
"""Group -> its coefficients."""


class SelectionCode(StrEnum):
    """Why a group of coefficients is in the model, or is not."""

    PREDICTS_FLIGHTS = "predicts_flights"
    """Kept: each flight is predicted better by a fit to the others that holds it."""
    PREDICTS_SECTIONS = "predicts_sections"
    """Kept: sections of the flights are, where one flight alone shows it."""
    SIGNIFICANT = "significant"
    """Kept: it is significant, and no data left out contradict it."""
    PREDICTS_SAMPLES = "predicts_samples"
    """Kept: once disturbances are estimated, each sample is predicted better with it."""
    ASKED_FOR = "asked_for"
    """Kept: the job file names it."""
    OPEN_LOOP = "open_loop"
    """Kept: inputs are fed in below the loop that would hide it."""
    HOVERS_TILTED = "hovers_tilted"
    """Kept: every recording shows a hover that is not level, so the markers sit at an angle."""
    NOT_SIGNIFICANT = "not_significant"
    """It lowers the loss by no more than chance, with correlated residuals."""
    IMMATERIAL = "immaterial"
    """It lowers the loss by less than simulators that agree differ."""
    NOT_PREDICTED = "not_predicted"
    """Data left out of the fit are not predicted significantly better."""
    NO_INFORMATION = "no_information"
    """It is confounded with the coefficients in the model."""
    WORSE_AFTER_REFIT = "worse_after_refit"
    """Refitted with it, the flights left out are not predicted better."""
    REFUTED = "refuted"
    """Recorded commands answer the recorded rates with the gains of the controller file."""


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
