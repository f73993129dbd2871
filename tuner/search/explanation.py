"""The findings of a fit, each reported once, and parts of a run that may fail by themselves."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from typing import TypeVar

from tuner.core.errors import EngineError, OutputError
from tuner.core.spans import span
from tuner.findings.findings import Code, Finding, one_line

logger = logging.getLogger(__name__)

T = TypeVar("T")


class Explanation:
    """Findings of a fit, and parts of its examination.

    Parameters
    ----------
    on_message
        Gets each finding at once, as a line.

    Attributes
    ----------
    findings
        Findings after the search.
    """

    def __init__(self, on_message: Callable[[str], None]) -> None:
        self._on_message = on_message
        self._reported: list[Finding] = []
        self.findings: tuple[Finding, ...] = ()

    def report(self, findings: Sequence[Finding]) -> None:
        """Report findings that were not reported yet."""
        for finding in findings:
            if finding not in self._reported:
                self._reported.append(finding)
                self._on_message(one_line(finding))

    def add(self, findings: Sequence[Finding]) -> None:
        """Keep findings, and report them."""
        self.report(findings)
        self.findings = (*self.findings, *findings)

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
            logger.error("%s failed", name, exc_info=error)
            names = (type(error).__name__, " ".join(str(error).split())[:200])
            self.add([Finding(Code.PART_FAILED, "warning", name, names=names)])
            return fallback
