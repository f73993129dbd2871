"""Whether what is left over is white noise: if not, the model lacks something."""

from __future__ import annotations

from tuner.report.chart import PALETTE, Chart, Line, Look, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section


def residuals(contents: Contents) -> Section | None:
    """Return a table of the residuals and their autocorrelation."""
    if contents.knowledge is None or not contents.knowledge.residuals:
        return None
    found = contents.knowledge.residuals
    panels = []
    for number, channel in enumerate(dict.fromkeys(one.channel for one in found)):
        own = [one for one in found if one.channel == channel]
        colour = PALETTE[number % len(PALETTE)]
        curves = [
            Line(
                channel.replace("_", " "),
                [round(i * one.spacing, 4) for i in range(1, len(one.autocorrelation))],
                one.autocorrelation[1:],
                Look(colour, width=1.2),
                text=[f"{one.flight}: {r:+.2f}" for r in one.autocorrelation[1:]],
            )
            for one in own
        ]
        limit = max(one.limit for one in own)
        levels = ((limit, ""), (-limit, ""))
        panels.append(Panel(curves, y_title=channel.replace("_", " "), levels=levels))
    chart = Chart(
        key="whiteness",
        title="Autocorrelation of the residuals",
        caption="One curve a flight. White noise stays between the dashed lines in 95 of 100 lags.",
        panels=panels,
        x_title="lag [s]",
        height=100 + 110 * len(panels),
    )
    return Section("residuals", "What is left over", {"residuals": found}, (chart,))
