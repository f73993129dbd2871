"""What a reader should know before believing a number."""

from __future__ import annotations

from tuner.report.contents import Contents
from tuner.report.section import Section


def findings(contents: Contents) -> Section | None:
    """Return what was noticed before and during the search."""
    noticed = contents.about.settings.get("findings", [])
    if not noticed:
        return None
    return Section("findings", "What to know before believing a number", {"findings": noticed})
