"""A result folder without the half minute of a fit: two short flights with white noise."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import equinox as eqx
import numpy as np

from tests.tuner.uncertainty import making
from tuner.coefficients import COEFFICIENTS
from tuner.comparison.errors import FlightErrors, SignalErrors
from tuner.config import values_of, write_vehicle
from tuner.examination.examination import Examination, examine
from tuner.examination.knowledge import knowledge_of
from tuner.examination.tables import write_files
from tuner.flights.flight import Array
from tuner.objective.normal import Objective
from tuner.report import write_laps
from tuner.report.record import Move, SearchRecord, Start
from tuner.report.traces import save_traces
from tuner.result import (
    CoefficientResult,
    Ending,
    FlightResult,
    RunResult,
    SearchResult,
    Status,
    write_result,
)
from tuner.uncertainty.verdict import NOT_FITTED, Verdict
from tuner.wording.verdicts import judgement_in_words

COMMAND = "tune --flights 'lab/*.bag' </script><b>"


def problem(free: Sequence[str], *, without: Sequence[str] = ()) -> Objective:
    exact = making.problem(free)
    noisy = making.with_data(exact, making.truth(exact), noise=np.random.default_rng(0))
    kept = {name: one for name, one in noisy.segments.measured.items() if name not in without}
    changed: Objective = eqx.tree_at(lambda o: o.segments.measured, noisy, kept)
    return changed


def write_run(folder: Path, free: Sequence[str], *, without: Sequence[str] = ()) -> Examination:
    """Write what a run that ended at the truth would have written."""
    objective = problem(free, without=without)
    point = making.truth(objective)
    found = examine(making.fitted_of(objective, point))
    vehicle = making.vehicle_file()
    write_vehicle(vehicle, folder / "best_fit.yaml", header="A test's.")
    errors = [_errors(name, 0.2) for name in making.FLIGHTS]
    better = [_errors(name, 0.002) for name in making.FLIGHTS]
    write_result(_result(found, errors, better), folder)
    write_laps(folder, {e.name: e for e in errors}, {e.name: e for e in better})
    save_traces(
        folder, {name: _traces(objective, segment) for segment, name in enumerate(making.FLIGHTS)}
    )
    values = values_of(vehicle)
    SearchRecord(
        iterations=[
            Move(
                stage="whole flights",
                number=n,
                loss=10.0**-n,
                position_rmse=0.1**n,
                accepted=True,
                horizon=6.0,
            )
            for n in range(4)
        ],
        starts=[
            Start(origin="vehicle file", loss=0.5, start=values, end=values),
            Start(origin="random", loss=3.0, start=values, end=values),
            Start(origin="random", loss=None, start=values, end=values),
        ],
    ).write(folder)
    write_files(knowledge_of(found, objective.space, point), folder)
    return found


def _errors(name: str, size: float) -> FlightErrors:
    time = np.linspace(0.0, making.SECONDS, 300)
    place = size * np.column_stack([np.sin(time), np.cos(time), 0.1 * time])
    zero = np.zeros_like(place)
    position, attitude = SignalErrors(time, zero, place), SignalErrors(time, zero, 10 * place)
    return FlightErrors(name, position, attitude, np.array([2.0, 4.0]), None)


def _traces(objective: Objective, segment: int) -> dict[str, Array]:
    channels = making.fly_at(objective, making.truth(objective))
    place = np.asarray(channels["position"])[::4, :, segment]
    time = np.arange(len(place)) * 4 / making.PHYSICS
    turn = 10.0 * place
    return {
        "position_time": time,
        "position": place,
        "position_initial": place + 0.1,
        "position_best": place + 0.001,
        "attitude_time": time,
        "attitude": turn,
        "attitude_initial": turn + 3.0,
        "attitude_best": turn + 0.05,
    }


def _result(
    found: Examination, errors: Sequence[FlightErrors], better: Sequence[FlightErrors]
) -> RunResult:
    coefficients = {}
    for name, value in values_of(making.vehicle_file()).items():
        estimate = found.uncertainty.estimates.get(name)
        unit = COEFFICIENTS[name].unit
        if estimate is None:
            coefficients[name] = CoefficientResult(
                unit=unit,
                initial=value,
                best=value,
                fitted=False,
                verdict=Verdict.FIXED,
                reason=NOT_FITTED,
            )
            continue
        coefficients[name] = CoefficientResult(
            unit=unit,
            initial=1.1 * value,
            best=value,
            fitted=True,
            std_error=estimate.std_error,
            ci95=estimate.ci95,
            identifiable=estimate.identifiable,
            verdict=estimate.verdict,
            reason=estimate.reason,
            note=judgement_in_words(estimate.verdict, estimate.reason),
        )
    flights = tuple(
        FlightResult(
            name=before.name,
            path=f"lab/{before.name}.bag",
            sha256="ab" * 32,
            split="fit" if number == 0 else "holdout",
            duration=making.SECONDS,
            time_offset=0.0,
            rmse_initial=before.rmse,
            rmse_best=after.rmse,
        )
        for number, (before, after) in enumerate(zip(errors, better, strict=True))
    )
    return RunResult(
        schema_version=2,
        status=Status.CONVERGED,
        seed=7,
        versions={"multirotor-tune": "0.1.0"},
        settings={"command": COMMAND, "origin": {"mass": "--mass"}, "vehicle": {"name": "quad"}},
        coefficients=coefficients,
        flights=flights,
        findings=(),
        search=SearchResult(
            method="gradient",
            evaluations=9,
            iterations=4,
            wall_time=1.0,
            cost_initial=10.0,
            cost_best=0.5,
            converged=True,
            message=Ending.NO_FURTHER_GAIN,
        ),
    )
