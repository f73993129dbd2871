"""Each coefficient: its value, how well it is known, and why."""

from __future__ import annotations

from dataclasses import dataclass

from tuner.core.numerics import Z95
from tuner.report.chart import GREY, PALETTE, Bars, Chart, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.result import CoefficientResult
from tuner.uncertainty.calibration import calibration
from tuner.uncertainty.sensitivity_json import CoefficientKnowledge
from tuner.uncertainty.verdict import ReasonCode, Verdict
from tuner.vehicle import COEFFICIENTS
from tuner.wording.result import calibration_in_words
from tuner.wording.verdicts import (
    judgement_in_words,
    parts_in_words,
    reason_in_words,
    verdict_in_words,
)

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
WIDEST = 1000.0
"""% at which a bar of the figure ends."""


@dataclass(frozen=True)
class Row:
    """One line of the table; numbers in ``unit``."""

    name: str
    meaning: str
    unit: str
    initial: float | None
    best: float
    error: float | None
    interval: tuple[float | None, float | None] | None
    verdict: str
    badge: str
    sign: str
    reason: str


def coefficients(contents: Contents) -> Section | None:
    """Return the table and how wide the intervals are."""
    if contents.run is not None:
        known = {} if contents.knowledge is None else contents.knowledge.coefficients
        results = contents.run.result.coefficients
        rows = [_fitted(name, result, known.get(name)) for name, result in results.items()]
    elif contents.knowledge is not None:
        known = contents.knowledge.coefficients
        rows = [_examined(name, knowledge) for name, knowledge in known.items()]
    else:
        return None
    charts = [] if contents.knowledge is None else _intervals(contents.knowledge.coefficients)
    measured = calibration_in_words(calibration())
    values = {"rows": rows, "fit": contents.run is not None, "calibration": measured}
    return Section("coefficients", "Coefficients", values, charts)


def _fitted(name: str, result: CoefficientResult, known: CoefficientKnowledge | None) -> Row:
    reason = reason_in_words(result.reason)
    if result.reason.code is ReasonCode.INTERVAL and result.std_error_parts is not None:
        words = parts_in_words(result.std_error_parts, result.reason.unit, result.best)
        reason = f"{reason}; {words}"
    if not result.fitted and known is not None:
        judgement = judgement_in_words(known.verdict, known.reason)
        reason = f"were it fitted with the others: {judgement}"
    return _row(
        name,
        (result.initial, result.best),
        (result.std_error, result.ci95),
        (result.verdict, reason),
    )


def _examined(name: str, known: CoefficientKnowledge) -> Row:
    reason = reason_in_words(known.reason)
    if not known.fitted:
        reason = f"were it fitted with the others: {reason}"
    return _row(name, (None, known.value), (known.std_error, known.ci95), (known.verdict, reason))


def _row(
    name: str,
    values: tuple[float | None, float],
    spread: tuple[float | None, tuple[float | None, float | None] | None],
    judged: tuple[Verdict, str],
) -> Row:
    verdict, reason = judged
    badge, sign, _ = VERDICTS[verdict]
    about, words = COEFFICIENTS[name], verdict_in_words(verdict)
    return Row(name, about.meaning, about.unit, *values, *spread, words, badge, sign, reason)


def _intervals(known: dict[str, CoefficientKnowledge]) -> list[Chart]:
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
            min(wide[name], WIDEST) if known[name].verdict == verdict else None for name in order
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
            f"{WIDEST:.0f} % at most. For a fixed coefficient it is the one that it would have, "
            "were it fitted with the others.",
            panels=(Panel(bars, x_scale="log"),),
            x_title="± % of the value (of its usual uncertainty where the value is smaller)",
            height=120 + 24 * len(order),
        )
    ]
