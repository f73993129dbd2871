"""How the likelihood falls when a coefficient is set to other values and the rest refitted."""

from __future__ import annotations

from tuner.report.chart import FITTED, GREY, Chart, Line, Look, Panel
from tuner.report.contents import Contents
from tuner.report.section import Cell, Section, figures
from tuner.uncertainty.records import THRESHOLD, Profile

HIGHEST = 12.0
"""Of χ² above the lowest that is drawn."""


def profiles(contents: Contents) -> Section | None:
    """Return a chart a profile."""
    if contents.profiles is None:
        return None
    profiles = contents.profiles.profiles
    charts = [_chart(profile) for profile in profiles]
    note = (
        "Each point sets one coefficient to a value and fits all others again, priors left out, in "
        "the weights of the final residuals. Where the curve stays below the dashed line, the "
        "flights do not distinguish the values."
    )
    points = [Cell(_interval(profile)) for profile in profiles]
    return Section("profiles", "Profile likelihood", points=points, charts=charts, note=note)


def _interval(profile: Profile) -> str:
    low, high = profile.interval
    lower = "open below" if low is None else figures(low)
    upper = "open above" if high is None else figures(high)
    return f"{profile.name}: 95 % interval {lower} to {upper} {profile.unit}"


def _chart(profile: Profile) -> Chart:
    rise = [None if value is None or value > HIGHEST else value for value in profile.rise]
    expected = [value if value <= HIGHEST else None for value in profile.quadratic]
    lines = (
        Line(
            "standard error's parabola",
            profile.values,
            expected,
            Look(GREY, dash="dash", width=2.0),
        ),
        Line("profile", profile.values, rise, Look(FITTED.colour, width=2.0, marks=True)),
    )
    panel = Panel(lines, y_title="rise of χ²", levels=((THRESHOLD, "95 %"),))
    return Chart(
        key=f"profile_{profile.name}",
        title=profile.name,
        panels=(panel,),
        x_title=f"{profile.name} [{profile.unit}]" if profile.unit else profile.name,
        height=340,
    )
