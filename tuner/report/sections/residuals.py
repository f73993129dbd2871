"""Whether what is left over is white noise: if not, the model lacks something."""

from __future__ import annotations

from tuner.report.chart import PALETTE, Chart, Line, Look, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section, Table


def residuals(contents: Contents) -> Section | None:
    """Return a table of the residuals and their autocorrelation."""
    if contents.knowledge is None or not contents.knowledge.residuals:
        return None
    known = contents.knowledge.residuals
    panels = []
    for number, channel in enumerate(dict.fromkeys(r.channel for r in known)):
        of_channel = [residual for residual in known if residual.channel == channel]
        colour = PALETTE[number % len(PALETTE)]
        curves = [
            Line(
                channel.replace("_", " "),
                [round(i * residual.spacing, 4) for i in range(1, len(residual.autocorrelation))],
                residual.autocorrelation[1:],
                Look(colour, width=1.2),
                text=[f"{residual.flight}: {r:+.2f}" for r in residual.autocorrelation[1:]],
            )
            for residual in of_channel
        ]
        limit = max(residual.limit for residual in of_channel)
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
    rows = [
        (
            residual.flight,
            residual.channel.replace("_", " "),
            f"{residual.rms:.2f}",
            f"{residual.memory:.3f}",
            "● yes" if residual.white else "○ no",
        )
        for residual in known
    ]
    columns = ("flight", "channel", "RMS in σ of the noise", "memory [s]", "white?")
    table = Table(columns, rows, words=("flight", "channel", "white?"), fold="each residual")
    note = (
        "What remains between simulation and recording. White noise of the size of the measurement "
        "noise means that the flights hold no more information; anything else is an effect that "
        "the model lacks, and standard errors are widened for it."
    )
    return Section(
        "residuals", "Residuals", tables=(table,), charts=(chart,), note=note, folded=True
    )
