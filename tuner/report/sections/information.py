"""From which flights and channels each coefficient is known, and what it is correlated with."""

from __future__ import annotations

from tuner.report.chart import GREY, PALETTE, Bars, Chart, Heat, Panel
from tuner.report.contents import Contents
from tuner.report.section import Cell, Section, Table
from tuner.uncertainty.sensitivity_json import Knowledge
from tuner.uncertainty.verdict_texts import direction_in_words

NOTICED = 0.05
"""Percent of bias for each percent of a fixed coefficient below which it is not listed."""
MOST = 3
"""Biased coefficients named for each fixed one."""
ANNOTATED = 14
"""Rows up to which a correlation is written into its cell."""


def information(contents: Contents) -> Section | None:
    """Return shares, worst directions, correlations, and the debts of what is fixed."""
    knowledge = contents.knowledge
    if knowledge is None:
        return None
    points = [
        Cell(direction_in_words(d), look="failure" if d.null else "") for d in knowledge.directions
    ]
    charts = [_by_channel(knowledge), _by_flight(knowledge)]
    if len(knowledge.names) > 1:
        charts.append(_correlation(knowledge))
    return Section(
        "information",
        "Information and correlation",
        sentences=("The worst-determined combinations of coefficients:",),
        points=points,
        tables=_biases(knowledge),
        charts=charts,
        folded=True,
    )


def _biases(knowledge: Knowledge) -> list[Table]:
    """Return what an error of a fixed coefficient does to fitted ones."""
    rows = []
    for name, known in knowledge.coefficients.items():
        follows = sorted(known.bias.items(), key=lambda item: -abs(item[1]))[:MOST]
        noticed = [(other, share) for other, share in follows if abs(share) >= NOTICED]
        if noticed:
            rows.append((name, ", ".join(f"{share:+.2g} % into {o}" for o, share in noticed)))
    columns = ("fixed coefficient", "1 % of error in it puts")
    return [Table(columns, rows, words=columns)] if rows else []


def _by_channel(knowledge: Knowledge) -> Chart:
    parts = {
        channel.replace("_", " "): [
            sum(known.shares[channel].values()) for known in knowledge.coefficients.values()
        ]
        for channel in knowledge.channels
    }
    return _stacked(
        knowledge,
        parts,
        "shares_by_channel",
        "Information about each coefficient by channel",
        "Share of the Fisher information, the other coefficients fitted beside it.",
    )


def _by_flight(knowledge: Knowledge) -> Chart:
    parts = {
        flight: [
            sum(of_flight[flight] for of_flight in known.shares.values())
            for known in knowledge.coefficients.values()
        ]
        for flight in knowledge.flights
    }
    return _stacked(
        knowledge, parts, "shares_by_flight", "Information about each coefficient by flight", ""
    )


def _stacked(
    knowledge: Knowledge, parts: dict[str, list[float]], key: str, title: str, caption: str
) -> Chart:
    labels = [known.label(name) for name, known in knowledge.coefficients.items()]
    priors = [known.prior_share for known in knowledge.coefficients.values()]
    bars = [
        Bars(
            name,
            labels,
            [round(100 * share, 2) for share in shares],
            colour,
            [
                f"{label}: {share:.1%} from {name}"
                for label, share in zip(labels, shares, strict=True)
            ],
        )
        for (name, shares), colour in zip(
            [*parts.items(), ("prior", priors)],
            [*(PALETTE[i % len(PALETTE)] for i in range(len(parts))), GREY],
            strict=True,
        )
    ]
    return Chart(
        key=key,
        title=title,
        caption=caption,
        panels=(Panel(bars),),
        x_title="% of the information",
        height=130 + 24 * len(labels),
    )


def _correlation(knowledge: Knowledge) -> Chart:
    names = knowledge.names
    texts = [
        [f"{a} and {b}: {r:+.2f}" for b, r in zip(names, row, strict=True)]
        for a, row in zip(names, knowledge.correlation, strict=True)
    ]
    heat = Heat(
        columns=names,
        rows=names,
        values=[[round(r, 4) for r in row] for row in knowledge.correlation],
        text=texts,
        digits=2 if len(names) <= ANNOTATED else None,
        diverging=True,
        bar="correlation",
    )
    return Chart(
        key="correlation",
        title="Correlation of the estimates",
        caption="Near ±1, two coefficients are hard to distinguish.",
        panels=(Panel((heat,)),),
        height=190 + 30 * len(names),
    )
