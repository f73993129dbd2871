"""Which terms beyond the base model the flights speak for."""

from __future__ import annotations

from tuner.report.chart import FITTED, GREY, Bars, Chart, Panel
from tuner.report.contents import Contents
from tuner.report.section import Section
from tuner.wording.result import gain_in_words, reason_in_words, selection_in_words


def selection(contents: Contents) -> Section | None:
    """Return the table of the selection and its figure."""
    rows = () if contents.run is None else contents.run.result.selection
    if not rows:
        return None
    table = [
        {
            "group": row.group,
            "names": row.names,
            "gain_fit": gain_in_words(row.gain_fit),
            "gain_holdout": gain_in_words(row.gain_holdout),
            "scatter": gain_in_words(row.scatter),
            "kept": row.kept,
            "reason": reason_in_words(row),
        }
        for row in rows
    ]
    values = {"rows": table, "sentence": selection_in_words(rows)}
    return Section("selection", "Terms beyond the motor model", values, _figure(contents))


def _figure(contents: Contents) -> list[Chart]:
    assert contents.run is not None
    scored = [row for row in contents.run.result.selection if row.gain_holdout is not None]
    if not scored:
        return []
    bars = [
        Bars(
            name,
            [row.group for row in scored],
            [100 * (row.gain_holdout or 0.0) if row.kept == kept else None for row in scored],
            colour,
            [f"{row.group}: {reason_in_words(row)}" for row in scored],
        )
        for name, kept, colour in (("in the model", True, FITTED.colour), ("left out", False, GREY))
    ]
    return [
        Chart(
            key="selection",
            title="What each group of terms is worth",
            caption="Share of the loss of flights left out of the fit that each group takes away "
            "beside the others in the model. Left of zero it makes them worse.",
            panels=(Panel(bars),),
            x_title="gain held out [%]",
            height=140 + 26 * len(scored),
        )
    ]
