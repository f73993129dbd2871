"""The second answer: the coefficients with which Gazebo flies most like the vehicle."""

from __future__ import annotations

from tuner.coefficients import COEFFICIENTS
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.wording.phrases import percent
from tuner.wording.result import effective_in_words, rmse_in_words


def effective(contents: Contents) -> Section | None:
    """Return both answers beside each other, and what each term that is lost is worth."""
    found = None if contents.run is None else contents.run.result.effective
    if contents.run is None or found is None:
        return None
    physical = {name: row.best for name, row in contents.run.result.coefficients.items()}
    rows = [
        {
            "name": name,
            "unit": COEFFICIENTS[name].unit,
            "physical": physical[name],
            "effective": value,
            "change": _change(physical[name], value),
        }
        for name, value in found.coefficients.items()
        if name in physical and value != physical[name]
    ]
    lost = [
        {"group": term.group, "names": term.names, "rmse": rmse_in_words(term.rmse_without)}
        for term in found.lost
    ]
    values = {"sentence": effective_in_words(found), "rows": rows, "lost": lost}
    return Section("effective", "In Gazebo", values)


def _change(before: float, after: float) -> str:
    if before == 0.0:
        return "–"
    share = after / before - 1.0
    return f"{'+' if share > 0 else '−'}{percent(abs(share))}"
