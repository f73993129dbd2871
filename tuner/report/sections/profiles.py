"""How the likelihood falls when one coefficient is held and the others are fitted again."""

from __future__ import annotations

from tuner.report.chart import FITTED, GREY, Chart, Line, Look, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.uncertainty.profiles_json import THRESHOLD, Profile

HIGHEST = 12.0
"""Of χ² above the lowest that is drawn."""


def profiles(contents: Contents) -> Section | None:
    """Return a chart a profile."""
    if contents.profiles is None:
        return None
    found = contents.profiles.profiles
    charts = [_chart(one) for one in found]
    return Section("profiles", "Profile likelihood", {"profiles": found}, charts)


def _chart(one: Profile) -> Chart:
    rise = [None if value is None or value > HIGHEST else value for value in one.rise]
    expected = [value if value <= HIGHEST else None for value in one.quadratic]
    lines = (
        Line("standard error's parabola", one.values, expected, Look(GREY, dash="dash", width=2.0)),
        Line("profile", one.values, rise, Look(FITTED.colour, width=2.0, marks=True)),
    )
    panel = Panel(lines, y_title="rise of χ²", levels=((THRESHOLD, "95 %"),))
    return Chart(
        key=f"profile_{one.name}",
        title=one.name,
        panels=(panel,),
        x_title=f"{one.name} [{one.unit}]" if one.unit else one.name,
        height=340,
    )
