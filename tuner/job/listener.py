"""Callbacks for the progress of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tuner.config import Settings
    from tuner.findings.findings import Finding
    from tuner.search.iteration import Iteration, PointEstimate
    from tuner.uncertainty.records import Refit


@dataclass(frozen=True)
class Listener:
    """Callbacks of a run.

    Attributes
    ----------
    on_settings
        Gets the settings, before anything is read.
    on_iteration
        Gets each iteration of the search, and its remaining s (NaN where unknown).
    on_estimates
        Gets the estimates of the base model, long before intervals and validation.
    on_message
        Gets a sentence on the next step, or a finding as a line.
    on_doubt
        Gets a finding before the search that files contradict the flights.
    on_stop
        Gets a sentence on how to go on, where the run was interrupted.
    on_folds
        Gets the cross-validation's folds.
    """

    on_settings: Callable[[Settings], None] = lambda _: None
    on_iteration: Callable[[Iteration, float], None] = lambda *_: None
    on_estimates: Callable[[Sequence[PointEstimate]], None] = lambda _: None
    on_message: Callable[[str], None] = lambda _: None
    on_doubt: Callable[[Finding], None] = lambda _: None
    on_stop: Callable[[str], None] = lambda _: None
    on_folds: Callable[[Sequence[Refit]], None] = lambda _: None


SILENT = Listener()
