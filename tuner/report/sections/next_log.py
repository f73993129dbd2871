"""What to log next time."""

from __future__ import annotations

from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.wording.proposals import next_log_in_words


def next_log(contents: Contents) -> Section | None:
    """Return what other signals, or more samples, would narrow."""
    if contents.run is None or not contents.run.result.next_log:
        return None
    sentences = next_log_in_words(contents.run.result.next_log)
    return Section("next_log", "What to log next time", {"sentences": sentences}, [])
