"""The sections that are sentences and tables alone, without a figure."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence

from tuner.core.phrases import percent
from tuner.design.proposals import LogProposal, log_in_words
from tuner.findings.findings import remedy, sentence
from tuner.report.contents import Contents
from tuner.report.result_texts import effective_in_words, refits_in_words, rmse_in_words
from tuner.report.section import Cell, Section, Table, figures, short
from tuner.result import RunResult
from tuner.uncertainty.records import CONFLICT_SE, Sources
from tuner.vehicle import COEFFICIENTS

#: Settings that other sections show.
PROVENANCE_KEYS = ("command", "origin", "starts")


def remarks(contents: Contents) -> Section | None:
    """Return the findings that are no warnings; warnings are beside the outcome."""
    points = [
        Cell(f"{found.subject}: {sentence(found)} {remedy(found)}".strip())
        for found in contents.about.findings
        if found.level == "info"
    ]
    title = f"{len(points)} remark{'' if len(points) == 1 else 's'}"
    return Section("remarks", title, points=points, folded=True) if points else None


def refits(result: RunResult) -> Section | None:
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
    return Section(
        "refits",
        "Refits to other flights",
        refits_in_words(result),
        tables=(Table(columns, rows, words=("coefficient", "unit")),),
        note="± is one standard error. The jackknife leaves each flight out in turn; the bootstrap "
        "draws as many flights with replacement.",
    )


def sources(found: Mapping[str, Sources]) -> Section:
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
    return Section(
        "sources",
        "Ground and flights",
        tables=(Table(columns, rows, words=words),),
        note="± is one standard error, that of flights widened for model error. Flights alone are "
        "what one step without the ground measurements gives from the end of the fit. More than "
        "three standard errors apart is a conflict: do not believe the value of both before one of "
        "them is explained.",
    )


def next_log(proposals: Sequence[LogProposal]) -> Section:
    """Return the effects of further signals, or of more samples, on intervals."""
    points = [Cell(log_in_words(proposal)) for proposal in proposals]
    note = (
        "Computed at the fitted coefficients, with the quoted intervals: an added signal is "
        "simulated and weighed with the noise named; what twice the samples of an input would "
        "bring follows from leaving out some of them."
    )
    return Section("next_log", "What to log next time", points=points, note=note)


def effective(result: RunResult) -> Section | None:
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
        (Cell(term.group, small=", ".join(term.names)), rmse_in_words(term.rmse_without))
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
    return Section("effective", "In Gazebo", (effective_in_words(found),), tables=tables, note=note)


def _change(before: float, after: float) -> str:
    if before == 0.0:
        return "–"
    share = after / before - 1.0
    return f"{'+' if share > 0 else '−'}{percent(abs(share))}"


def provenance(contents: Contents) -> Section:
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
    said = (f"Command: {about.command}",) if about.command else ()
    return Section("provenance", "Provenance", said, tables=tables, folded=True)


def _digest(value: object) -> str:
    """Return the SHA-256 of a setting's content, however its file was laid out."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()
