"""Which terms beyond the base model the flights speak for."""

from __future__ import annotations

from collections.abc import Sequence

from tuner.core.phrases import listed
from tuner.report.chart import FITTED, GREY, Bars, Chart, Panel
from tuner.report.contents import Contents
from tuner.report.result_texts import (
    gain_in_words,
    nearly_kept,
    reason_in_words,
    selection_in_words,
)
from tuner.report.section import Cell, Section, Table
from tuner.vehicle.selection_table import SelectionRow


def selection(contents: Contents) -> Section | None:
    """Return the table of the selection and its figure."""
    rows = () if contents.run is None else contents.run.result.selection
    if not rows:
        return None
    shown = [row for row in rows if row.kept or nearly_kept(row)]
    table = [
        (
            Cell(row.group, small=", ".join(row.names)),
            gain_in_words(row.gain_fit),
            gain_in_words(row.gain_holdout),
            gain_in_words(row.scatter),
            Cell(
                "in the model" if row.kept else "left out",
                small=reason_in_words(row),
                look="well" if row.kept else "kept",
            ),
        )
        for row in shown
    ]
    columns = ("term", "gain in the fit", "gain held out", "±", "why")
    tables = [Table(columns, table, words=("term", "why"))] if shown else []
    sentences = [selection_in_words(rows)]
    if rejected := [row.group for row in rows if row not in shown]:
        sentences.append(f"Tried, and worth nothing here: {listed(rejected)}.")
    note = (
        "Gains are shares of the loss, each beside the other terms in the model: in the fit, and "
        "in what is left out of a fit to the rest, ± the scatter over stretches of the flights."
        if shown
        else ""
    )
    charts = _figure(shown)
    title = "Terms beyond the motor model"
    return Section("selection", title, sentences, tables=tables, charts=charts, note=note)


def _figure(rows: Sequence[SelectionRow]) -> list[Chart]:
    scored = [row for row in rows if row.gain_holdout is not None]
    if len(scored) < 2:
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
