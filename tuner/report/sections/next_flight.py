"""Which further flight would narrow which interval."""

from __future__ import annotations

from tuner.report.chart import Chart, Heat, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.wording.proposals import proposals_in_words


def next_flight(contents: Contents) -> Section | None:
    """Return the proposals, best first."""
    proposals = contents.proposals
    if proposals is None:
        return None
    values = {"proposals": proposals, "sentences": proposals_in_words(proposals)}
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
            )
        )
    return Section("next_flight", "What to fly next", values, charts)
