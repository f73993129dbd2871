"""Each coefficient: its value, how well it is known, and why."""

from __future__ import annotations

from collections.abc import Mapping

from tuner.core.numerics import Z95
from tuner.report.chart import GREY, PALETTE, Bars, Chart, Panel
from tuner.report.contents import Contents
from tuner.report.result_texts import calibration_in_words
from tuner.report.section import Cell, Section, Table, figures, short
from tuner.result import CoefficientResult
from tuner.uncertainty.records import CoefficientKnowledge, calibration
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


def coefficients(contents: Contents) -> Section | None:
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
    return Section("coefficients", "Coefficients", tables=tables, charts=charts, note=note)


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
