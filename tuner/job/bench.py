"""The command `tune bench` as a function: read, estimate, combine, write, report."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import JsonValue

from tuner.core.disk import result_folder
from tuner.core.errors import ConfigError, InputError
from tuner.core.numerics import Z95
from tuner.core.runtime import PROGRAM, versions
from tuner.core.shipped import find_config
from tuner.findings.findings import Code, Finding
from tuner.ground.experiments import experiment_names, measure
from tuner.ground.measurement import (
    BenchRecord,
    Combination,
    Measurement,
    bench_record,
    combine,
)
from tuner.ground.plan import BenchFile, YawSpins, read_bench
from tuner.report import render
from tuner.result import (
    BEST_FIT_FILE,
    CHECKPOINTS,
    CoefficientResult,
    Ending,
    RunResult,
    SearchResult,
    Status,
    forget,
    place_for,
)
from tuner.uncertainty.verdict import NOT_FITTED, Reason, ReasonCode, Verdict, judge_by_error
from tuner.vehicle import (
    COEFFICIENTS,
    VehicleFile,
    read_vehicle,
    values_of,
    with_values,
    write_vehicle,
)
from tuner.vehicle.vehicle import scaled_to_size, size_of

MAX_RELINEARISATIONS = 3
"""Number of times that yaw spins are linearised at the current motor constant."""


@dataclass(frozen=True)
class BenchResult:
    """The result of ground measurements, and its folder.

    Attributes
    ----------
    folder
        With ``result.json``, ``best_fit.yaml``, ``bench.json`` and ``report.html``.
    result
        The content of ``result.json``.
    record
        The content of ``bench.json``: each experiment, in the order of ``bench.yaml``, and all.
    """

    folder: Path
    result: RunResult
    record: BenchRecord


def bench(path: Path, *, out: Path | None = None, command: str = "") -> BenchResult:
    """Estimate coefficients from ground measurements and write a result folder.

    Parameters
    ----------
    out
        Result folder; None makes one under ``runs/`` named by the time.

    Raises
    ------
    InputError
        The input cannot be used; nothing was written.
    OutputError
        The result folder cannot be written to.
    """
    began = time.perf_counter()
    plan = read_bench(path)
    if any(place_for(out).glob(CHECKPOINTS)):
        raise InputError("--out", f"{out} holds the result of a fit", "name another folder")
    unmeasured = read_vehicle(find_config("vehicles", plan.vehicle, path.parent))
    start = unmeasured if plan.weighed_mass is None else unmeasured.replace(mass=plan.weighed_mass)
    measurements, combination, vehicle = _measure_all(path, plan, start)
    return write_measurements(
        out,
        unmeasured,
        vehicle.replace(name=f"{start.name}_bench"),
        measurements,
        combination,
        findings=tuple(conflicts_of(combination)),
        settings={"command": command, "bench": plan.model_dump(mode="json")},
        source={"bench": path.name},
        header=f"From the ground measurements of {path.name}; the rest as in {start.name}.",
        began=began,
    )


def write_measurements(
    out: Path | None,
    initial: VehicleFile,
    vehicle: VehicleFile,
    measurements: tuple[Measurement, ...],
    combination: Combination,
    *,
    findings: tuple[Finding, ...],
    settings: Mapping[str, JsonValue],
    source: Mapping[str, str],
    header: str,
    began: float,
) -> BenchResult:
    """Write a result folder of measurements, and return its content.

    Parameters
    ----------
    out
        The folder; None makes one under ``runs/``.
    initial, vehicle
        The user's, and with the measured coefficients.
    measurements, combination, findings
        Single measurements, their combination, and findings on both.
    settings, source
        For ``result.json``, beside the vehicle, and for ``best_fit.yaml``.
    header
        First line of ``best_fit.yaml``.
    began
        s of `time.perf_counter` at the start.
    """
    result = RunResult(
        status=Status.CONVERGED,
        seed=0,
        versions=versions(),
        settings={**settings, "vehicle": initial.model_dump(mode="json")},
        coefficients=_coefficients(initial, vehicle, combination, measurements),
        flights=(),
        findings=findings,
        search=SearchResult(
            method="bench",
            evaluations=0,
            iterations=0,
            wall_time=time.perf_counter() - began,
            cost_initial=None,
            cost_best=None,
            converged=True,
            message=Ending.NO_FURTHER_GAIN,
        ),
    )
    record = bench_record(combination, measurements)
    made_by = {"made_by": f"{PROGRAM} {result.versions[PROGRAM]}", **source}
    with result_folder(out) as folder:
        forget(folder)
        write_vehicle(vehicle.replace(source=made_by), folder / BEST_FIT_FILE, header=header)
        record.write(folder)
        result.write(folder)
        render(folder)
    return BenchResult(folder, result, record)


def _measure_all(
    path: Path, plan: BenchFile, start: VehicleFile
) -> tuple[tuple[Measurement, ...], Combination, VehicleFile]:
    """Return each measurement, their combination, and the measured vehicle."""
    experiments = dict(zip(experiment_names(plan.experiments), plan.experiments, strict=True))
    spins = {name: spin for name, spin in experiments.items() if isinstance(spin, YawSpins)}
    nominal, base, vehicle = known_of(start), path.parent, start
    measured = {
        name: measure(name, experiment, start, base)
        for name, experiment in experiments.items()
        if name not in spins
    }
    for _ in range(MAX_RELINEARISATIONS if spins else 1):
        if measured:
            vehicle = measured_vehicle(path, start, combine(tuple(measured.values()), nominal))
        measured |= {name: measure(name, spin, vehicle, base) for name, spin in spins.items()}
    measurements = tuple(measured[name] for name in experiments)
    combination = combine(measurements, nominal)
    return measurements, combination, measured_vehicle(path, start, combination)


def known_of(vehicle: VehicleFile) -> dict[str, float]:
    """Return coefficient -> scaled coordinate in a vehicle file, or its neutral value."""
    neutral = {n: row.neutral for n, row in COEFFICIENTS.items() if row.neutral is not None}
    values = neutral | values_of(vehicle)
    return {
        name: COEFFICIENTS[name].scaled(v)
        for name, v in values.items()
        if v > 0 or COEFFICIENTS[name].scale == "linear"
    }


def measured_vehicle(path: Path, start: VehicleFile, combination: Combination) -> VehicleFile:
    """Return the vehicle with the measured coefficients.

    A lag is at least zero, even if experiments combine to less.

    Raises
    ------
    ConfigError
        They are impossible.
    """
    values = {
        name: COEFFICIENTS[name].value_at(float(scaled))
        for name, scaled in zip(combination.names, combination.scaled, strict=True)
    }
    values |= {n: max(v, 0.0) for n, v in values.items() if COEFFICIENTS[n].unit == "s"}
    try:
        return with_values(start, values)
    except ConfigError as error:
        remedy = error.remedy
        if any(COEFFICIENTS[name].place[0] == "inertia" for name in values):
            remedy = (
                "check which axis hung vertical in each pendulum, and hang the axes not measured"
            )
        raise ConfigError(path, error.what, remedy) from None


def _coefficients(
    start: VehicleFile,
    vehicle: VehicleFile,
    combination: Combination,
    measurements: Sequence[Measurement],
) -> dict[str, CoefficientResult]:
    initial, best = values_of(start), values_of(vehicle)
    places = {name: place for place, name in enumerate(combination.names)}
    coefficients = {}
    for name, value in best.items():
        row = COEFFICIENTS[name]
        before = initial.get(name, value if row.neutral is None else row.neutral)
        if name not in places:
            coefficients[name] = CoefficientResult.judged(
                name, before, value, Verdict.FIXED, NOT_FITTED
            )
            continue
        place = places[name]
        resolution = resolution_of(name, start)
        verdict, reason = _judged(name, place, combination, measurements, resolution)
        determined = bool(combination.determined[place])
        scaled = float(combination.scaled[place])
        deviation = float(np.sqrt(combination.covariance[place, place]))
        ends = (scaled - Z95 * deviation, scaled + Z95 * deviation)
        coefficients[name] = CoefficientResult.judged(
            name,
            before,
            value,
            verdict,
            reason,
            std_error=row.error_at(scaled, deviation) if determined else None,
            ci95=(row.value_at(ends[0]), row.value_at(ends[1])) if determined else None,
            identifiable=reason.identifiable,
        )
    return coefficients


def resolution_of(name: str, vehicle: VehicleFile) -> float:
    """Return the size of a linear coefficient below which it makes no difference."""
    return scaled_to_size(COEFFICIENTS[name], size_of(vehicle)).step


def _judged(
    name: str,
    place: int,
    combination: Combination,
    measurements: Sequence[Measurement],
    resolution: float,
) -> tuple[Verdict, Reason]:
    """Return the verdict on a coefficient by the experiments, and its reason."""
    if not combination.determined[place]:
        rows = sorted((row for m in measurements for row in m.rows if name in row), key=len)
        partners = [n for row in rows for n in row if n != name]
        places = {n: i for i, n in enumerate(combination.names)}
        partners.sort(key=lambda n: bool(combination.determined[places[n]]))
        partner = partners[0] if partners else None
        reason = Reason(code=ReasonCode.COMBINATION_MEASURED, correlated_with=partner)
        return Verdict.NOT_IDENTIFIABLE, reason
    row, scaled = COEFFICIENTS[name], float(combination.scaled[place])
    deviation = float(np.sqrt(combination.covariance[place, place]))
    relative = deviation if row.scale == "log" else deviation / max(abs(scaled), resolution)
    return judge_by_error(
        deviation,
        relative,
        None if row.scale == "log" else row.unit,
        known=ReasonCode.INTERVAL,
        roughly=ReasonCode.MEASURED_ROUGHLY,
        channel=max(measurements, key=lambda m: _weight(name, m, combination)).experiment,
    )


def _weight(name: str, measurement: Measurement, combination: Combination) -> float:
    """Return an experiment's information on a coefficient, given the errors of the others."""
    total = 0.0
    for row, variance in zip(measurement.rows, np.diag(measurement.covariance), strict=True):
        others = np.array([row.get(n, 0.0) if n != name else 0.0 for n in combination.names])
        spread = float(variance + others @ combination.covariance @ others)
        total += row.get(name, 0.0) ** 2 / spread
    return total


def conflicts_of(combination: Combination) -> Iterator[Finding]:
    """Return the experiments that the others contradict."""
    for one in combination.conflicts:
        yield Code.BENCH_CONFLICT.warning(one.experiment, *one.names, deviation=one.deviation)
