"""A fit of flights without motion capture: gyro, accelerometer and motor commands alone."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tuner.bench.combine import Combination, combine
from tuner.bench.measurement import Measurement
from tuner.bench.scales import value_of
from tuner.config import Settings, VehicleFile, values_of, with_values
from tuner.errors import ConfigError, RecordingError
from tuner.findings import Code, Finding
from tuner.flights.inertial import InertialFlight, read_inertial
from tuner.inertial.ahead import AHEAD, rate_errors
from tuner.inertial.measurement import agreeing, measure_inertial
from tuner.inertial.signals import stretches_of
from tuner.job.bench import BenchResult, conflicts_of, known_of, vehicle_of, written
from tuner.job.folder import folder_for
from tuner.job.listener import SILENT, Listener

BY_MASS = ("motor_constant", "inertia_xx", "inertia_yy")
"""What a flight without a pose gives over the mass."""


def without_pose(settings: Settings) -> tuple[InertialFlight, ...]:
    """Return the flights of a job, if none of its recordings holds a pose; else none of them.

    Raises
    ------
    RecordingError
        Some recordings hold a pose and others do not.
    """
    job = settings.job
    read = {
        path: read_inertial(path, topics=job.topics, namespace=job.namespace)
        for path in map(Path, settings.flights)
    }
    bare = {path: flight for path, flight in read.items() if flight is not None}
    if bare and len(bare) < len(read):
        raise RecordingError(
            next(iter(bare)),
            "holds no pose, others do",
            "fit those without one by themselves, and give the result folder with --bench",
        )
    return tuple(bare.values())


def fit_without_pose(
    settings: Settings,
    flights: Sequence[InertialFlight],
    *,
    out: Path | None = None,
    listener: Listener = SILENT,
    command: str = "",
) -> BenchResult:
    """Estimate coefficients from flights without a pose and write a result folder.

    Parameters
    ----------
    settings
        Of the job; its vehicle is of the weighed mass.
    flights
        At least one.
    out
        Result folder; None makes one under ``runs/`` named by the time.
    listener
        Whom to report to.
    command
        What the user typed, for the record.

    Raises
    ------
    InputError
        A flight cannot be used; nothing was written.
    OutputError
        The result folder cannot be written to.
    """
    began = time.perf_counter()
    start, folder = settings.vehicle, folder_for(out)
    measured = []
    for flight in flights:
        listener.on_message(f"{flight.name}: fitting body rate and specific force without a pose.")
        measured.append(measure_inertial(flight, start))
    known = known_of(start)
    alone = combine(measured, known)
    measurements = agreeing(measured, alone.chi_square, alone.degrees_of_freedom)
    combination = combine(measurements, known)
    path = Path(flights[0].path)
    try:
        vehicle = vehicle_of(path, start, combination)
    except ConfigError:  # moment_constant over inertia_zz, shared out, gave what no body can have
        measurements = tuple(_without_yaw(m) for m in measurements)
        combination = combine(measurements, known)
        vehicle = vehicle_of(path, _as_flat(start, combination), combination)
    return written(
        folder,
        start,
        vehicle.replace(name=f"{start.name}_inertial"),
        measurements,
        combination,
        findings=(
            *_left_open(settings, combination.names),
            *_foretold(flights, start, vehicle),
            *conflicts_of(combination),
        ),
        settings={"command": command, "origin": dict(settings.origin)},
        source={"flights": ", ".join(flight.name for flight in flights)},
        header=f"From flights without a pose; the rest as in {start.name}.",
        began=began,
    )


def _foretold(
    flights: Sequence[InertialFlight], start: VehicleFile, vehicle: VehicleFile
) -> tuple[Finding, ...]:
    """Return of which flights body rate is foretold worse than before, or than by holding it."""
    findings = []
    for flight in flights:
        errors = rate_errors(stretches_of(flight.series, flight.flying), start, vehicle)
        if errors is None:
            continue
        numbers = {
            "before": errors.initial,
            "after": errors.fitted,
            "hold": errors.hold,
            "seconds": AHEAD,
        }
        if errors.fitted > errors.initial:
            findings.append(Finding(Code.RATE_WORSE, "warning", flight.name, numbers))
        elif errors.fitted > errors.hold:
            findings.append(Finding(Code.RATE_NOT_FORETOLD, "info", flight.name, numbers))
    return tuple(findings)


def _as_flat(vehicle: VehicleFile, combination: Combination) -> VehicleFile:
    """Return a vehicle of the size that was found: its yaw inertia in the file's proportion.

    What the flights say of roll and pitch says how large the vehicle is, of which the file knows
    nothing where another vehicle flew.
    """
    before = values_of(vehicle)
    changes = [
        value_of(name, float(scaled)) / before[name]
        for name, scaled in zip(combination.names, combination.scaled, strict=True)
        if name in ("inertia_xx", "inertia_yy")
    ]
    size = float(np.exp(np.mean(np.log(changes)))) if changes else 1.0
    others = {name: size * before[name] for name in ("inertia_xx", "inertia_yy", "inertia_zz")}
    return with_values(vehicle, others)


def _without_yaw(measurement: Measurement) -> Measurement:
    """Return a measurement without what it says of inertia_zz, which it does not say alone."""
    about_z = {"inertia_zz", "torque_trim_z"}
    kept = [i for i, row in enumerate(measurement.rows) if not about_z & set(row)]
    return replace(
        measurement,
        rows=tuple(measurement.rows[i] for i in kept),
        value=measurement.value[kept],
        covariance=measurement.covariance[np.ix_(kept, kept)],
    )


def _left_open(settings: Settings, names: Sequence[str]) -> tuple[Finding, ...]:
    """Return what such flights leave open, and which number closes it."""
    vehicle, scaled = settings.vehicle, tuple(name for name in BY_MASS if name in names)
    mass = {"mass": values_of(vehicle)["mass"]}
    findings = [
        Finding(Code.SCALES_WITH_MASS, "info", "mass", mass, scaled),
        Finding(Code.NO_TACHOMETER, "info", "input_scaling"),
    ]
    if "moment_constant" in names:
        findings.append(Finding(Code.YAW_OPEN, "info", "inertia_zz"))
    if settings.origin.get("vehicle", "").startswith("default"):
        findings.insert(0, Finding(Code.VEHICLE_NOT_GIVEN, "warning", vehicle.name))
    return tuple(findings)
