"""Which coefficients matter anywhere between their bounds."""

from __future__ import annotations

from tuner.report.chart import PALETTE, Bars, Chart, Heat, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section, Table, figures
from tuner.uncertainty.records import MEANING, GlobalSensitivity


def global_sensitivity(contents: Contents) -> Section | None:
    """Return the indices over all and for each channel of each flight."""
    indices = contents.global_sensitivity
    if indices is None:
        return None
    charts = (_over_all(indices), _each(indices))
    crashed = (
        f"; {indices.crashed} of them crashed on some flight and count there as no better than the "
        "worst that flew"
        if indices.crashed
        else ""
    )
    note = (
        f"{indices.method.capitalize()}'s indices over the ranges: {indices.simulations} vehicles "
        f"were flown{crashed}. Large means that the simulation depends on it somewhere in the "
        "range."
    )
    if indices.crashed > 0.5 * indices.simulations:
        note += " Most crashed: a narrower --span would show more."
    rows = [(name, figures(low), figures(high)) for name, (low, high) in indices.bounds.items()]
    table = Table(("coefficient", "from", "to"), rows, words=("coefficient",), fold="ranges")
    return Section(
        "global_sensitivity", "Global sensitivity", tables=(table,), charts=charts, note=note
    )


def _over_all(indices: GlobalSensitivity) -> Chart:
    overall = sorted((i for i in indices.indices if not i.flight), key=lambda i: -i.total)
    meaning = MEANING[indices.method]
    texts = [
        f"{i.coefficient}: {meaning[1]} {i.total:.3g}, {meaning[2]} {i.spread:.3g}" for i in overall
    ]
    names, totals = [i.coefficient for i in overall], [i.total for i in overall]
    bars = Bars(meaning[1], names, totals, PALETTE[0], texts)
    return Chart(
        key="global",
        title=f"{meaning[1][0].upper()}{meaning[1][1:]} of each coefficient",
        caption="Of the mean logarithm (base 10) of all channels' RMSE.",
        panels=(Panel((bars,)),),
        x_title=meaning[1],
        height=120 + 24 * len(overall),
    )


def _each(indices: GlobalSensitivity) -> Chart:
    outputs = list(dict.fromkeys((i.flight, i.channel) for i in indices.indices if i.flight))
    names = list(indices.bounds)
    totals = {(i.coefficient, i.flight, i.channel): i.total for i in indices.indices}
    heat = Heat(
        columns=[f"{flight} {channel.replace('_', ' ')}" for flight, channel in outputs],
        rows=names,
        values=[[round(totals[name, *output], 4) for output in outputs] for name in names],
        text=[
            [
                f"{name} on {channel} of {flight}: {totals[name, flight, channel]:.3g}"
                for flight, channel in outputs
            ]
            for name in names
        ],
        bar=MEANING[indices.method][1],
    )
    return Chart(
        key="global_each",
        title="The same for each channel of each flight",
        panels=(Panel((heat,)),),
        height=260 + 22 * len(names),
    )
