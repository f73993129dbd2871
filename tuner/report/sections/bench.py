"""Ground measurements: what each experiment gave, from which samples, and whether they agree."""

from __future__ import annotations

import numpy as np

from tuner.ground.bench_json import (
    BenchRecord,
    ExperimentRecord,
    agreement_in_words,
    is_of_flights,
    numbers_in_words,
    remarks_in_words,
)
from tuner.ground.measurement import Curve
from tuner.report.chart import FITTED, GREY, PALETTE, Chart, Line, Look, Panel
from tuner.report.section import Section, Table

USED = Look(PALETTE[2], marks=True)
NOT_USED = Look(GREY, marks=True)
RESIDUAL = Look(PALETTE[1], marks=True)


def bench(record: BenchRecord) -> Section:
    """Return a table of the experiments and a picture of each: data, law, residuals."""
    experiments = record.experiments
    rows = [
        (e.name, "; ".join(numbers_in_words(e)), " ".join(remarks_in_words(e))) for e in experiments
    ]
    flown = is_of_flights(record)
    columns = ("flight" if flown else "experiment", "gives", "what its checks noticed")
    table = Table(columns, rows, words=columns)
    charts = [
        chart for number, experiment in enumerate(experiments)
        for chart in _charts(number, experiment)
    ]  # fmt: skip
    return Section(
        "bench",
        "Flights without a pose" if flown else "Ground measurements",
        sentences=(agreement_in_words(record),),
        tables=(table,),
        charts=charts,
        note="± is one standard error.",
    )


def _charts(number: int, experiment: ExperimentRecord) -> list[Chart]:
    return [
        Chart(
            key=f"bench_{number + 1}_{place + 1}",
            title=f"{experiment.name}: {curve.title}",
            caption="The estimate rests on the green points; grey ones were left out."
            if not all(curve.used)
            else "",
            panels=_panels(curve),
            x_title=curve.x_label,
            height=440 if curve.law else 320,
        )
        for place, curve in enumerate(experiment.curves)
    ]


def _panels(curve: Curve) -> list[Panel]:
    used = np.array(curve.used, bool)
    x, measured = np.array(curve.x), np.array(curve.measured)
    marks = [
        Line(name, x[chosen].tolist(), measured[chosen].tolist(), look, joined=False)
        for name, chosen, look in (("left out", ~used, NOT_USED), ("used", used, USED))
        if chosen.any()
    ]
    name = "law" if curve.law else "level"
    marks.append(Line(name, curve.fit_x, curve.fit, FITTED, joined=curve.law))
    panels = [Panel(marks, y_title=curve.y_label)]
    if curve.law and len(curve.fit_x) > 1:
        rest = measured[used] - np.interp(x[used], curve.fit_x, curve.fit)
        line = Line("residual", x[used].tolist(), rest.tolist(), RESIDUAL, joined=False)
        panels.append(Panel([line], y_title="residual"))
    return panels
