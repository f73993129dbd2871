"""Ground measurements beside flights: each alone, and both."""

from __future__ import annotations

from tuner.coefficients import COEFFICIENTS
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.uncertainty.sources import CONFLICT


def sources(contents: Contents) -> Section | None:
    """Return a table of what the ground, the flights and both give."""
    if contents.run is None or not contents.run.result.sources:
        return None
    rows = [
        {
            "name": name,
            "unit": COEFFICIENTS[name].unit,
            "source": source,
            "conflict": source.deviation is not None and abs(source.deviation) > CONFLICT,
        }
        for name, source in contents.run.result.sources.items()
    ]
    return Section("sources", "Ground and flights", {"rows": rows})
