"""Effects, information, residuals, profiles and indices of coefficients; what to fly and log."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuner.core.phrases import percent
from tuner.design.proposals import LogProposal, Proposals, log_in_words, proposals_in_words
from tuner.report.section import (
    FITTED,
    GREY,
    PALETTE,
    Bars,
    Cell,
    Chart,
    HeatMap,
    Line,
    LineStyle,
    PageSection,
    Panel,
    Table,
    figures,
)
from tuner.uncertainty.records import (
    CHI_SQUARE_95,
    INDEX_MEANINGS,
    GlobalSensitivity,
    Knowledge,
    Profile,
    Residual,
)
from tuner.uncertainty.verdict import direction_in_words

MIN_DRAWN_SHARE = 1e-4
"""Changes smaller than this share of the present RMSE are drawn as this."""


def effects(knowledge: Knowledge) -> PageSection | None:
    """Return heat maps of the change for +1 %."""
    if not knowledge.outputs:
        return None
    names = [name for name in knowledge.coefficients if name in knowledge.outputs[0].change]
    charts = (_by_signal(knowledge, names), *_over_time(knowledge, names))
    note = "The RMSE for −10 % and +10 % of each coefficient is in sensitivity.csv."
    return PageSection("effects", "Local sensitivity", charts=charts, note=note, folded=True)


def _pose_rmse(rmse: Sequence[float | None]) -> float | None:
    """Return the root mean square over outputs of one unit, None if one of them failed."""
    known = [value for value in rmse if value is not None]
    return float(np.sqrt(np.mean(np.square(known)))) if known and len(known) == len(rmse) else None


def _by_signal(knowledge: Knowledge, names: Sequence[str]) -> Chart:
    """Return coefficients against channels and axes, all flights together."""
    signals = list(dict.fromkeys((o.channel, o.axis, o.unit) for o in knowledge.outputs))
    rows, texts = [], []
    for name in names:
        shares, sentences = [], []
        for channel, axis, unit in signals:
            outputs = [o for o in knowledge.outputs if (o.channel, o.axis) == (channel, axis)]
            change = float(np.sqrt(np.mean([o.change[name] ** 2 for o in outputs])))
            rmse = _pose_rmse([o.rmse for o in outputs if o.rmse is not None])
            share = change / max(rmse, 1e-300) if rmse else 0.0  # none was flown to its end
            shares.append(float(np.log10(max(share, MIN_DRAWN_SHARE))))
            each = "".join(f"<br>{o.flight}: {o.change[name]:.3g} {unit}" for o in outputs)
            sentences.append(
                f"{name} +1 % changes {_name(channel, axis)} by {change:.3g} {unit}{each}"
            )
        rows.append(shares)
        texts.append(sentences)
    heat = HeatMap(
        columns=[_name(channel, axis) for channel, axis, _ in signals],
        rows=_labels(knowledge, names),
        values=rows,
        text=texts,
        bar="change / RMSE",
        ticks={-4.0: "≤ 0.0001", -3.0: "0.001", -2.0: "0.01", -1.0: "0.1", 0.0: "1", 1.0: "10"},
    )
    return Chart(
        key="sensitivity",
        title="Change of each signal for +1 %",
        caption="RMS change over all flights, as a multiple of what is left between simulation and "
        "recording: above 1 the change stands out in a single sample, and thousands of samples "
        "show far less. Point at a cell for units and flights.",
        panels=(Panel((heat,)),),
        height=170 + 24 * len(names),
    )


def _over_time(knowledge: Knowledge, names: Sequence[str]) -> list[Chart]:
    charts = []
    for over_time in knowledge.effects_over_time:
        start_of = "a window" if over_time.windowed else "the mission"
        rows, texts = [], []
        for name in names:
            change = np.array(over_time.change[name])
            largest = max(float(change.max()), 1e-300)
            start, end = over_time.span[name]
            rows.append((change / largest).round(3).tolist())
            texts.append(
                [
                    f"{name}: {c:.3g} σ at {t:.1f} s<br>half of its effect from {start:.1f} "
                    f"to {end:.1f} s"
                    for t, c in zip(over_time.time, change, strict=True)
                ]
            )
        heat = HeatMap(
            columns=over_time.time,
            rows=_labels(knowledge, names),
            values=rows,
            text=texts,
            bar="share of its largest",
        )
        charts.append(
            Chart(
                key=f"{over_time.flight}_effects",
                title=f"{over_time.flight}: when each coefficient acts",
                panels=(Panel((heat,)),),
                x_title=f"time since {start_of}'s start [s]",
                height=130 + 20 * len(names),
                fold=over_time.flight,
            )
        )
    return charts


def _labels(knowledge: Knowledge, names: Sequence[str]) -> list[str]:
    return [knowledge.coefficients[name].label(name) for name in names]


def _name(channel: str, axis: str) -> str:
    return f"{channel.replace('_', ' ')} {axis}"


MIN_BIAS = 0.05
"""Percent of bias for each percent of a fixed coefficient below which it is not listed."""
MAX_BIASES = 3
"""Biased coefficients named for each fixed one."""
MAX_ANNOTATED = 14
"""Rows up to which a correlation is written into its cell."""


def information(knowledge: Knowledge) -> PageSection:
    """Return shares, worst directions, correlations, and the debts of what is fixed."""
    points = [
        Cell(direction_in_words(d), look="failure" if d.null else "") for d in knowledge.directions
    ]
    charts = _shares(knowledge)
    if len(knowledge.names) > 1:
        charts.append(_correlation(knowledge))
    return PageSection(
        "information",
        "Information and correlation",
        sentences=("The worst-determined combinations of coefficients:",),
        points=points,
        tables=_biases(knowledge),
        charts=charts,
        folded=True,
    )


def _biases(knowledge: Knowledge) -> list[Table]:
    """Return the biases of fitted coefficients by errors of fixed ones."""
    rows = []
    for name, known in knowledge.coefficients.items():
        follows = sorted(known.bias.items(), key=lambda item: -abs(item[1]))[:MAX_BIASES]
        noticed = [(other, share) for other, share in follows if abs(share) >= MIN_BIAS]
        if noticed:
            rows.append((name, ", ".join(f"{share:+.2g} % into {o}" for o, share in noticed)))
    columns = ("fixed coefficient", "1 % of error in it puts")
    return [Table(columns, rows, words=columns)] if rows else []


def _shares(knowledge: Knowledge) -> list[Chart]:
    """Return whose information each coefficient has: by channel, and by flight."""
    known = knowledge.coefficients.values()
    by_channel = {
        channel.replace("_", " "): [sum(of.shares[channel].values()) for of in known]
        for channel in knowledge.channels
    }
    by_flight = {
        flight: [sum(of_flight[flight] for of_flight in of.shares.values()) for of in known]
        for flight in knowledge.flights
    }
    return [
        _stacked(
            knowledge,
            by_channel,
            "shares_by_channel",
            "Information about each coefficient by channel",
            "Share of the Fisher information, the other coefficients fitted beside it.",
        ),
        _stacked(
            knowledge,
            by_flight,
            "shares_by_flight",
            "Information about each coefficient by flight",
            "",
        ),
    ]


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
                f"{label}: {percent(share)} from {name}"
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
    heat = HeatMap(
        columns=names,
        rows=names,
        values=[[round(r, 4) for r in row] for row in knowledge.correlation],
        text=texts,
        digits=2 if len(names) <= MAX_ANNOTATED else None,
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


def residuals(known: Sequence[Residual]) -> PageSection:
    """Return a table of the residuals and their autocorrelation."""
    panels = []
    for number, channel in enumerate(dict.fromkeys(r.channel for r in known)):
        of_channel = [residual for residual in known if residual.channel == channel]
        colour = PALETTE[number % len(PALETTE)]
        curves = [
            Line(
                channel.replace("_", " "),
                [round(i * residual.spacing, 4) for i in range(1, len(residual.autocorrelation))],
                residual.autocorrelation[1:],
                LineStyle(colour, width=1.2),
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
    return PageSection(
        "residuals", "Residuals", tables=(table,), charts=(chart,), note=note, folded=True
    )


MAX_CHI_SQUARE = 12.0
"""Of the drawn χ² above the lowest."""


def profiles(profiles: Sequence[Profile]) -> PageSection:
    """Return a chart a profile."""
    charts = [_chart(profile) for profile in profiles]
    note = (
        "Each point sets one coefficient to a value and fits all others again, priors left out, in "
        "the weights of the final residuals. Where the curve stays below the dashed line, the "
        "flights do not distinguish the values."
    )
    points = [Cell(_interval(profile)) for profile in profiles]
    return PageSection("profiles", "Profile likelihood", points=points, charts=charts, note=note)


def _interval(profile: Profile) -> str:
    low, high = profile.interval
    lower = "open below" if low is None else figures(low)
    upper = "open above" if high is None else figures(high)
    return f"{profile.name}: 95 % interval {lower} to {upper} {profile.unit}"


def _chart(profile: Profile) -> Chart:
    rise = [None if value is None or value > MAX_CHI_SQUARE else value for value in profile.rise]
    expected = [value if value <= MAX_CHI_SQUARE else None for value in profile.quadratic]
    lines = (
        Line(
            "standard error's parabola",
            profile.values,
            expected,
            LineStyle(GREY, dash="dash", width=2.0),
        ),
        Line("profile", profile.values, rise, LineStyle(FITTED.colour, width=2.0, marks=True)),
    )
    panel = Panel(lines, y_title="rise of χ²", levels=((CHI_SQUARE_95, "95 %"),))
    return Chart(
        key=f"profile_{profile.name}",
        title=profile.name,
        panels=(panel,),
        x_title=f"{profile.name} [{profile.unit}]" if profile.unit else profile.name,
        height=340,
    )


def global_sensitivity(indices: GlobalSensitivity) -> PageSection:
    """Return the indices over all and for each channel of each flight."""
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
    return PageSection(
        "global_sensitivity", "Global sensitivity", tables=(table,), charts=charts, note=note
    )


def _over_all(indices: GlobalSensitivity) -> Chart:
    overall = sorted((i for i in indices.indices if not i.flight), key=lambda i: -i.total)
    meaning = INDEX_MEANINGS[indices.method]
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
    heat = HeatMap(
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
        bar=INDEX_MEANINGS[indices.method][1],
    )
    return Chart(
        key="global_each",
        title="The same for each channel of each flight",
        panels=(Panel((heat,)),),
        height=260 + 22 * len(names),
    )


def next_flight(proposals: Proposals) -> PageSection:
    """Return the proposals, best first."""
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
                f"{percent(flight.shrinks[name])} of what it is"
                for name in proposals.targets
            ]
            for flight in proposals.flights
        ]
        heat = HeatMap(
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
    return PageSection("next_flight", "What to fly next", points=points, charts=charts, note=note)


def next_log(proposals: Sequence[LogProposal]) -> PageSection:
    """Return the effects of further signals, or of more samples, on intervals."""
    points = [Cell(log_in_words(proposal)) for proposal in proposals]
    note = (
        "Computed at the fitted coefficients, with the quoted intervals: an added signal is "
        "simulated and weighed with the noise named; what twice the samples of an input would "
        "bring follows from leaving out some of them."
    )
    return PageSection("next_log", "What to log next time", points=points, note=note)
