"""How the numbers came about: search, selection of terms, remarks, and all that decides them."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence

from tuner.core.phrases import listed
from tuner.findings.findings import remedy, sentence
from tuner.report.contents import Contents, SearchRecord
from tuner.report.result_texts import (
    ending_sentence,
    gain_in_words,
    nearly_kept,
    selection_in_words,
)
from tuner.report.section import (
    FITTED,
    GREY,
    INITIAL,
    PALETTE,
    Bars,
    Cell,
    Chart,
    Line,
    LineStyle,
    PageSection,
    Panel,
    Table,
)
from tuner.vehicle.selection_table import SelectionRow


def search(contents: Contents) -> PageSection | None:
    """Return the waterfall of starts and the search's trace."""
    if contents.result is None or not contents.result.flights:
        return None
    charts = []
    if contents.search is not None:
        charts = [*_waterfall(contents.search), *_trace(contents.search)]
    result = contents.result.search
    how = (
        f"{result.method}: {result.evaluations} Jacobians, {result.iterations} iterations, "
        f"{result.wall_time:.0f} s. {ending_sentence(result.message)}"
    )
    if result.cost_initial is not None and result.cost_best is not None:
        how += (
            " Loss (half the mean squared residual in σ) "
            f"{result.cost_initial:.4g} → {result.cost_best:.4g}."
        )
    return PageSection("search", "Search", sentences=(how,), charts=charts, folded=True)


def _waterfall(record: SearchRecord) -> list[Chart]:
    ends = sorted((s for s in record.starts if s.loss is not None), key=lambda s: s.loss or 0.0)
    if len(ends) < 2:
        return []
    marks = []
    for number, origin in enumerate(dict.fromkeys(start.origin for start in ends)):
        ranked = [(rank, s) for rank, s in enumerate(ends, start=1) if s.origin == origin]
        marks.append(
            Line(
                f"start: {origin}",
                [rank for rank, _ in ranked],
                [start.loss for _, start in ranked],
                LineStyle(PALETTE[number % len(PALETTE)], marks=True),
                joined=False,
                text=[f"{origin}: loss {start.loss:.6g}" for _, start in ranked],
            )
        )
    failed = len(record.starts) - len(ends)
    several = "Starts with the same loss ended in the same minimum; a step is another minimum."
    return [
        Chart(
            key="waterfall",
            title="Loss at the end of each start",
            caption=several + (f" {failed} starts failed." if failed else ""),
            panels=(Panel(marks, y_title="loss", y_scale="log"),),
            x_title="starts, best first",
            height=300,
        )
    ]


def _trace(record: SearchRecord) -> list[Chart]:
    iterations = record.iterations
    if not iterations:
        return []
    steps = [float(number) for number in range(1, len(iterations) + 1)]
    texts = [f"{m.stage}, {'better' if m.accepted else 'tried, not kept'}" for m in iterations]
    rows = (
        ("loss", [m.loss for m in iterations], LineStyle(FITTED.colour, marks=True), "log"),
        (
            "position RMSE [m]",
            [m.position_rmse for m in iterations],
            LineStyle(INITIAL.colour, marks=True),
            "log",
        ),
        ("damping λ", [m.damping for m in iterations], LineStyle(PALETTE[3], marks=True), "log"),
        (
            "horizon [s]",
            [m.horizon for m in iterations],
            LineStyle(PALETTE[2], marks=True),
            "linear",
        ),
    )
    panels = [
        Panel(
            [Line(name.partition(" [")[0], steps, values, look, text=texts)],
            y_title=name,
            y_scale="log" if scale == "log" else "linear",
        )
        for name, values, look, scale in rows
        if any(value is not None for value in values)
    ]
    return [
        Chart(
            key="trace",
            title="Iterations",
            caption="Each stage weighs and compares more of the flights than the one before, so "
            "that losses of different stages do not compare. Damping is the λ of the "
            "Levenberg-Marquardt step that follows.",
            panels=panels,
            x_title="iteration",
            height=160 * len(panels),
        )
    ]


def selection(rows: Sequence[SelectionRow]) -> PageSection:
    """Return the table of the selection and its figure."""
    shown = [row for row in rows if row.kept or nearly_kept(row)]
    table = [
        (
            Cell(row.group, small=", ".join(row.names)),
            gain_in_words(row.gain_fit),
            gain_in_words(row.gain_holdout),
            gain_in_words(row.scatter),
            Cell(
                "in the model" if row.kept else "left out",
                small=row.reason.text,
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
    return PageSection("selection", title, sentences, tables=tables, charts=charts, note=note)


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
            [f"{row.group}: {row.reason.text}" for row in scored],
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


#: Settings that other sections show.
PROVENANCE_KEYS = ("command", "origin", "starts")


def remarks(contents: Contents) -> PageSection | None:
    """Return the findings that are no warnings; warnings are beside the outcome."""
    points = [
        Cell(f"{found.subject}: {sentence(found)} {remedy(found)}".strip())
        for found in contents.about.findings
        if found.level == "info"
    ]
    title = f"{len(points)} remark{'' if len(points) == 1 else 's'}"
    return PageSection("remarks", title, points=points, folded=True) if points else None


def provenance(contents: Contents) -> PageSection:
    """Return everything that decides the numbers."""
    about, origins = contents.about, contents.about.settings.get("origin")
    rows: list[tuple[Cell | str, ...]] = [
        (name, str(origin))
        for name, origin in (origins if isinstance(origins, dict) else {}).items()
    ]
    if contents.result:
        rows.append(("seed", str(contents.result.seed)))
    rows += [
        (flight.name, Cell(f"{flight.duration:.1f} s, {flight.path}", f"sha256 {flight.sha256}"))
        for flight in about.flights
    ]
    rows += [
        (f"{name} as used", f"sha256 {_digest(about.settings[name])}")
        for name in ("vehicle", "controller", "job")
        if name in about.settings
    ]
    rows += list(about.versions.items())
    columns = ("what", "which")
    tables = [Table(columns, rows, words=columns)]
    settings = {
        name: value for name, value in about.settings.items() if name not in PROVENANCE_KEYS
    }
    tables += [
        Table(("",), [(json.dumps(value, indent=2),)], words=("",), fold=name)
        for name, value in settings.items()
    ]
    sentences = (f"Command: {about.command}",) if about.command else ()
    return PageSection("provenance", "Provenance", sentences, tables=tables, folded=True)


def _digest(value: object) -> str:
    """Return the SHA-256 of a setting's content, however its file was laid out."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
