"""What explains a fit: findings, each told once, and parts that may fail without the rest."""

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
    """What is computed of a fit once it is found, and what is noticed on the way.

    Parameters
    ----------
    on_message
        Gets each finding at once, as a line.

    Attributes
    ----------
    findings
        Those that came up after the search.
    """

    def __init__(self, on_message: Callable[[str], None]) -> None:
        self._on_message = on_message
        self._told: list[Finding] = []
        self.findings: tuple[Finding, ...] = ()

    def tell(self, findings: Sequence[Finding]) -> None:
        """Report findings, all but those that already were."""
        for finding in findings:
            if finding not in self._told:
                self._told.append(finding)
                self._on_message(one_line(finding))

    def notice(self, findings: Sequence[Finding]) -> None:
        """Keep findings, and report them."""
        self.tell(findings)
        self.findings = (*self.findings, *findings)

    def part(self, name: str, compute: Callable[[], T], otherwise: T) -> T:
        """Return what a part comes to, or something else where it fails, which is a finding.

        Parameters
        ----------
        name
            Of the part, as a user and a profile read it.
        compute
            Computes it.
        otherwise
            What a run goes on with where that fails.

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
            self.notice([Finding(Code.PART_FAILED, "warning", name, names=names)])
            return otherwise
