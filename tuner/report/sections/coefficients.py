"""Each coefficient: its value, and why; by the ground, by refits and in Gazebo beside the fit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tuner.core.numerics import Z95
from tuner.core.phrases import percent
from tuner.ground.measurement import (
    BenchRecord,
    Curve,
    ExperimentRecord,
    agreement_in_words,
    is_of_flights,
    numbers_in_words,
    remarks_in_words,
)
from tuner.report.contents import Contents
from tuner.report.result_texts import (
    calibration_in_words,
    effective_in_words,
    refits_in_words,
)
from tuner.report.section import (
    FITTED,
    GREY,
    PALETTE,
    Bars,
    Cell,
    Chart,
    Line,
    LineStyle,
    PageSection,
    Panel,
    Table,
    figures,
    short,
)
from tuner.result import CoefficientResult, RunResult
from tuner.uncertainty.records import CONFLICT_SE, CoefficientKnowledge, Sources, calibration
from tuner.uncertainty.verdict import (
    Verdict,
    half_width_in_words,
    judgement_in_words,
    parts_in_words,
    reason_in_words,
    verdict_in_words,
)
from tuner.vehicle import COEFFICIENTS

#: Verdict -> class of its badge, sign before it and colour of its bar.
VERDICTS = {
    Verdict.WELL_KNOWN: ("well", "●", PALETTE[2]),
    Verdict.WEAKLY_KNOWN: ("weak", "◐", PALETTE[4]),
    Verdict.NOT_IDENTIFIABLE: ("not", "○", PALETTE[1]),
    Verdict.HELD: ("not", "○", PALETTE[1]),
    Verdict.NOT_EXAMINED: ("not", "○", GREY),
    Verdict.TIED: ("kept", "=", GREY),
    Verdict.FIXED: ("kept", "–", GREY),
}
MAX_PERCENT = 1000.0
"""% at which a bar of the figure ends."""


def coefficients(contents: Contents) -> PageSection | None:
    """Return the table, how wide the intervals are, and what makes them so."""
    knowledge = {} if contents.knowledge is None else contents.knowledge.coefficients
    charts = _intervals(knowledge)
    if contents.run is not None:
        results = contents.run.result.coefficients
        free = {name: found for name, found in results.items() if found.fitted}
        fixed = {name: found for name, found in results.items() if not found.fitted}
        tables = [_fitted(free), _parts(free)] if free else []
        if fixed:
            tables.append(_fixed(fixed, knowledge))
    elif knowledge:
        tables = [_examined_table(knowledge)]
    else:
        return None
    note = (
        "± 95 % is the longer side of the 95 % interval: that holds the true value in 95 of 100 "
        f"such experiments, if the model is right. {calibration_in_words(calibration())}"
    )
    return PageSection("coefficients", "Coefficients", tables=tables, charts=charts, note=note)


def _name(name: str) -> Cell:
    return Cell(name, small=COEFFICIENTS[name].meaning)


def _verdict_cell(verdict: Verdict, reason: str = "") -> Cell:
    look, sign, _ = VERDICTS[verdict]
    words = verdict_in_words(verdict)
    return Cell(f"{sign} {words}", small="" if reason == words else reason, look=look)


def _fitted(free: Mapping[str, CoefficientResult]) -> Table:
    rows = [
        (
            _name(name),
            figures(found.initial),
            figures(found.best),
            half_width_in_words(found.ci95, found.best, found.unit),
            found.unit,
            _verdict_cell(
                found.verdict,
                "" if found.verdict is Verdict.WELL_KNOWN else reason_in_words(found.reason),
            ),
        )
        for name, found in free.items()
    ]
    columns = ("coefficient", "start", "fitted", "± 95 %", "unit", "how well it is known")
    return Table(columns, rows, words=("coefficient", "unit", "how well it is known"))


def _parts(free: Mapping[str, CoefficientResult]) -> Table:
    """Return from where each interval comes."""
    rows = []
    for name, found in free.items():
        parts, unit = found.std_error_parts, found.reason.unit
        rows.append(
            (
                name,
                short(found.std_error),
                _from_to(found.ci95),
                Cell(
                    reason_in_words(found.reason),
                    small="" if parts is None else parts_in_words(parts, unit, found.best),
                ),
            )
        )
    columns = ("coefficient", "standard error", "95 % interval", "why")
    words = ("coefficient", "why")
    return Table(columns, rows, words=words, fold="What makes each interval as wide as it is")


def _fixed(
    fixed: Mapping[str, CoefficientResult], knowledge: Mapping[str, CoefficientKnowledge]
) -> Table:
    rows = [
        (
            _name(name),
            figures(found.best),
            found.unit,
            judgement_in_words(knowledge[name].verdict, knowledge[name].reason)
            if name in knowledge
            else "",
        )
        for name, found in fixed.items()
    ]
    columns = ("coefficient", "value", "unit", "were it fitted with the others")
    words = ("coefficient", "unit", "were it fitted with the others")
    return Table(columns, rows, words=words, fold=f"Fixed: {', '.join(fixed)}")


def _examined_table(knowledge: Mapping[str, CoefficientKnowledge]) -> Table:
    rows = [
        (
            Cell(known.label(name), small=COEFFICIENTS[name].meaning),
            figures(known.value),
            short(known.std_error),
            _from_to(known.ci95),
            known.unit,
            _verdict_cell(
                known.verdict,
                ("" if known.fitted else "were it fitted with the others: ")
                + reason_in_words(known.reason),
            ),
        )
        for name, known in knowledge.items()
    ]
    columns = ("coefficient", "value", "±", "95 % interval", "unit", "how well it is known")
    return Table(columns, rows, words=("coefficient", "unit", "how well it is known"))


def _from_to(interval: tuple[float | None, float | None] | None) -> str:
    return "" if interval is None else f"{figures(interval[0])} to {figures(interval[1])}"


def _intervals(known: Mapping[str, CoefficientKnowledge]) -> list[Chart]:
    """Return half the 95 % interval of every coefficient, relative to its value."""
    wide = {
        name: 100.0 * Z95 * coefficient.std_error / coefficient.step
        for name, coefficient in known.items()
        if coefficient.std_error and coefficient.step
    }
    if not wide:
        return []
    order = sorted(wide, key=wide.__getitem__)
    bars = []
    for verdict, (_, sign, colour) in VERDICTS.items():
        widths = [
            min(wide[name], MAX_PERCENT) if known[name].verdict == verdict else None
            for name in order
        ]
        if any(value is not None for value in widths):
            texts = [
                f"{name}: ±{wide[name]:.2g} %, {verdict_in_words(known[name].verdict)}"
                for name in order
            ]
            labels = [known[name].label(name) for name in order]
            bars.append(Bars(f"{sign} {verdict_in_words(verdict)}", labels, widths, colour, texts))
    return [
        Chart(
            key="intervals",
            title="How closely each coefficient is known",
            caption="Half the 95 % interval, relative to the value, drawn to "
            f"{MAX_PERCENT:.0f} % at most. For a fixed coefficient it is the one that it would "
            "have, were it fitted with the others.",
            panels=(Panel(bars, x_scale="log"),),
            x_title="± % of the value (of its usual uncertainty where the value is smaller)",
            height=120 + 24 * len(order),
            fold="How closely each coefficient is known",
        )
    ]


def refits(result: RunResult) -> PageSection | None:
    """Return a table of the errors by jackknife and bootstrap, where they were asked for."""
    rows: list[tuple[Cell | str, ...]] = [
        (
            name,
            figures(found.best),
            *map(short, (found.std_error, found.jackknife_error, found.bootstrap_error)),
            found.unit,
        )
        for name, found in result.coefficients.items()
        if found.jackknife_error is not None or found.bootstrap_error is not None
    ]
    if not rows:
        return None
    columns = ("coefficient", "best", "±, this fit", "±, jackknife", "±, bootstrap", "unit")
    return PageSection(
        "refits",
        "Refits to other flights",
        refits_in_words(result),
        tables=(Table(columns, rows, words=("coefficient", "unit")),),
        note="± is one standard error. The jackknife leaves each flight out in turn; the bootstrap "
        "draws as many flights with replacement.",
    )


def sources(found: Mapping[str, Sources]) -> PageSection:
    """Return a table of what the ground, the flights and both give."""
    rows: list[tuple[Cell | str, ...]] = []
    for name, source in found.items():
        both = (source.ground, source.flights, source.both)
        errors = (source.ground_error, source.flights_error, source.both_error)
        pairs = [t for v, e in zip(both, errors, strict=True) for t in (figures(v), short(e))]
        if source.deviation is None:
            agree = Cell("flights do not identify it", look="kept")
        elif abs(source.deviation) > CONFLICT_SE:
            agree = Cell("● conflict", look="not")
        else:
            agree = Cell("○ yes", look="well")
        apart = "–" if source.deviation is None else f"{source.deviation:+.1f}"
        rows.append((name, *pairs, COEFFICIENTS[name].unit, apart, agree))
    columns = (
        *("coefficient", "ground", "±", "flights alone", "±", "both", "±", "unit", "apart [±]"),
        "do they agree?",
    )
    words = ("coefficient", "unit", "do they agree?")
    return PageSection(
        "sources",
        "Ground and flights",
        tables=(Table(columns, rows, words=words),),
        note="± is one standard error, that of flights widened for model error. Flights alone are "
        "what one step without the ground measurements gives from the end of the fit. More than "
        "three standard errors apart is a conflict: do not believe the value of both before one of "
        "them is explained.",
    )


def effective(result: RunResult) -> PageSection | None:
    """Return both answers beside each other, and what each term that is lost is worth."""
    found = result.effective
    if found is None:
        return None
    physical = {name: row.best for name, row in result.coefficients.items()}
    rows = [
        (
            name,
            figures(physical[name]),
            figures(value),
            COEFFICIENTS[name].unit,
            _change(physical[name], value),
        )
        for name, value in found.coefficients.items()
        if name in physical and value != physical[name]
    ]
    lost = [
        (Cell(term.group, small=", ".join(term.names)), term.rmse_without.words)
        for term in found.lost
    ]
    columns = ("coefficient", "physical", "in Gazebo", "unit", "change")
    tables = (
        Table(columns, rows, words=("coefficient", "unit")),
        Table(
            ("term that Gazebo lacks", "RMSE without it alone"),
            lost,
            words=("term that Gazebo lacks",),
        ),
    )
    note = (
        "Physical coefficients say what is true of the vehicle; those in Gazebo stand in for what "
        "it lacks, and mean less than their names say. Exports for simulators hold the latter, "
        "unless the job file has target: physical. RMSE is over all flights, in position and in "
        "attitude."
    )
    return PageSection(
        "effective", "In Gazebo", (effective_in_words(found),), tables=tables, note=note
    )


def _change(before: float, after: float) -> str:
    if before == 0.0:
        return "–"
    share = after / before - 1.0
    return f"{'+' if share > 0 else '−'}{percent(abs(share))}"


USED = LineStyle(PALETTE[2], marks=True)


NOT_USED = LineStyle(GREY, marks=True)


RESIDUAL = LineStyle(PALETTE[1], marks=True)


def bench(record: BenchRecord) -> PageSection:
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
        for chart in _experiment_charts(number, experiment)
    ]  # fmt: skip
    return PageSection(
        "bench",
        "Flights without a pose" if flown else "Ground measurements",
        sentences=(agreement_in_words(record),),
        tables=(table,),
        charts=charts,
        note="± is one standard error.",
    )


def _experiment_charts(number: int, experiment: ExperimentRecord) -> list[Chart]:
    return [
        Chart(
            key=f"bench_{number + 1}_{place + 1}",
            title=f"{experiment.name}: {curve.title}",
            caption="The estimate rests on the green points; grey ones were left out."
            if not all(curve.used)
            else "",
            panels=_curve_panels(curve),
            x_title=curve.x_label,
            height=440 if curve.law else 320,
        )
        for place, curve in enumerate(experiment.curves)
    ]


def _curve_panels(curve: Curve) -> list[Panel]:
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
