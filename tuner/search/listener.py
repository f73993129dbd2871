"""Reports of a run: its iterations, starts, estimates and findings, and their listener."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from tuner.core.errors import EngineError, OutputError
from tuner.core.files import FiniteOrNone, Part
from tuner.core.spans import span
from tuner.findings.findings import Code, Finding, one_line

if TYPE_CHECKING:
    from tuner.config import Settings
    from tuner.search.problem import Job
    from tuner.search.progress import Progress

T = TypeVar("T")


class Iteration(Part):
    """One step of a search.

    Attributes
    ----------
    stage
        Name of the stage of the continuation.
    number
        Counts all iterations of the search.
    loss
        Half the mean squared residual after the step, in (scaled) standard deviations.
    position_rmse
        m, over all fitted flights up to the horizon, at the point tried; None where no position
        is compared.
    accepted
        Whether the step was kept.
    horizon
        s.
    damping
        λ of the Levenberg-Marquardt step that follows, relative to the Hessian per compared value;
        None for CMA-ES.
    """

    stage: str
    number: int
    loss: float
    position_rmse: FiniteOrNone
    accepted: bool
    horizon: float
    damping: FiniteOrNone = None


class Outcome(Part):
    """The end of one start of a search.

    Attributes
    ----------
    origin
        ``vehicle file`` or ``random``.
    loss
        At the end, on whole flights, in the final weights.
    start, end
        Coefficient -> value at the beginning and at the end, in its unit.
    """

    origin: str
    loss: FiniteOrNone
    start: dict[str, float]
    end: dict[str, float]


class PointEstimate(Part):
    """A coefficient where a search ended.

    Attributes
    ----------
    name
        Of the coefficient.
    unit
        Of both numbers.
    initial
        Value in the vehicle or controller file.
    estimate
        Value where the search ended.
    """

    name: str
    unit: str
    initial: float
    estimate: float


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
        Gets the cross-validation's folds, `tuner.uncertainty.records.Refit`.
    """

    on_settings: Callable[[Settings], None] = lambda _: None
    on_iteration: Callable[[Iteration, float], None] = lambda *_: None
    on_estimates: Callable[[Sequence[PointEstimate]], None] = lambda _: None
    on_message: Callable[[str], None] = lambda _: None
    on_doubt: Callable[[Finding], None] = lambda _: None
    on_stop: Callable[[str], None] = lambda _: None
    on_folds: Callable[[Sequence[Any]], None] = lambda _: None


SILENT = Listener()


class Reporter:
    """Reports a run to a listener, each finding once and at once.

    Attributes
    ----------
    on_progress
        Gets job and progress after each iteration of a search.
    findings
        Findings after the search.
    """

    def __init__(self, listener: Listener = SILENT) -> None:
        self.listener, self.on_message = listener, listener.on_message
        self.on_progress: Callable[[Job, Progress], None] = lambda *_: None
        self._reported: list[Finding] = []
        self.findings: tuple[Finding, ...] = ()

    def report(self, findings: Sequence[Finding]) -> None:
        """Report findings that were not reported yet."""
        for finding in findings:
            if finding not in self._reported:
                self._reported.append(finding)
                self.on_message(one_line(finding))

    def add(self, findings: Iterable[Finding]) -> None:
        """Keep findings, and report them."""
        added = tuple(findings)
        self.report(added)
        self.findings += added

    def attempt(self, name: str, compute: Callable[[], T], fallback: T) -> T:
        """Return the result of a part, or a fallback and a finding where it fails.

        Parameters
        ----------
        name
            Name of the part in messages and profiles.
        compute
            Computes the result.
        fallback
            Returned where that fails.

        Raises
        ------
        OutputError, EngineError
            The disk is full, or workers are gone.
        """
        try:
            with span(name):
                return compute()
        except (OutputError, EngineError):
            raise
        except Exception as error:
            logging.getLogger(__name__).error("%s failed", name, exc_info=error)
            text = " ".join(str(error).split())[:200]
            self.add([Code.PART_FAILED.warning(name, type(error).__name__, text)])
            return fallback
