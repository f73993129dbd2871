"""The command ``tune compare`` as a function: recordings and vehicles to the table of RMSE."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tuner.comparison.comparison import Comparison
from tuner.comparison.table import Table, check_table_file, write_table
from tuner.comparison.tabulate import table_of
from tuner.config import Options, Settings, VehicleFile, find_config, read_vehicle, settle
from tuner.errors import InputError
from tuner.recordings import read_recordings


def compare(
    options: Options,
    vehicles: Sequence[str] | Mapping[str, str | VehicleFile],
    out: Sequence[Path] = (),
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
    settings = settle(options, fits=False)
    if not vehicles:
        raise InputError("--vehicle", "names no vehicle", "name the vehicles to compare")
    if not isinstance(vehicles, Mapping):
        vehicles = {name: name for name in vehicles}
    sets = {label: _vehicle(named) for label, named in vehicles.items()}
    comparison = Comparison(
        read_recordings(settings), settings.controller, window=settings.job.search.window
    )
    table = table_of({label: comparison.fly(vehicle) for label, vehicle in sets.items()})
    for path in out:
        write_table(table, path)
    return table, settings


def _vehicle(named: str | VehicleFile) -> VehicleFile:
    if isinstance(named, VehicleFile):
        return named
    return read_vehicle(find_config("vehicles", named, Path()))
