"""What each coefficient does to each recorded signal, and when."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tuner.report.chart import Chart, Heat, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.uncertainty.sensitivity_json import Knowledge

FAINTEST = 1e-4
"""Changes smaller than this share of the present RMSE are drawn as this."""


def effects(contents: Contents) -> Section | None:
    """Return heat maps of the change for +1 %."""
    knowledge = contents.knowledge
    if knowledge is None or not knowledge.outputs:
        return None
    names = [name for name in knowledge.coefficients if name in knowledge.outputs[0].change]
    charts = (_by_signal(knowledge, names), *_over_time(knowledge, names))
    note = "The RMSE for −10 % and +10 % of each coefficient is in sensitivity.csv."
    return Section("effects", "Local sensitivity", charts=charts, note=note, folded=True)


def _together(rmse: Sequence[float | None]) -> float | None:
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
            rmse = _together([o.rmse for o in outputs if o.rmse is not None])
            share = change / max(rmse, 1e-300) if rmse else 0.0  # none was flown to its end
            shares.append(float(np.log10(max(share, FAINTEST))))
            each = "".join(f"<br>{o.flight}: {o.change[name]:.3g} {unit}" for o in outputs)
            sentences.append(
                f"{name} +1 % changes {_name(channel, axis)} by {change:.3g} {unit}{each}"
            )
        rows.append(shares)
        texts.append(sentences)
    heat = Heat(
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
        heat = Heat(
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
