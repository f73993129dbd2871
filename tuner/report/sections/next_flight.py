"""Which further flight would narrow which interval."""

from __future__ import annotations

from tuner.design.proposals import proposals_in_words
from tuner.report.chart import Chart, Heat, Panel
from tuner.report.contents import Contents
from tuner.report.section import Cell, Section


def next_flight(contents: Contents) -> Section | None:
    """Return the proposals, best first."""
    proposals = contents.proposals
    if proposals is None:
        return None
    points = [Cell(sentence) for sentence in proposals_in_words(proposals)]
    known = (
        "The fitted coefficients are well known, so that it is shown for others as if they were "
        "fitted."
        if proposals.all_known
        else "Shown for the coefficients that are not well known."
    )
    arena = " × ".join(f"{length:g}" for length in proposals.arena)
    note = (
        f"Flights of {proposals.seconds:.0f} s in an arena of {arena} m, simulated with these "
        f"coefficients, recorded and weighed as these flights were. {known}"
    )
    charts = []
    if proposals.flights:
        shares = [
            [round(100.0 * flight.shrinks[name], 1) for name in proposals.targets]
            for flight in proposals.flights
        ]
        texts = [
            [
                f"{flight.name}: the interval of {name} would be "
                f"{flight.shrinks[name]:.0%} of what it is"
                for name in proposals.targets
            ]
            for flight in proposals.flights
        ]
        heat = Heat(
            columns=proposals.targets,
            rows=[flight.name for flight in proposals.flights],
            values=shares,
            text=texts,
            digits=0,
            bar="% of the interval",
        )
        charts.append(
            Chart(
                key="next_flight",
                title="What would be left of each interval after one more flight",
                caption="Flights that gain most over all come first (A-optimal).",
                panels=(Panel((heat,)),),
                height=190 + 22 * len(proposals.flights),
                fold="each flight, each coefficient",
            )
        )
    return Section("next_flight", "What to fly next", points=points, charts=charts, note=note)
