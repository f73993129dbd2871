"""The command ``tune compare`` as a function: recordings and vehicles to the table of RMSE."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from tuner.config import Options, Settings, settle
from tuner.core.errors import InputError
from tuner.core.shipped import find_config
from tuner.evaluate.comparison import Comparison
from tuner.evaluate.comparison_table import Row, Table, check_table_file, write_table
from tuner.evaluate.records import RMSE_UNITS, AxesRmse
from tuner.evaluate.rmse import FlightErrors, rmse_of
from tuner.findings.findings import one_line
from tuner.search.job_flights import as_logged, read_usable
from tuner.vehicle import VehicleFile, read_vehicle

OVERALL = "all"
#: A lap in which fewer poses were recorded than this is left out.
FEWEST_POSES = 10


def compare(
    options: Options,
    vehicles: Sequence[str] | Mapping[str, str | VehicleFile],
    out: Sequence[Path] = (),
    *,
    on_flown: Callable[[Mapping[str, Mapping[str, FlightErrors]]], None] = lambda _: None,
    on_message: Callable[[str], None] = lambda _: None,
) -> tuple[Table, Settings]:
    """Simulate recorded flights with several vehicles, and tabulate the RMSE of each.

    Parameters
    ----------
    options
        Flights, controller, job file and topics; the vehicle's mass is each vehicle file's own.
    vehicles
        Vehicle files or names of shipped ones; or label -> one of those, or a vehicle.
    out
        Files to write, by suffix .csv, .json or .html.
    on_flown
        Called with vehicle -> flight -> errors.
    on_message
        Called with a line on each flight that is left out, or simulated otherwise than asked.

    Returns
    -------
    tuple
        The table, and what was settled.

    Raises
    ------
    InputError
        Something named does not exist or cannot be used, or a file cannot be written.
    """
    for path in out:
        check_table_file(path)
    settings, logged = as_logged(settle(options, fits=False))
    if not vehicles:
        raise InputError("--vehicle", "names no vehicle", "name the vehicles to compare")
    if not isinstance(vehicles, Mapping):
        vehicles = {name: name for name in vehicles}
    sets = {label: _vehicle(named) for label, named in vehicles.items()}
    recordings, noticed = read_usable(settings, fits=False)
    for finding in (*logged, *noticed):
        on_message(one_line(finding))
    comparison = Comparison(recordings, settings.controller, window=settings.job.search.window)
    flown = {label: comparison.fly(vehicle) for label, vehicle in sets.items()}
    table = table_of(flown)
    on_flown(flown)
    for path in out:
        write_table(table, path)
    return table, settings


def _vehicle(named: str | VehicleFile) -> VehicleFile:
    if isinstance(named, VehicleFile):
        return named
    return read_vehicle(find_config("vehicles", named, Path()))


def table_of(flown: Mapping[str, Mapping[str, FlightErrors]]) -> Table:
    """Return the table of vehicle -> flight -> errors."""
    rows = [
        row
        for stretch in zip(
            *(_rows(vehicle, errors) for vehicle, errors in flown.items()), strict=True
        )
        for row in stretch
    ]
    return Table(vehicles=tuple(flown), best=_best(rows), rows=tuple(rows))


def _rows(vehicle: str, flights: Mapping[str, FlightErrors]) -> list[Row]:
    def row(flight: str, lap: int | None, rmse: AxesRmse, crash_time: float | None) -> Row:
        return Row(flight=flight, lap=lap, vehicle=vehicle, rmse=rmse, crash_time=crash_time)

    rows = []
    for name, errors in flights.items():
        rows.append(row(name, None, errors.rmse, errors.crash_time))
        edges = [0.0, *errors.laps.tolist(), math.inf]
        if len(edges) > 2:
            laps = [errors.between(start, end) for start, end in itertools.pairwise(edges)]
            rows += [
                row(name, number, lap.rmse, errors.crash_time)
                for number, lap in enumerate(laps, start=1)
                if len(lap.position.time) >= FEWEST_POSES
            ]
    crashes = [e.crash_time for e in flights.values() if e.crash_time is not None]
    overall = rmse_of(list(flights.values()))
    rows.append(row(OVERALL, None, overall, min(crashes, default=None)))
    return rows


def _best(rows: Sequence[Row]) -> str | None:
    """Return the vehicle whose overall RMSE has the smallest product over the axes."""
    scores = {}
    for row in rows:
        if row.flight == OVERALL:
            values = [getattr(row.rmse, axis) for axis in RMSE_UNITS]
            known = [max(value, 1e-12) for value in values if value is not None]
            if known and row.crash_time is None:
                scores[row.vehicle] = sum(math.log(value) for value in known) / len(known)
    return min(scores, key=scores.__getitem__) if scores else None
