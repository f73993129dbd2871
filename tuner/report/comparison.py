"""``tune compare``: the RMSE of several vehicles on recordings, as a table, CSV, JSON or page."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tuner.config import Settings, resolve_settings
from tuner.core.disk import check_file, write_text
from tuner.core.errors import InputError
from tuner.core.files import csv_text
from tuner.core.shipped import find_config
from tuner.evaluate.comparison import OVERALL, Comparison, table_of
from tuner.evaluate.records import RMSE_UNITS, RmseRow, RmseTable
from tuner.findings.findings import one_line
from tuner.options import RecordingOptions
from tuner.report.page import page_of
from tuner.report.paper import check_figure, comparison_figure, write_figure
from tuner.report.section import Cell, PageSection, Table
from tuner.search.job_flights import read_recordings, with_logged_parameters
from tuner.vehicle import VehicleFile, read_vehicle


def compare(
    options: RecordingOptions,
    vehicles: Sequence[str] | Mapping[str, str | VehicleFile],
    out: Sequence[Path] = (),
    plot: Path | None = None,
    *,
    on_message: Callable[[str], None] = lambda _: None,
) -> tuple[RmseTable, Settings]:
    """Simulate recorded flights with several vehicles, and tabulate the RMSE of each.

    Parameters
    ----------
    options
        Flights, controller, job file and topics; the vehicle's mass is each vehicle file's own.
    vehicles
        Vehicle files or names of shipped ones; or label -> one of those, or a vehicle.
    out
        Files for the table, by suffix .csv, .json or .html.
    plot
        File for a figure of the position errors over time.
    on_message
        Called with a line on each flight that is left out, or simulated with another inlet.

    Returns
    -------
    tuple
        The table, and the settings.

    Raises
    ------
    InputError
        A named input does not exist or cannot be used, or a file cannot be written.
    """
    if plot is not None:
        check_figure(plot)
    for path in out:
        check_table_file(path)
    settings, logged = with_logged_parameters(resolve_settings(options, fits=False))
    read = {flight.resolve() for flight in settings.flights}
    for path in out:
        if path.resolve() in read:
            raise InputError("--out", f"{path} is one of the flights", "name another file")
    if not vehicles:
        raise InputError("--vehicle", "names no vehicle", "name the vehicles to compare")
    if not isinstance(vehicles, Mapping):
        vehicles = {name: name for name in vehicles}
    sets = {
        label: named
        if isinstance(named, VehicleFile)
        else read_vehicle(find_config("vehicles", named, Path()))
        for label, named in vehicles.items()
    }
    recordings, noticed = read_recordings(settings, fits=False)
    for finding in (*logged, *noticed):
        on_message(one_line(finding))
    comparison = Comparison(recordings, settings.controller, window=settings.job.search.window)
    flown = {label: comparison.fly(vehicle) for label, vehicle in sets.items()}
    table = table_of(flown)
    if plot is not None:
        write_figure(comparison_figure(flown), plot)
    for path in out:
        write_table(table, path)
    return table, settings


def write_table(table: RmseTable, path: Path) -> None:
    """Write a comparison in the format that the file's suffix names.

    Raises
    ------
    InputError
        The suffix is none of .csv, .json and .html, or the file cannot be written.
    """
    write_text(path, _writer(path)(table))


def check_table_file(path: Path) -> None:
    """Refuse a file that `write_table` could not write, before anything is computed."""
    _writer(path)
    check_file(path)


def _writer(path: Path) -> Callable[[RmseTable], str]:
    writers = {
        ".csv": _csv,
        ".json": lambda table: table.model_dump_json(indent=2) + "\n",
        ".html": _html,
    }
    if path.suffix not in writers:
        raise InputError(
            path, f"a table cannot be written as '{path.suffix}'", "name a .csv, .json or .html"
        )
    return writers[path.suffix]


def _csv(table: RmseTable) -> str:
    header = ("flight", "lap", "vehicle", "axis", "unit", "rmse", "best", "crash_time")
    rows = []
    for row in table.rows:
        winners = table.winners(row.flight, row.lap)
        for axis, unit in RMSE_UNITS.items():
            first, rmse = int(winners.get(axis) == row.vehicle), getattr(row.rmse, axis)
            place = (row.flight, row.lap, row.vehicle, axis, unit)
            rows.append((*place, rmse, first, row.crash_time))
    return csv_text(header, rows)


def _html(table: RmseTable) -> str:
    what = (
        "Root mean square error of the whole flight simulated from its reference, or, for a flight "
        "that enters the loop further down, of its windows; position in m, attitude in degrees. "
        "The lowest of each column is marked."
    )
    sentences = (what, best_in_words(table))
    section = PageSection("rmse", "RMSE", sentences, tables=[comparison_table(table, laps=True)])
    return page_of("Simulated against recorded", [section])


def best_in_words(table: RmseTable) -> str:
    """Return a sentence on the vehicle closest to all recordings."""
    return f"Best over all flights: {table.best or 'none, all of them crashed'}."


def comparison_table(table: RmseTable, *, laps: bool) -> Table:
    """Return the RMSE of every vehicle and flight, the lowest marked and starred."""
    columns = ("flight", "vehicle", *(f"{axis} [{unit}]" for axis, unit in RMSE_UNITS.items()))
    rows = [_cells(row, table) for row in table.rows if laps or row.lap is None]
    return Table(columns, rows, words=("flight", "vehicle"))


def _cells(row: RmseRow, table: RmseTable) -> list[Cell | str]:
    stretch = "all flights" if row.flight == OVERALL else row.flight
    first = stretch if row.lap is None else f"{stretch} lap {row.lap}"
    if row.crash_time is not None:
        return [first, row.vehicle, f"crashed at {row.crash_time:.2f} s"]
    winners = table.winners(row.flight, row.lap)
    cells: list[Cell | str] = [first, row.vehicle]
    for axis, value in row.rmse:
        best = winners.get(axis) == row.vehicle and len(table.vehicles) > 1
        text = "–" if value is None else f"{value:.4f}"
        cells.append(Cell(f"{text}*", look="well") if best else f"{text} ")
    return cells
