"""Which numbers of a run are exported, physical or effective ones, and where they come from."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from datetime import date
from pathlib import Path

from pydantic import JsonValue

from tuner.core.errors import InputError
from tuner.exporters.simulators import GAZEBO_CLASSIC, Simulator
from tuner.exporters.target import Target, quantity
from tuner.result import EffectiveResult, Run
from tuner.uncertainty.verdict_texts import judgement_in_words
from tuner.vehicle import COEFFICIENTS, REGISTRY, VehicleFile, Written, values_of

Refit = Callable[[Run, Simulator], tuple[VehicleFile, EffectiveResult] | None]
"""Finds the vehicle with which a simulator flies most like a run's; None where it is that one."""


def exported_vehicle(run: Run, today: date) -> tuple[VehicleFile, tuple[str, ...]]:
    """Return the run's best vehicle with source and confidence, and a note on each doubtful number.

    What the run held at its initial value has that value there; what was fitted beside it keeps
    the value that goes with it.
    """
    notes = tuple(
        f"{name} = {row.best:g} is {judgement_in_words(row.verdict, row.reason)}"
        for name, row in run.result.coefficients.items()
        if row.fitted and row.identifiable is False
    )
    return run.vehicle.replace(source=_source(run, today)), notes


def provenance(run: Run, today: date, accepted: str = "") -> str:
    """Return one line that says where the numbers come from."""
    fitted = [flight.name for flight in run.result.flights if flight.split == "fit"]
    line = f"fitted to {', '.join(fitted)}; run {run.folder.resolve().name}; {today.isoformat()}"
    return f"{line}; exported against a refusal: {accepted}" if accepted else line


def provenance_of_file(
    vehicle: VehicleFile, file: Path, today: date, accepted: str = ""
) -> tuple[str, tuple[str, ...]]:
    """Return a line on where a vehicle file's numbers come from, and one on each that it says."""
    how = vehicle.source.get("method", "as the vehicle file has it")
    line = f"{file.name}: {how}; no flight was compared; {today.isoformat()}"
    if accepted:
        line = f"{line}; exported against a refusal: {accepted}"
    values = values_of(vehicle)
    sources = tuple(
        f"{name} {quantity(values[name], COEFFICIENTS[name])}: {text}"
        for name, text in vehicle.source.items()
        if name in values
    )
    return " ".join(line.split()), sources


def _source(run: Run, today: date) -> dict[str, JsonValue]:
    result = run.result
    return {
        "run": str(run.folder.resolve()),
        "date": today.isoformat(),
        "versions": dict(result.versions),
        "flights": {
            flight.name: f"{flight.split}, sha256 {flight.sha256}" for flight in result.flights
        },
        "coefficients": {name: _confidence(run, name) for name in result.coefficients},
    }


def _confidence(run: Run, name: str) -> dict[str, JsonValue]:
    coefficient = run.result.coefficients[name]
    if not coefficient.fitted:
        return {"status": "fixed"}
    if coefficient.identifiable is False:
        words = judgement_in_words(coefficient.verdict, coefficient.reason)
        return {"status": words}
    known: dict[str, JsonValue] = {"status": "fitted"}
    if coefficient.std_error is not None:
        known["std_error"] = coefficient.std_error
    if coefficient.ci95 is not None:
        known["ci95"] = list(coefficient.ci95)
    return known


def in_simulator(
    run: Run, target: Target, refit: Refit | None
) -> tuple[Run, EffectiveResult | None]:
    """Return a run as a target's simulator flies it, and how that was found.

    The run itself where the simulator lacks nothing, where there is none, and where the job wants
    physical coefficients. Without ``refit``, what was found for Gazebo stands in for others.
    """
    simulator, found = target.simulator, None
    if simulator is None or _wanted(run) == "physical":
        return run, None
    effective, flying = run.result.effective, run.effective
    if effective is not None and flying is not None:
        lost = {name for term in effective.lost for name in term.names}
        is_for = GAZEBO_CLASSIC.name if effective.target == "gazebo" else effective.target
        if is_for == simulator.name or refit is None:
            if all(isinstance(target.entry(REGISTRY[name]), Written) for name in lost):
                return run, None
            found = flying, effective
    if found is None and refit is not None:
        with suppress(InputError):  # recordings that are gone: the gate that flies them says so
            found = refit(run, simulator)
    if found is None:
        return run, None
    flying, effective = found
    lost = {name for term in effective.lost for name in term.names}
    coefficients = {
        name: row.model_copy(update={"best": effective.coefficients[name]})
        for name, row in run.result.coefficients.items()
        if name in effective.coefficients
    }
    flights = tuple(
        flight.model_copy(
            update={
                "rmse_best": effective.flights[flight.name],
                "conditions": {n: v for n, v in flight.conditions.items() if n not in lost},
            }
        )
        for flight in run.result.flights
    )
    result = run.result.model_copy(update={"coefficients": coefficients, "flights": flights})
    return run.model_copy(update={"vehicle": flying, "result": result}), effective


def _wanted(run: Run) -> str:
    job = run.result.settings.get("job")
    return str(job.get("target", "gazebo")) if isinstance(job, dict) else "gazebo"
