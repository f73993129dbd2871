"""Results on the terminal: tables, a run, an examination, and what single commands have done."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.segment import Segment
from rich.table import Table as DrawnTable
from rich.text import Text

from tuner.core.phrases import listed_within, percent, printable, shorten
from tuner.evaluate.records import RMSE_UNITS
from tuner.recordings.notes import damage_sentence, note_in_words
from tuner.report.section import Cell, Table

if TYPE_CHECKING:
    from tuner.config import Settings
    from tuner.evaluate.records import RmseTable
    from tuner.evaluate.simulation_files import Summary
    from tuner.exporters.export import ExportedFile
    from tuner.job.bench import BenchResult
    from tuner.job.sensitivity import SensitivityResult
    from tuner.recordings.inspection import Inspection, MissionReport
    from tuner.report.contents import Contents
    from tuner.result import ExportRecord, RunResult
    from tuner.search.listener import PointEstimate
    from tuner.uncertainty.records import Refit
    from tuner.vehicle.scaling_laws import ScaledEstimate


#: Columns that a table may take, if need be beyond the terminal's, so that no number is cut.
CONSOLE_WIDTH = 140
#: Columns of a pipe or a file: no line is cut or wrapped.
PIPE_WIDTH = 100_000


class _Screen(Console):
    """A terminal on which a text that others wrote is a text, neither markup nor control codes."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterable[Segment]:
        for text, style, control in super().render(renderable, options):
            yield Segment(text if control else printable(text), style, control)


def console(width: int = CONSOLE_WIDTH) -> Console:
    """Return a console of at least so many columns, so that no number is cut."""
    fitting = _Screen(highlight=False, markup=False)
    columns = max(fitting.width, width) if fitting.is_terminal else PIPE_WIDTH
    return _Screen(highlight=False, markup=False, width=columns, height=fitting.height)


def line_width(screen: Console) -> int:
    """Return how many letters a line of a finished job may have."""
    return WIDTH if screen.is_terminal else PIPE_WIDTH


STYLE_OF_LOOK = {
    "well": "green",
    "weak": "yellow",
    "not": "red",
    "worse": "red",
    "failure": "red",
    "dim": "dim",
}
"""Class of the page's style -> of the terminal's."""


def rich_table(table: Table) -> DrawnTable:
    """Return a table as the terminal draws it: words on the left, numbers on the right."""
    made = DrawnTable(
        box=None,
        title=table.fold or None,
        title_justify="left",
        title_style="bold",
        pad_edge=False,
    )
    for name in table.columns:
        left = name in table.words
        made.add_column(name.strip(), justify="left" if left else "right", no_wrap=name == "topic")
    for row in table.rows:
        made.add_row(*map(_cell, row))
    return made


def _cell(of: Cell | str) -> Text:
    if isinstance(of, str):
        return Text(of)
    text = f"{of.text}: {of.small}" if of.look and of.small else of.text
    return Text(text, STYLE_OF_LOOK.get(of.look, ""))


def print_flights(summaries: Sequence[Summary], path: Path) -> None:
    """Print one line a simulated flight, and where they were written."""
    measures = ("top speed m/s", "off reference x m", "y", "z", "crashed")
    rows = [
        (
            *(f"{value:.6g}" for value in summary.coefficients.values()),
            f"{summary.top_speed:.2f}",
            *(f"{axis:.3f}" for axis in summary.tracking_rmse),
            "no" if summary.crash_time is None else f"at {summary.crash_time:.2f} s",
        )
        for summary in summaries
    ]
    screen = console()
    screen.print(rich_table(Table((*summaries[0].coefficients, *measures), rows)))
    screen.print(f"written to {path}")


def print_export(done: ExportedFile) -> None:
    """Print the gates of an export, its notes, and its file."""
    screen = console()
    for gate in done.gates:
        met = "yes" if gate.passed else "NO "
        name = (
            gate.name if gate.ran else f"{gate.name} (not looked at: it needs a run's recordings)"
        )
        screen.print(f"{met if gate.ran else '---'}  {name}")
        for objection in gate.objections:
            screen.print(f"     {objection}")
    for note in done.notes:
        screen.print(f"note: {note}")
    screen.print(f"written to {done.path} and read back")


def print_estimates(estimates: Mapping[str, ScaledEstimate], path: Path) -> None:
    """Print a vehicle's coefficients by scaling laws, how crude each is, and where they lie."""
    from tuner.vehicle import COEFFICIENTS

    rows = [
        (name, f"{of.value:.4g}", percent(of.error), COEFFICIENTS[name].unit, of.source)
        for name, of in estimates.items()
    ]
    columns = ("coefficient", "value", "±", "unit", "source")
    screen = console()
    screen.print(rich_table(Table(columns, rows, words=("coefficient", "unit", "source"))))
    screen.print(f"written to {path} and {path.stem}.job.yaml")


def print_comparison(
    table: RmseTable, settings: Settings, *, laps: bool, written: Sequence[Path]
) -> None:
    """Print the RMSE of every vehicle and flight, the lowest marked."""
    from tuner.report.comparison import best_in_words, comparison_table

    screen = console()
    screen.print(f"controller: {settings.origin['controller']}")
    screen.print(rich_table(comparison_table(table, laps=laps)))
    screen.print(best_in_words(table))
    for path in written:
        screen.print(f"written to {path}")


WIDTH, LINES = 100, 30
"""A finished job prints at most so many lines of each on a terminal, without --verbose."""
MOST_FLIGHTS, MOST_WARNINGS, LEAST_COEFFICIENTS = 4, 6, 6
DEFAULT_ORIGIN = "default"


def print_run(
    folder: Path, result: RunResult, *, seconds: float | None = None, verbose: bool = False
) -> None:
    """Print the outcome of a run, in no more than `LINES` lines unless verbose.

    Lines are cut on a terminal alone.

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
    for line in _summary(contents, result, seconds, line_width(screen)):
        if isinstance(line, Table):
            screen.print(rich_table(line))
        else:
            screen.print(line, soft_wrap=True)


def _summary(
    contents: Contents, result: RunResult, seconds: float | None, width: int
) -> list[Text | Table]:
    """Return the lines and tables of a finished job."""
    from tuner.report.outcome import flights_table, next_step, outcome

    folder, exports = contents.folder, contents.exports
    found = outcome(result, contents.bench, exports)
    lines: list[Text | Table] = [
        Text(
            shorten(f"{found.usability.capitalize()}. {found.what}", width),
            f"bold {STYLE_OF_LOOK[found.look]}",
        ),
        *(Text(line) for line in _origins(result, width)),
    ]
    if found.checks:
        lines.append(flights_table(found.checks[:MOST_FLIGHTS]))
    lines += _warnings(result, width)
    end = [
        Text(line)
        for line in (*_unlisted(result, width), *_print_files(folder, exports, seconds, width))
    ]
    words, command = next_step(result, found, folder, exports)
    end.append(Text(f"Next: {words} {command}"))
    taken = sum(1 + len(line.rows) if isinstance(line, Table) else 1 for line in (*lines, *end))
    return [*lines, *_coefficients(result, max(LINES - taken - 1, LEAST_COEFFICIENTS)), *end]


def _origins(result: RunResult, width: int) -> list[str]:
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
    return [shorten(f"Settings: {'; '.join(parts)}.", width)] if by_place else []


def _warnings(result: RunResult, width: int) -> list[Text]:
    from tuner.findings.findings import merge_alike, shorten_finding
    from tuner.report.outcome import sort_by_weight

    found = merge_alike(sort_by_weight(result.findings))
    lines = [
        Text(f"! {shorten_finding(one, width - 2)}", "yellow") for one in found[:MOST_WARNINGS]
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


def _unlisted(result: RunResult, width: int) -> list[str]:
    """Return a line on fixed coefficients and one on the terms."""
    from tuner.report.result_texts import nearly_kept

    go_with = {"mass": " (forces, drag and inertia go with it)"}
    fixed = [
        f"{name} {row.best:.4g} {row.unit}".rstrip() + go_with.get(name, "")
        for name, row in result.coefficients.items()
        if not row.fitted
    ]
    lines = [f"Fixed: {listed_within(fixed, width - 8)}."] if fixed else []
    if rows := result.selection:
        kept = [row.group for row in rows if row.kept]
        nearly = [row.group for row in rows if nearly_kept(row)]
        text = f"Terms: {', '.join(kept) if kept else 'none'} of {len(rows)} kept"
        text += f"; nearly: {', '.join(nearly)}" if nearly else ""
        lines.append(shorten(f"{text}.", width))
    return lines


def _print_files(
    folder: Path, exports: Sequence[ExportRecord], seconds: float | None, width: int
) -> list[str]:
    files = [one.file for one in exports if one.file]
    refused = [f"{one.format} was refused" for one in exports if one.refused]
    took = "" if seconds is None else f" in {seconds:.0f} s"
    parts = [part for part in (", ".join(files), "; ".join(refused)) if part]
    lines = [shorten(f"Exported: {'; '.join(parts)}.", width)] if parts else []
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
    from tuner.ground.measurement import agreement_in_words, numbers_in_words

    screen = console()
    for experiment in bench.record.experiments:
        screen.print(f"{experiment.name}: {'; '.join(numbers_in_words(experiment))}")
    screen.print(agreement_in_words(bench.record))
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


LOOK_OF_INFORMATION = {"yes": "well", "weakly": "weak", "no": "not"}
"""Whether a recording shows a coefficient -> look of its cell."""


def inspections_drawn(
    inspections: Iterable[Inspection], verdicts: Mapping[str, Sequence[str]] | None = None
) -> RenderableType:
    """Return inspections of recordings for rich to print.

    Parameters
    ----------
    verdicts
        Path -> lines that say whether and how it can be fitted, printed first.
    """
    verdicts = verdicts or {}
    return Group(
        *(
            part
            for each in inspections
            for part in _drawn_inspection(each, verdicts.get(each.path, ()))
        )
    )


def _drawn_inspection(inspection: Inspection, verdict: Sequence[str]) -> list[RenderableType]:
    size = f"{inspection.size / 1e6:.1f} MB"
    about = [inspection.format, size, f"{inspection.duration:.1f} s"]
    about += [inspection.started.replace("+00:00", " UTC")] if inspection.started else []
    about += [f"topic map {inspection.topic_map}"] if inspection.topic_map else []
    parts: list[RenderableType] = [Text(), Text(inspection.path, "bold"), Text(" · ".join(about))]
    colour = "red" if verdict and verdict[0].startswith("cannot") else "green"
    parts += [Text(line, colour if not line.startswith(" ") else "") for line in verdict]
    if inspection.problem and not verdict:
        parts.append(Text(inspection.problem, "red"))
    parts += [Text(f"warning: {damage_sentence(damage)}", "yellow") for damage in inspection.damage]
    parts.append(rich_table(_topics(inspection)))
    if inspection.missions:
        parts.append(rich_table(_missions(inspection)))
    if inspection.clock or inspection.battery:
        parts.append(_clock_and_battery(inspection))
    parts.append(rich_table(_inlets(inspection)))
    if inspection.coefficients:
        parts.append(rich_table(_informed(inspection)))
    for note in inspection.notes:
        colour = "yellow" if note.kind == "warning" else "dim"
        topic = f"{note.topic}: " if note.topic else ""
        parts.append(Text(f"{note.kind}: {topic}{note_in_words(note)}", colour))
    return parts


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return "" if value is None else format(value * scale, form)


def _topics(inspection: Inspection) -> Table:
    columns = ("topic", "type", "messages", "Hz", "gap s", "jitter ms", "delay ms", "used for")
    rows = [
        _dim_unless(
            bool(topic.signals),
            topic.name or "(table)",
            topic.type,
            str(topic.count),
            _number(topic.rate, ".1f"),
            _number(topic.longest_gap, ".3f"),
            _number(topic.jitter, ".2f", 1e3),
            _number(topic.delay, ".2f", 1e3) if topic.delay and abs(topic.delay) < 3600 else "",
            ", ".join(topic.signals),
        )
        for topic in inspection.topics
    ]
    return Table(columns, rows, words=("topic", "type", "used for"), fold="topics")


def _dim_unless(used: bool, *cells: str) -> list[Cell]:
    return [Cell(text, look="" if used else "dim") for text in cells]


def _missions(inspection: Inspection) -> Table:
    numbers = ("laps", "mean m/s", "top m/s", "tilt °", "turn rad/s", "height m", "pose known")
    rows = [
        (
            f"{mission.start:.2f}",
            f"{mission.duration:.2f}",
            mission.begins_with,
            "" if mission.laps is None else str(mission.laps),
            f"{mission.mean_speed:.2f}",
            f"{mission.top_speed:.2f}",
            f"{mission.largest_tilt:.1f}",
            _number(mission.top_turn_rate, ".2f"),
            f"{mission.height[0]:.2f}–{mission.height[1]:.2f}",
            f"{100 * mission.known:.1f} %",
            _remark(mission),
        )
        for mission in inspection.missions
    ]
    columns = ("start s", "s", "begins with", *numbers, "remark")
    return Table(columns, rows, words=("begins with", "remark"), fold="missions")


def _remark(mission: MissionReport) -> str:
    spin = mission.yaw_rate_setpoint
    if spin is None:
        return "" if mission.fitted else "others show more: not fitted"
    return f"yaw spin at {spin:g} rad/s" + (", held level" if mission.level_held else "")


def _clock_and_battery(inspection: Inspection) -> Text:
    remarks = []
    if "spread" in inspection.clock:
        remarks.append(
            f"the reference's stamps are late by up to {1e3 * inspection.clock['spread']:.2f} ms"
        )
    if inspection.clock.get("drift"):
        remarks.append(f"its clock drifts by {1e6 * inspection.clock['drift']:+.0f} ppm")
    offset = inspection.clock.get("pose_offset")
    if offset is not None:
        remarks.append(f"the pose's stamps are {1e3 * offset:+.1f} ms late against the gyro's")
    text = f"clock: {', '.join(remarks)}" if remarks else ""
    if inspection.battery:
        first, last = inspection.battery
        text += f"{'   ' if text else ''}battery: {first:.2f} V to {last:.2f} V"
    return Text(text)


def _inlets(inspection: Inspection) -> Table:
    rows = []
    for inlet in inspection.inlets:
        usable = not inlet.missing and inspection.problem is None
        lacks = f"lacks {', '.join(inlet.missing)}" if inlet.missing else "no mission"
        rows.append(_dim_unless(usable, inlet.name, "yes" if usable else lacks))
    columns = ("inlet", "can be fed from this recording")
    return Table(columns, rows, words=columns, fold="inlets")


def _informed(inspection: Inspection) -> Table:
    rows = [
        (found.coefficient, Cell(found.how, look=LOOK_OF_INFORMATION[found.how]), found.why)
        for found in inspection.coefficients
    ]
    columns = ("coefficient", "", "because")
    return Table(columns, rows, words=columns, fold="could inform")
