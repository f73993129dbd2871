"""What a reader should know before believing a number."""

from __future__ import annotations

from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.wording.findings import remedy, sentence


def findings(contents: Contents) -> Section | None:
    """Return what was noticed before, during and after the search, as sentences."""
    rows = [
        {
            "level": finding.level,
            "subject": finding.subject,
            "sentence": sentence(finding),
            "remedy": remedy(finding),
        }
        for finding in contents.about.findings
    ]
    title = "What to know before believing a number"
    return Section("findings", title, {"findings": rows}) if rows else None
