"""A fit of flights without motion capture: gyro, accelerometer and motor commands alone."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tuner.config import Settings
from tuner.core.errors import ConfigError, InputError, RecordingError
from tuner.evaluate.validation import MAX_RMSE_INCREASE
from tuner.findings.findings import Code, Finding, Level
from tuner.ground.measurement import Combination, Measurement, combine
from tuner.inertial.measurement import measure_inertial, widen_to_agree
from tuner.inertial.signals import RateErrors, rate_errors, stretches_of
from tuner.job.bench import (
    BenchResult,
    conflicts_of,
    known_of,
    measured_vehicle,
    write_measurements,
)
from tuner.recordings.loader import InertialFlight
from tuner.result import place_for
from tuner.search.job_flights import left_out_finding
from tuner.search.listener import SILENT, Listener
from tuner.vehicle import COEFFICIENTS, VehicleFile, values_of, with_values

OVER_MASS = ("motor_constant", "inertia_xx", "inertia_yy")
"""Coefficients that a flight without a pose determines over the mass."""
CURVE = "input_scaling"
"""The scale of the rotors' curve, which such a flight does not determine."""


def fit_without_pose(
    settings: Settings,
    flights: Sequence[InertialFlight],
    *,
    left_out: Sequence[Finding] = (),
    out: Path | None = None,
    listener: Listener = SILENT,
    command: str = "",
) -> BenchResult:
    """Estimate coefficients from flights without a pose and write a result folder.

    Parameters
    ----------
    settings
        Settings of the job; its vehicle has the weighed mass.
    flights
        At least one; held-out flights are predicted and not fitted, and those that cannot be fitted
        are left out, if others remain.
    left_out
        Findings on flights that already were left out.
    out
        Result folder; None makes one under ``runs/`` named by the time.

    Raises
    ------
    InputError
        No flight can be used; nothing was written.
    OutputError
        The result folder cannot be written to.
    """
    began = time.perf_counter()
    start = settings.vehicle
    place_for(out)
    held_out = [flight for flight in flights if flight.name in settings.job.holdout]
    to_fit = [flight for flight in flights if flight.name not in settings.job.holdout]
    measured, used, unusable = _measured(to_fit, start, listener)
    left_out = (*left_out, *unusable)
    nominal = known_of(start)
    alone = combine(measured, nominal)
    measurements = widen_to_agree(measured, alone.chi_square, alone.degrees_of_freedom)
    combination = _combined(measurements, nominal)
    path = Path(used[0].path)
    try:
        vehicle = measured_vehicle(path, start, combination)
    except ConfigError:  # an impossible inertia_zz, by moment_constant over inertia_zz
        measurements = tuple(_without_yaw(m) for m in measurements)
        combination = _combined(measurements, nominal)
        vehicle = measured_vehicle(path, _resized(start, combination), combination)
    return write_measurements(
        out,
        start,
        vehicle.replace(name=f"{start.name}_inertial"),
        measurements,
        combination,
        findings=(
            *left_out,
            *_open_findings(settings, combination.names),
            *_prediction_findings(used, start, vehicle),
            *_prediction_findings(held_out, start, vehicle, held_out=True),
            *conflicts_of(combination),
        ),
        settings={"command": command, "origin": dict(settings.origin)},
        source={"flights": ", ".join(flight.name for flight in used)},
        header=f"From flights without a pose; the rest as in {start.name}.",
        began=began,
    )


def _measured(
    flights: Sequence[InertialFlight], start: VehicleFile, listener: Listener
) -> tuple[list[Measurement], list[InertialFlight], list[Finding]]:
    """Return measurements of flights, these flights, and findings on unusable ones."""
    measured, used, errors = [], [], []
    for flight in flights:
        listener.on_message(f"{flight.name}: fitting body rate and specific force without a pose.")
        try:
            measured.append(measure_inertial(flight, start))
        except RecordingError as error:
            errors.append((flight.name, error))
        else:
            used.append(flight)
    if not used:
        what, to_do = "holds out all flights that can be used", "leave one to fit"
        raise errors[0][1] if errors else InputError("--holdout", what, to_do)
    return measured, used, [left_out_finding(name, error) for name, error in errors]


def _combined(measurements: Sequence[Measurement], nominal: Mapping[str, float]) -> Combination:
    """Return the combination of measurements, with the file's curve of rotor speeds held."""
    combination = combine(measurements, nominal)
    if CURVE not in combination.names:
        return combination
    held = Measurement("curve", ({CURVE: 1.0},), np.array([nominal[CURVE]]), np.array([[1e-6]]))
    scaled = combine((*measurements, held), nominal).scaled
    return combination.model_copy(update={"scaled": scaled})


def _prediction_findings(
    flights: Sequence[InertialFlight],
    start: VehicleFile,
    vehicle: VehicleFile,
    *,
    held_out: bool = False,
) -> Iterator[Finding]:
    """Return findings on predictions of the body rate that are worse than holding, or than before.

    Of held-out flights the last prediction better than holding is reported in any case.
    """
    for flight in flights:
        last: RateErrors | None = None
        for errors in rate_errors(stretches_of(flight.series, flight.flying), start, vehicle):
            if min(errors.fitted, errors.initial) > errors.hold:
                yield _prediction_finding(Code.RATE_NOT_PREDICTED, flight, errors)
                break
            last = errors
        if last is not None and last.fitted > (1.0 + MAX_RMSE_INCREASE) * last.initial:
            yield _prediction_finding(Code.RATE_WORSE, flight, last)
        elif last is not None and held_out:
            yield _prediction_finding(Code.RATE_PREDICTED, flight, last)


def _prediction_finding(code: Code, flight: InertialFlight, errors: RateErrors) -> Finding:
    level: Level = "warning" if code is Code.RATE_WORSE else "info"
    return code.at(
        level,
        flight.name,
        before=errors.initial,
        after=errors.fitted,
        hold=errors.hold,
        seconds=errors.seconds,
    )


def _resized(vehicle: VehicleFile, combination: Combination) -> VehicleFile:
    """Return a vehicle with inertias in the file's proportions, scaled to those of roll and pitch.

    The file's size is wrong where another vehicle flew.
    """
    before = values_of(vehicle)
    changes = [
        COEFFICIENTS[name].value_at(float(scaled)) / before[name]
        for name, scaled in zip(combination.names, combination.scaled, strict=True)
        if name in ("inertia_xx", "inertia_yy")
    ]
    size = float(np.exp(np.mean(np.log(changes)))) if changes else 1.0
    others = {name: size * before[name] for name in ("inertia_xx", "inertia_yy", "inertia_zz")}
    return with_values(vehicle, others)


def _without_yaw(measurement: Measurement) -> Measurement:
    """Return a measurement without inertia_zz, which it determines in combination only."""
    about_z = {"inertia_zz", "torque_trim_z"}
    kept = [i for i, row in enumerate(measurement.rows) if not about_z & set(row)]
    return replace(
        measurement,
        rows=tuple(measurement.rows[i] for i in kept),
        value=measurement.value[kept],
        covariance=measurement.covariance[np.ix_(kept, kept)],
    )


def _open_findings(settings: Settings, names: Sequence[str]) -> Iterator[Finding]:
    """Return findings on coefficients that such flights do not determine."""
    vehicle, scaled = settings.vehicle, tuple(name for name in OVER_MASS if name in names)
    mass = {"mass": values_of(vehicle)["mass"]}
    if settings.origin.get("vehicle", "").startswith("default"):
        yield Code.VEHICLE_NOT_GIVEN.warning(vehicle.name, **mass)
    elif not settings.weighed:
        yield Code.MASS_NOT_GIVEN.warning(vehicle.name, **mass)
    yield Code.SCALES_WITH_MASS.info("mass", *scaled, **mass)
    yield Code.NO_TACHOMETER.info("input_scaling")
    if settings.job.coefficients:
        yield Code.SETTINGS_UNUSED.warning(", ".join(settings.job.coefficients))
    if "moment_constant" in names:
        yield Code.YAW_OPEN.info("inertia_zz")
