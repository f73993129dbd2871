"""The results of a run, or of an examination, on the terminal."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from tuner.cli.tables import STYLE_OF_LOOK, console, rich_table
from tuner.core.phrases import listed_within, shorten
from tuner.evaluate.records import RMSE_UNITS
from tuner.report.section import Cell, Table

if TYPE_CHECKING:
    from tuner.job.bench import BenchResult
    from tuner.job.sensitivity import SensitivityResult
    from tuner.report.contents import Contents
    from tuner.result import ExportRecord, RunResult
    from tuner.search.listener import PointEstimate
    from tuner.uncertainty.records import Refit

WIDTH, LINES = 100, 30
"""A finished job prints at most so many lines of each, without --verbose."""
MOST_FLIGHTS, MOST_WARNINGS, LEAST_COEFFICIENTS = 4, 6, 6
DEFAULT_ORIGIN = "default"


def print_run(
    folder: Path, result: RunResult, *, seconds: float | None = None, verbose: bool = False
) -> None:
    """Print the outcome of a run, in no more than `LINES` lines unless verbose.

    Parameters
    ----------
    folder, result
        Of the run.
    seconds
        That it took in all, where that is known.
    verbose
        Also print the page's sections.
    """
    from tuner.report.contents import read_contents

    contents = read_contents(folder)
    if verbose:
        _print_sections(contents, lambda key: key != "provenance")
    screen = console(WIDTH)
    for line in _summary(contents, result, seconds):
        if isinstance(line, Table):
            screen.print(rich_table(line))
        else:
            screen.print(line, soft_wrap=True)


def _summary(contents: Contents, result: RunResult, seconds: float | None) -> list[Text | Table]:
    """Return the lines and tables of a finished job."""
    from tuner.report.outcome import flights_table, next_step, outcome

    folder, exports = contents.folder, contents.exports
    found = outcome(result, contents.bench, exports)
    lines: list[Text | Table] = [
        Text(
            shorten(f"{found.usability.capitalize()}. {found.what}", WIDTH),
            f"bold {STYLE_OF_LOOK[found.look]}",
        ),
        *(Text(line) for line in _origins(result)),
    ]
    if found.checks:
        lines.append(flights_table(found.checks[:MOST_FLIGHTS]))
    lines += _warnings(result)
    end = [Text(line) for line in (*_unlisted(result), *_print_files(folder, exports, seconds))]
    words, command = next_step(result, found, folder, exports)
    end.append(Text(f"Next: {words} {command}"))
    taken = sum(1 + len(line.rows) if isinstance(line, Table) else 1 for line in (*lines, *end))
    return [*lines, *_coefficients(result, max(LINES - taken - 1, LEAST_COEFFICIENTS)), *end]


def _origins(result: RunResult) -> list[str]:
    """Return from where the settings come, in a line."""
    origin = result.settings.get("origin")
    by_place: dict[str, list[str]] = {}
    for name, place in (origin if isinstance(origin, dict) else {}).items():
        _, _, behind = str(place).partition("(")
        is_default = str(place).startswith(DEFAULT_ORIGIN)
        by_place.setdefault(
            DEFAULT_ORIGIN if is_default else behind.rstrip(")") or str(place), []
        ).append(name)
    given = [f"{', '.join(n)} by {p}" for p, n in by_place.items() if p != DEFAULT_ORIGIN]
    parts = [*given, "all else by default" if given else "all by default"]
    return [shorten(f"Settings: {'; '.join(parts)}.", WIDTH)] if by_place else []


def _warnings(result: RunResult) -> list[Text]:
    from tuner.findings.findings import merge_alike, shorten_finding
    from tuner.report.outcome import sort_by_weight

    found = merge_alike(sort_by_weight(result.findings))
    lines = [
        Text(f"! {shorten_finding(one, WIDTH - 2)}", "yellow") for one in found[:MOST_WARNINGS]
    ]
    if len(found) > MOST_WARNINGS:
        more = f"! {len(found) - MOST_WARNINGS} more warnings are in the report."
        lines.append(Text(more, "yellow"))
    return lines


def _coefficients(result: RunResult, room: int) -> list[Text | Table]:
    """Return the fitted coefficients, those least known first where they do not fit."""
    from tuner.uncertainty.verdict import Verdict, half_width_in_words, verdict_in_words

    fitted = {name: row for name, row in result.coefficients.items() if row.fitted}
    shown = list(fitted)
    if len(shown) > room:
        least = sorted(shown, key=lambda n: fitted[n].verdict is Verdict.WELL_KNOWN)[: room - 1]
        shown = [name for name in shown if name in least]
    looks = {Verdict.WELL_KNOWN: "well", Verdict.WEAKLY_KNOWN: "weak"}
    rows = [
        (
            name,
            f"{row.initial:.5g}",
            f"{row.best:.5g}",
            half_width_in_words(row.ci95, row.best, row.unit),
            row.unit,
            Cell(verdict_in_words(row.verdict), look=looks.get(row.verdict, "not")),
        )
        for name, row in fitted.items()
        if name in shown
    ]
    columns = ("coefficient", "start", "fitted", "± 95 %", "unit", "known")
    lines: list[Text | Table] = [Table(columns, rows, words=("coefficient", "unit", "known"))]
    if others := len(fitted) - len(shown):
        lines.append(Text(f"{others} more fitted coefficients are in the report."))
    return lines if rows else []


def _unlisted(result: RunResult) -> list[str]:
    """Return a line on fixed coefficients and one on the terms."""
    from tuner.report.result_texts import nearly_kept

    fixed = [
        f"{name} {row.best:.4g} {row.unit}".rstrip()
        for name, row in result.coefficients.items()
        if not row.fitted
    ]
    lines = [f"Fixed: {listed_within(fixed, WIDTH - 8)}."] if fixed else []
    if rows := result.selection:
        kept = [row.group for row in rows if row.kept]
        nearly = [row.group for row in rows if nearly_kept(row)]
        text = f"Terms: {', '.join(kept) if kept else 'none'} of {len(rows)} kept"
        text += f"; nearly: {', '.join(nearly)}" if nearly else ""
        lines.append(shorten(f"{text}.", WIDTH))
    return lines


def _print_files(folder: Path, exports: Sequence[ExportRecord], seconds: float | None) -> list[str]:
    files = [one.file for one in exports if one.file]
    refused = [f"{one.format} was refused" for one in exports if one.refused]
    took = "" if seconds is None else f" in {seconds:.0f} s"
    parts = [part for part in (", ".join(files), "; ".join(refused)) if part]
    lines = [shorten(f"Exported: {'; '.join(parts)}.", WIDTH)] if parts else []
    return [*lines, f"Written to {shlex.quote(str(folder))}{took}: report.html, best_fit.yaml."]


def _print_sections(contents: Contents, wanted: Callable[[str], bool]) -> None:
    """Print the page of a result folder, without its figures: the sections of wanted keys."""
    from tuner.report.page import sections_of

    screen = console()
    for section in filter(lambda section: wanted(section.key), sections_of(contents)):
        screen.print(Text(f"\n{section.title}", "bold"))
        for sentence in section.sentences:
            screen.print(Text(sentence))
        for point in section.points:
            screen.print(Text(f"- {point.text}", STYLE_OF_LOOK.get(point.look, "")))
        for table in section.tables:
            screen.print(rich_table(table))
        if section.note:
            screen.print(Text(section.note, "dim"))


def print_bench(bench: BenchResult, *, verbose: bool = False) -> None:
    """Print the results of each experiment and of all together, and the folder."""
    from tuner.ground.bench_json import agreement_in_words, bench_record, numbers_in_words

    screen = console()
    record = bench_record(bench.combination, bench.measurements)
    for experiment in record.experiments:
        screen.print(f"{experiment.name}: {'; '.join(numbers_in_words(experiment))}")
    screen.print(agreement_in_words(record))
    print_run(bench.folder, bench.result, verbose=verbose)


def print_sensitivity(result: SensitivityResult, *, verbose: bool = False) -> None:
    """Print each coefficient's interval, the next flight, and the folder."""
    from tuner.findings.findings import one_line
    from tuner.report.contents import read_contents
    from tuner.uncertainty.verdict import direction_in_words

    screen, first = console(), ("coefficients", "next_flight")
    _print_sections(read_contents(result.folder), lambda key: verbose or key in first)
    for finding in result.findings:
        screen.print(one_line(finding))
    for direction in result.knowledge.directions[:1]:
        screen.print(
            f"The worst determined combination of coefficients: {direction_in_words(direction)}"
        )
    screen.print(f"Written to {result.folder}: report.html, sensitivity.csv, correlation.csv.")


def estimates_table(estimates: Sequence[PointEstimate]) -> object:
    """Return the table of values at the end of a search, before their intervals are known."""
    rows = [(row.name, f"{row.initial:.5g}", f"{row.estimate:.5g}", row.unit) for row in estimates]
    columns = ("coefficient", "initial", "estimate", "unit")
    return rich_table(Table(columns, rows, words=("coefficient", "unit")))


def folds_table(folds: Sequence[Refit]) -> object:
    """Return the table of predictions of each flight by the fit to the others."""
    rows = [
        (
            fold.left_out or "",
            *(
                "impossible"
                if fold.rmse is None
                else "crash"
                if (value := getattr(fold.rmse, axis)) is None
                else f"{value:.3g}"
                for axis in RMSE_UNITS
            ),
        )
        for fold in folds
    ]
    columns = ("left out", *(f"{axis} {unit}" for axis, unit in RMSE_UNITS.items()))
    title = "RMSE of each flight with the fit to the others"
    return rich_table(Table(columns, rows, words=("left out",), fold=title))
