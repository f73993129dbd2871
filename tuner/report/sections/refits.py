"""Standard errors by refits to other flights, beside those of one fit."""

from __future__ import annotations

from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.wording.result import refits_in_words


def refits(contents: Contents) -> Section | None:
    """Return a table of the errors by jackknife and bootstrap, where they were asked for."""
    if contents.run is None:
        return None
    result = contents.run.result
    rows = [
        {"name": name, "found": found}
        for name, found in result.coefficients.items()
        if found.jackknife_error is not None or found.bootstrap_error is not None
    ]
    if not rows:
        return None
    return Section(
        "refits", "Refits to other flights", {"rows": rows, "said": refits_in_words(result)}
    )
