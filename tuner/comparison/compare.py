"""From what a user names to the table of several coefficient sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from tuner.comparison.layout import Layout
from tuner.comparison.table import Table, table_of
from tuner.comparison.write import check_suffix, write_table
from tuner.config import (
    Options,
    Settings,
    TrajectorySettings,
    VehicleFile,
    find_config,
    read_vehicle,
    settle,
)
from tuner.config.model import build
from tuner.errors import InputError, did_you_mean
from tuner.flights.flight import Flight
from tuner.flights.load import load_flights
from tuner.simulation.trajectory import with_named_reference


def compare(
    options: Options,
    vehicles: Sequence[str] | Mapping[str, str | VehicleFile],
    out: Sequence[Path] = (),
) -> tuple[Table, Settings]:
    """Fly recordings with several vehicles, and tabulate how closely each meets them.

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
        Something named does not exist, cannot be read, or holds no reference.
    """
    for path in out:
        check_suffix(path)
    settings = settle(options, fits=False)
    if not vehicles:
        raise InputError("--vehicle", "names no vehicle", "name those to compare")
    if not isinstance(vehicles, Mapping):
        vehicles = {word: word for word in vehicles}
    named = {label: _vehicle(said) for label, said in vehicles.items()}
    flights = flights_of(settings)
    offsets = {flight.name: offset_of(settings, flight.name) for flight in flights}
    comparison = Layout(flights, settings.controller, settings.job, offsets)
    table = table_of({word: comparison.fly(vehicle) for word, vehicle in named.items()})
    for path in out:
        write_table(table, path)
    return table, settings


def _vehicle(said: str | VehicleFile) -> VehicleFile:
    if isinstance(said, VehicleFile):
        return said
    return read_vehicle(find_config("vehicles", said, Path()))


def flights_of(settings: Settings) -> tuple[Flight, ...]:
    """Read every mission of the settled recordings, with the named reference where one is named.

    Raises
    ------
    InputError
        A recording cannot be read, or its side-car names an impossible trajectory.
    """
    job = settings.job
    read = [
        flight
        for path in settings.flights
        for flight in load_flights(path, topics=job.topics, namespace=job.namespace)
    ]
    names = [flight.name for flight in read]
    for name in job.holdout:
        if name not in names:
            raise InputError("holdout", f"no flight '{name}'", did_you_mean(name, names))
    return tuple(_with_reference(flight, settings) for flight in read)


def _with_reference(flight: Flight, settings: Settings) -> Flight:
    own = settings.job.flights.get(flight.name)
    if own is not None and own.trajectory is not None:
        return with_named_reference(flight, own.trajectory)
    if flight.trajectory is not None and not flight.has("reference_position"):
        named = build(TrajectorySettings, flight.trajectory, f"side-car of {flight.path}")
        return with_named_reference(flight, named)
    return flight


def offset_of(settings: Settings, name: str) -> float:
    """Return the clock offset in s that the job file fixes for a flight, 0 where it is free."""
    own = settings.job.flights.get(name)
    said = settings.job.time_offset if own is None or own.time_offset is None else own.time_offset
    return 0.0 if said == "free" else float(said)
